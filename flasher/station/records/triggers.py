# ruff: noqa: S608  all of this SQL is written here, no value comes from outside
"""Rules over several rows, as triggers of the database, so that no program can get around them.

The conditions are written once, in SQL that SQLite and PostgreSQL share; only the frame around them
differs. The fingerprint tells later whether a rule was taken away or made weaker.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from sqlalchemy import Connection, text

from flasher.station.records.schema import metadata

_RUN_IS_OVER: Final = "(SELECT state FROM run WHERE id = {row}.run_id) <> 'RUNNING'"
_STEP_IS_OVER: Final = (
    "(SELECT run.state FROM run JOIN step ON step.run_id = run.id WHERE step.id = {row}.step_id)"
    " <> 'RUNNING'"
)
_OUT_OF_LIMITS: Final = (
    "(({m}.value IS NOT NULL AND (({m}.low IS NOT NULL AND {m}.value < {m}.low)"
    " OR ({m}.high IS NOT NULL AND {m}.value > {m}.high)))"
    " OR ({m}.expected IS NOT NULL AND ({m}.text IS NULL OR {m}.text <> {m}.expected)))"
)


class Rule(NamedTuple):
    """`when` is what must not be, at `event` ("BEFORE UPDATE") on `table`; `text` says it."""

    name: str
    table: str
    event: str
    when: str
    text: str


def _finished_parts() -> list[Rule]:
    """No part of a finished run is added, changed or taken away."""
    rules = []
    for table, over in (
        ("run_target", _RUN_IS_OVER),
        ("step", _RUN_IS_OVER),
        ("measurement", _STEP_IS_OVER),
        ("device_write", _RUN_IS_OVER),
        ("attachment", _RUN_IS_OVER),
    ):
        said = f"a finished run is immutable: {table}"
        rules += [
            Rule(f"{table}_insert", table, "BEFORE INSERT", over.format(row="NEW"), said),
            Rule(
                f"{table}_update",
                table,
                "BEFORE UPDATE",
                f"{over.format(row='OLD')} OR {over.format(row='NEW')}",
                said,
            ),
            Rule(f"{table}_delete", table, "BEFORE DELETE", "1 = 1", "records are not deleted"),
        ]
    return rules


def _differs(*columns: str) -> str:
    return " OR ".join(f"NEW.{name} <> OLD.{name}" for name in columns)


_TO_PASS: Final = "NEW.state = 'PASS' AND "  # noqa: S105
_RUN_RULES: Final = (
    Rule("run_insert", "run", "BEFORE INSERT", "NEW.state <> 'RUNNING'", "a run begins RUNNING"),
    Rule("run_update", "run", "BEFORE UPDATE", "OLD.state <> 'RUNNING'", "a finished run is final"),
    Rule(
        "run_claim",
        "run",
        "BEFORE UPDATE",
        _differs(
            "id",
            "unit_id",
            "socket_id",
            "recipe_id",
            "operator_id",
            "kind",
            "is_virtual",
            "reason",
            "begun_at",
            "begun_monotonic_s",
            "verification_required",
            "allow_completed_not_read_back",
        )
        + " OR COALESCE(NEW.lot_id, 0) <> COALESCE(OLD.lot_id, 0)",
        "what a run was claimed with is final",
    ),
    Rule(
        "run_nature",
        "run",
        "BEFORE INSERT",
        "EXISTS (SELECT 1 FROM run WHERE run.unit_id = NEW.unit_id"
        " AND run.is_virtual <> NEW.is_virtual)",
        "a unit is real or virtual, never both",
    ),
    Rule("run_delete", "run", "BEFORE DELETE", "1 = 1", "records are not deleted"),
    Rule(
        "run_from_recipe",
        "run",
        "BEFORE INSERT",
        "NOT EXISTS (SELECT 1 FROM recipe WHERE recipe.id = NEW.recipe_id"
        " AND recipe.verification_required = NEW.verification_required"
        " AND recipe.allow_completed_not_read_back = NEW.allow_completed_not_read_back)",
        "a run asks for the verification of its recipe",
    ),
    Rule(
        "pass_targets",
        "run",
        "BEFORE UPDATE",
        _TO_PASS + "(NOT EXISTS (SELECT 1 FROM run_target WHERE run_id = NEW.id)"
        " OR EXISTS (SELECT 1 FROM run_target WHERE run_id = NEW.id"
        " AND (reached IS NULL OR reached < required OR reached < NEW.verification_reached)))",
        "PASS needs every target verified as the recipe asks",
    ),
    Rule(
        "pass_log",
        "run",
        "BEFORE UPDATE",
        _TO_PASS + "NOT EXISTS (SELECT 1 FROM attachment WHERE run_id = NEW.id"
        " AND sha256 = NEW.log_sha256)",
        "PASS needs its log attached",
    ),
    Rule(
        "pass_steps",
        "run",
        "BEFORE UPDATE",
        _TO_PASS + "(NOT EXISTS (SELECT 1 FROM step WHERE run_id = NEW.id AND state = 'PASS'"
        " AND name <> 'save')"
        " OR EXISTS (SELECT 1 FROM step AS s WHERE s.run_id = NEW.id"
        " AND s.state NOT IN ('PASS', 'SKIPPED')"
        " AND NOT EXISTS (SELECT 1 FROM step AS later WHERE later.run_id = s.run_id"
        " AND later.name = s.name AND later.position > s.position)))",
        "PASS needs the last try of every step to pass",
    ),
    Rule(
        "pass_writes",
        "run",
        "BEFORE UPDATE",
        _TO_PASS + "EXISTS (SELECT 1 FROM device_write AS w WHERE w.run_id = NEW.id"
        " AND w.verified_at IS NULL AND NOT EXISTS (SELECT 1 FROM device_write AS later"
        " WHERE later.run_id = w.run_id AND later.target = w.target AND later.what = w.what"
        " AND later.id > w.id))",
        "PASS needs every write verified",
    ),
    Rule(
        "pass_flashes",
        "run",
        "BEFORE UPDATE",
        _TO_PASS + "NEW.kind IN ('production', 'reflash')"
        " AND EXISTS (SELECT 1 FROM run_target AS t WHERE t.run_id = NEW.id"
        " AND NOT EXISTS (SELECT 1 FROM device_write AS w WHERE w.run_id = t.run_id"
        " AND w.target = t.target AND w.what = 'flash' AND w.verified_at IS NOT NULL))",
        "PASS needs every target flashed, in a first run",
    ),
)
_PART_RULES: Final = (
    Rule(
        "step_limits",
        "measurement",
        "BEFORE INSERT",
        "(SELECT state FROM step WHERE id = NEW.step_id) = 'PASS' AND "
        + _OUT_OF_LIMITS.format(m="NEW"),
        "a step with a measurement out of its limits did not pass",
    ),
    Rule(
        "step_final",
        "step",
        "BEFORE UPDATE",
        "1 = 1",
        "a step is recorded once; a new try is a new row",
    ),
    Rule(
        "measurement_final",
        "measurement",
        "BEFORE UPDATE",
        "1 = 1",
        "a measurement is never changed",
    ),
    Rule(
        "write_final",
        "device_write",
        "BEFORE UPDATE",
        "OLD.verified_at IS NOT NULL OR "
        + _differs("run_id", "target", "what", "value", "id")
        + " OR "
        + _differs("intended_at", "intended_monotonic_s"),
        "an intent is never changed, and verified once",
    ),
    Rule(
        "target_final",
        "run_target",
        "BEFORE UPDATE",
        _differs("id", "run_id", "artifact_id", "target", "position", "required"),
        "what a run was claimed with is final",
    ),
    Rule("attachment_final", "attachment", "BEFORE UPDATE", "1 = 1", "attachments are final"),
    Rule("audit_update", "audit", "BEFORE UPDATE", "1 = 1", "the audit trail is append-only"),
    Rule("audit_delete", "audit", "BEFORE DELETE", "1 = 1", "the audit trail is append-only"),
    Rule(
        "audit_chain",
        "audit",
        "BEFORE INSERT",
        "EXISTS (SELECT 1 FROM audit WHERE station_id = NEW.station_id)"
        " AND NOT EXISTS (SELECT 1 FROM audit WHERE station_id = NEW.station_id"
        " AND number = NEW.number - 1 AND hash = NEW.previous_hash)",
        "an audit row names the hash of the row before it",
    ),
)


_NAMED: Final = ("station", "socket", "operator", "lot", "unit", "recipe", "artifact")


def _named_rows() -> list[Rule]:
    """What runs refer to keeps its name and its content."""
    rules = []
    for table in _NAMED:
        said = f"a {table} is final"
        rules += [
            Rule(f"{table}_update", table, "BEFORE UPDATE", "1 = 1", said),
            Rule(f"{table}_delete", table, "BEFORE DELETE", "1 = 1", "records are not deleted"),
        ]
    return rules


def _no_replacing() -> list[Rule]:
    """SQLite's REPLACE deletes without a trigger where another program does not ask for it."""
    tables = (
        *_NAMED,
        "run",
        "run_target",
        "step",
        "measurement",
        "device_write",
        "attachment",
        "audit",
    )
    return [
        Rule(
            f"{table}_replace",
            table,
            "BEFORE INSERT",
            f"EXISTS (SELECT 1 FROM {table} WHERE id = NEW.id)",
            "records are not replaced",
        )
        for table in tables
    ]


