# ruff: noqa: S608  all of this SQL is written here, no value comes from outside
"""Database triggers for rules over several rows, which bind every program.

The fingerprint of the schema shows later whether a rule was removed or weakened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from typing import Final, NamedTuple

from sqlalchemy import Connection, text


class Rule(NamedTuple):
    """A rule: `when` forbids `event` on `table`; `text` is the error message."""

    name: str
    table: str
    event: str
    when: str
    text: str


_ALWAYS: Final = "1 = 1"
_NOT_DELETED: Final = "records are not deleted"
_CLAIM_IS_FINAL: Final = "what a run was claimed with is final"
_RUN_IS_OVER: Final = "(SELECT state FROM run WHERE id = {row}.run_id) <> 'RUNNING'"
_STEP_IS_OVER: Final = (
    "(SELECT run.state FROM run JOIN step ON step.run_id = run.id WHERE step.id = {row}.step_id)"
    " <> 'RUNNING'"
)
_PARTS: Final = {
    "run_target": _RUN_IS_OVER,
    "step": _RUN_IS_OVER,
    "measurement": _STEP_IS_OVER,
    "device_write": _RUN_IS_OVER,
    "attachment": _RUN_IS_OVER,
}
"""Tables with the parts of a run, and the condition that the run has ended."""
_NAMED: Final = ("station", "socket", "operator", "lot", "unit", "recipe", "artifact")
"""Tables that runs refer to."""


def _differs(*columns: str) -> str:
    return " OR ".join(f"NEW.{name} <> OLD.{name}" for name in columns)


_OF_TABLES: Final[Mapping[tuple[str, str], Mapping[str, tuple[str, str]]]] = {
    ("run", "INSERT"): {
        "run_insert": ("NEW.state <> 'RUNNING'", "a run begins RUNNING"),
        "run_nature": (
            (
                "EXISTS (SELECT 1 FROM run WHERE run.unit_id = NEW.unit_id"
                " AND run.is_virtual <> NEW.is_virtual)"
            ),
            "a unit is real or virtual, never both",
        ),
        "run_from_recipe": (
            (
                "NOT EXISTS (SELECT 1 FROM recipe WHERE recipe.id = NEW.recipe_id"
                " AND recipe.verification_required = NEW.verification_required"
                " AND recipe.allow_completed_not_read_back = NEW.allow_completed_not_read_back)"
            ),
            "a run asks for the verification of its recipe",
        ),
    },
    ("run", "UPDATE"): {
        "run_update": ("OLD.state <> 'RUNNING'", "a finished run is final"),
        "run_claim": (
            _differs("id", "unit_id", "socket_id", "recipe_id", "operator_id", "kind", "is_virtual")
            + " OR "
            + _differs("reason", "begun_at", "begun_monotonic_s", "verification_required")
            + " OR "
            + _differs("allow_completed_not_read_back")
            + " OR COALESCE(NEW.lot_id, 0) <> COALESCE(OLD.lot_id, 0)",
            _CLAIM_IS_FINAL,
        ),
    },
    ("run", "UPDATE to PASS"): {
        "pass_targets": (
            (
                "(NOT EXISTS (SELECT 1 FROM run_target WHERE run_id = NEW.id)"
                " OR EXISTS (SELECT 1 FROM run_target WHERE run_id = NEW.id"
                " AND (reached IS NULL OR reached < required"
                " OR reached < NEW.verification_reached)))"
            ),
            "PASS needs every target verified as the recipe asks",
        ),
        "pass_log": (
            (
                "NOT EXISTS (SELECT 1 FROM attachment WHERE run_id = NEW.id"
                " AND sha256 = NEW.log_sha256)"
            ),
            "PASS needs its log attached",
        ),
        "pass_steps": (
            (
                "(NOT EXISTS (SELECT 1 FROM step WHERE run_id = NEW.id AND state = 'PASS'"
                " AND name <> 'save')"
                " OR EXISTS (SELECT 1 FROM step AS s WHERE s.run_id = NEW.id"
                " AND s.state NOT IN ('PASS', 'SKIPPED')"
                " AND NOT EXISTS (SELECT 1 FROM step AS later WHERE later.run_id = s.run_id"
                " AND later.name = s.name AND later.position > s.position)))"
            ),
            "PASS needs the last try of every step to pass",
        ),
        "pass_writes": (
            (
                "EXISTS (SELECT 1 FROM device_write AS w WHERE w.run_id = NEW.id"
                " AND w.verified_at IS NULL AND NOT EXISTS (SELECT 1 FROM device_write AS later"
                " WHERE later.run_id = w.run_id AND later.target = w.target AND later.what = w.what"
                " AND later.id > w.id))"
            ),
            "PASS needs every write verified",
        ),
        "pass_flashes": (
            (
                "NEW.kind IN ('production', 'reflash')"
                " AND EXISTS (SELECT 1 FROM run_target AS t WHERE t.run_id = NEW.id"
                " AND NOT EXISTS (SELECT 1 FROM device_write AS w WHERE w.run_id = t.run_id"
                " AND w.target = t.target AND w.what = 'flash' AND w.verified_at IS NOT NULL))"
            ),
            "PASS needs every target flashed, in a first run",
        ),
    },
    ("run", "DELETE"): {"run_delete": (_ALWAYS, _NOT_DELETED)},
    ("measurement", "INSERT"): {
        "step_limits": (
            (
                "(SELECT state FROM step WHERE id = NEW.step_id) = 'PASS' AND "
                "((NEW.value IS NOT NULL AND ((NEW.low IS NOT NULL AND NEW.value < NEW.low)"
                " OR (NEW.high IS NOT NULL AND NEW.value > NEW.high)))"
                " OR (NEW.expected IS NOT NULL AND (NEW.text IS NULL OR NEW.text <> NEW.expected)))"
            ),
            "a step with a measurement out of its limits did not pass",
        )
    },
    ("measurement", "UPDATE"): {
        "measurement_final": (_ALWAYS, "a measurement is never changed"),
    },
    ("step", "UPDATE"): {
        "step_final": (_ALWAYS, "a step is recorded once; a new try is a new row"),
    },
    ("device_write", "UPDATE"): {
        "write_final": (
            "OLD.verified_at IS NOT NULL OR "
            + _differs("run_id", "target", "what", "value", "id")
            + " OR "
            + _differs("intended_at", "intended_monotonic_s"),
            "an intent is never changed, and verified once",
        )
    },
    ("run_target", "UPDATE"): {
        "target_final": (
            _differs("id", "run_id", "artifact_id", "target", "position", "required"),
            _CLAIM_IS_FINAL,
        )
    },
    ("attachment", "UPDATE"): {"attachment_final": (_ALWAYS, "attachments are final")},
    ("audit", "UPDATE"): {"audit_update": (_ALWAYS, "the audit trail is append-only")},
    ("audit", "DELETE"): {"audit_delete": (_ALWAYS, "the audit trail is append-only")},
    ("audit", "INSERT"): {
        "audit_chain": (
            (
                "EXISTS (SELECT 1 FROM audit WHERE station_id = NEW.station_id)"
                " AND NOT EXISTS (SELECT 1 FROM audit WHERE station_id = NEW.station_id"
                " AND number = NEW.number - 1 AND hash = NEW.previous_hash)"
            ),
            "an audit row names the hash of the row before it",
        )
    },
}
"""By table and event: name of each rule, forbidden condition, and error message."""


def _rules() -> Iterator[Rule]:
    for (table, at), rules in _OF_TABLES.items():
        event, _, to = at.partition(" to ")
        begin = f"NEW.state = '{to}' AND " if to else ""
        for name, (when, message) in rules.items():
            yield Rule(name, table, event, begin + when, message)
    for table, over in _PARTS.items():  # no part of a finished run is added, changed or taken away
        message = f"a finished run is immutable: {table}"
        old, new = over.format(row="OLD"), over.format(row="NEW")
        yield Rule(f"{table}_insert", table, "INSERT", new, message)
        yield Rule(f"{table}_update", table, "UPDATE", f"{old} OR {new}", message)
        yield Rule(f"{table}_delete", table, "DELETE", _ALWAYS, _NOT_DELETED)
    for table in _NAMED:
        yield Rule(f"{table}_update", table, "UPDATE", _ALWAYS, f"a {table} is final")
        yield Rule(f"{table}_delete", table, "DELETE", _ALWAYS, _NOT_DELETED)
    # SQLite's REPLACE deletes without a trigger where another program does not ask for it.
    for table in (*_NAMED, "run", *_PARTS, "audit"):
        is_there = f"EXISTS (SELECT 1 FROM {table} WHERE id = NEW.id)"
        yield Rule(f"{table}_replace", table, "INSERT", is_there, "records are not replaced")


RULES: Final = tuple(_rules())


def trigger_statements() -> list[str]:
    return [
        f"CREATE TRIGGER {rule.name} BEFORE {rule.event} ON {rule.table} WHEN {rule.when}"
        f" BEGIN SELECT RAISE(ABORT, '{rule.text}'); END"
        for rule in RULES
    ]


def drop_triggers(connection: Connection) -> None:
    query = text("SELECT name FROM sqlite_master WHERE type = 'trigger'")
    for name in connection.execute(query).scalars().all():
        quoted = connection.dialect.identifier_preparer.quote(name)
        connection.exec_driver_sql(f"DROP TRIGGER {quoted}")


_SCHEMA: Final = text(
    "SELECT type || ' ' || name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_stat%'"
)


def fingerprint_of(connection: Connection) -> dict[str, str]:
    """Short hash of each table, index, trigger, ... by name."""
    return {
        name: hashlib.sha256((sql or "").encode()).hexdigest()[:16]
        for name, sql in connection.execute(_SCHEMA).all()
    }


def differences(stated: Mapping[str, str], found: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Names that differ between two fingerprints, each with the kind of difference."""
    for name in sorted(stated.keys() | found.keys()):
        if name not in found:
            yield name, "it was removed"
        elif name not in stated:
            yield name, "it was added"
        elif stated[name] != found[name]:
            yield name, "it was changed"


def stated_differences(
    stated: Collection[tuple[object, Mapping[str, str]]], found: Mapping[str, str]
) -> dict[tuple[str, str], None]:
    """Differences between the schema and the schemas that the chains record, each once. A record of
    an older version is void if another chain records the newer one.
    """
    numbers = [version if isinstance(version, int) else 0 for version, _ in stated]
    newest = max(numbers, default=0)
    return {
        difference: None
        for number, (_, fingerprint) in zip(numbers, stated, strict=True)
        if number == newest
        for difference in differences(fingerprint, found)
    }