RULES: Final = (
    *_RUN_RULES,
    *_finished_parts(),
    *_named_rows(),
    *_PART_RULES,
    *_no_replacing(),
)


def trigger_statements(dialect: str) -> list[str]:
    """The SQL that makes the triggers."""
    more = _no_truncating() if dialect == "postgresql" else ()
    return [*_statements(dialect, RULES), *more]


def final_table(dialect: str, table: str) -> list[str]:
    """The SQL that makes triggers which keep a table as it is."""
    said = f"{table} is final"
    events = ("INSERT", "UPDATE", "DELETE")
    rules = (Rule(f"{table}_{e.lower()}", table, f"BEFORE {e}", "1 = 1", said) for e in events)
    return _statements(dialect, rules)


def _statements(dialect: str, rules: Iterable[Rule]) -> list[str]:
    if dialect == "sqlite":
        return [
            f"CREATE TRIGGER {rule.name} {rule.event} ON {rule.table} WHEN {rule.when}"
            f" BEGIN SELECT RAISE(ABORT, '{rule.text}'); END"
            for rule in rules
        ]
    return [statement for rule in rules for statement in _postgresql(rule)]


def _no_truncating() -> Iterator[str]:
    """TRUNCATE deletes all rows, and no trigger of a row sees it; SQLite has no such command."""
    yield _function("truncate_is_refused", "RAISE EXCEPTION 'records are not deleted'")
    for table in metadata.tables:
        yield (
            f"CREATE TRIGGER {table}_truncate BEFORE TRUNCATE ON {table}"
            " FOR EACH STATEMENT EXECUTE FUNCTION truncate_is_refused()"
        )


def _postgresql(rule: Rule) -> tuple[str, str]:
    result = "OLD" if rule.event.endswith("DELETE") else "NEW"
    refuse = f"RAISE EXCEPTION '{rule.text}' USING ERRCODE = 'check_violation'"
    trigger = (
        f"CREATE TRIGGER {rule.name} {rule.event} ON {rule.table}"
        f" FOR EACH ROW EXECUTE FUNCTION {rule.name}()"
    )
    return _function(rule.name, f"IF {rule.when} THEN {refuse}; END IF; RETURN {result}"), trigger


def _function(name: str, body: str) -> str:
    # The path of who makes it: tables of a session's own must not stand before the records.
    return (
        f"CREATE FUNCTION {name}() RETURNS trigger LANGUAGE plpgsql SET search_path FROM CURRENT"
        f" AS $$ BEGIN {body}; END $$"
    )


_SQLITE: Final = """
SELECT type || ' ' || name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_stat%'
"""
_POSTGRESQL: Final = """
SELECT 'trigger ' || t.tgname, pg_get_triggerdef(t.oid) || t.tgenabled::text
FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid
WHERE NOT t.tgisinternal AND c.relnamespace = current_schema()::regnamespace
UNION ALL
SELECT 'function ' || proname, pg_get_functiondef(oid) FROM pg_proc
WHERE pronamespace = current_schema()::regnamespace AND prokind = 'f'
UNION ALL
SELECT 'constraint ' || c.relname || '.' || conname, pg_get_constraintdef(o.oid)
FROM pg_constraint o JOIN pg_class c ON c.oid = o.conrelid
WHERE connamespace = current_schema()::regnamespace AND contype <> 'n'
UNION ALL
SELECT 'index ' || indexname, indexdef FROM pg_indexes WHERE schemaname = current_schema()
UNION ALL
SELECT 'column ' || c.relname || '.' || attname,
    format_type(atttypid, atttypmod) || attnotnull::text
FROM pg_attribute JOIN pg_class c ON c.oid = attrelid
WHERE c.relnamespace = current_schema()::regnamespace AND c.relkind = 'r'
    AND attnum > 0 AND NOT attisdropped
"""
_QUERIES: Final = {"sqlite": _SQLITE, "postgresql": _POSTGRESQL}


def fingerprint_of(connection: Connection) -> dict[str, str]:
    """A short hash for each table, index, trigger, ... by its name; empty for a back end of which
    it cannot be read.
    """
    query = _QUERIES.get(connection.dialect.name)
    if query is None:
        return {}
    return {
        name: hashlib.sha256((sql or "").encode()).hexdigest()[:16]
        for name, sql in connection.execute(text(query)).all()
    }


def differences(stated: Mapping[str, str], found: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """What is not as it was stated: its name, and what is wrong with it."""
    for name in sorted(stated.keys() | found.keys()):
        if name not in found:
            yield name, "it was taken away"
        elif name not in stated:
            yield name, "it was added"
        elif stated[name] != found[name]:
            yield name, "it was changed"
