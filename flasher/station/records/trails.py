"""What is wrong with the audit trails and with the schema, and what the trails vouch for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from sqlalchemy import Connection, select

from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.fingerprint import differences, fingerprint_of
from flasher.station.records.heads import Head
from flasher.station.records.keys import is_signed
from flasher.station.records.model import KeptHeads, Problem
from flasher.station.records.signing import KeptPlace


class TrailsCheck:
    """One look at all audit trails, against the heads that are kept of them."""

    def __init__(self, place: KeptPlace) -> None:
        self._place = place
        self._schema: dict[tuple[str, str], None] = {}
        """How the schema differs from what any chain states of it, each difference once."""
        self.remarks: list[str] = []
        self.kept: list[KeptHeads] = []
        self.unkept: list[str] = []
        self.claims: dict[int, Mapping[str, str]] = {}
        """The digests that the chains state for each run, at its claim."""
        self.endings: dict[int, Mapping[str, str]] = {}
        """And at its end."""

    def problems(self, connection: Connection) -> Iterator[Problem]:
        """What is wrong; fills the rest."""
        info = connection.execute(select(schema.schema_info)).mappings().one()
        records_id, found = info["records_id"], fingerprint_of(connection)
        names = list(connection.execute(select(schema.station.c.name)).scalars())
        kept_of = self._place.files(records_id, names)
        for name in dict.fromkeys([*names, *kept_of]):
            rows = connection.execute(
                select(schema.audit)
                .join_from(schema.audit, schema.station)
                .where(schema.station.c.name == name)
                .order_by(schema.audit.c.number)
            )
            hashes: dict[int, str] = {}
            restored: dict[int, range] = {}
            yield from self._chain(name, rows.mappings(), records_id, found, hashes, restored)
            yield from self._heads(name, kept_of.get(name), hashes, restored)
        for thing, what in self._schema:
            yield Problem(f"schema, {printable(thing)}", what)

    def _chain(
        self,
        name: str,
        rows: Iterable[Mapping[Any, Any]],
        records_id: str,
        found: Mapping[str, str],
        hashes: dict[int, str],
        restored: dict[int, range],
    ) -> Iterator[Problem]:
        """Go along one chain; fills the hashes of its rows, and which heads were given up."""
        before, key = chain.GENESIS, None
        stated: Mapping[str, str] = {}
        shown = printable(name)
        for expected, row in enumerate(rows, 1):
            where = f"audit row {expected} of {shown}"
            data = chain.data_of(row["data"])
            if row["previous_hash"] != before or row["number"] != expected:
                yield Problem(where, "the chain is broken: the row before it is missing or changed")
            is_whole = row["hash"] == chain.row_hash(row)
            if not is_whole:
                yield Problem(where, "it was changed after it was written")
            following = chain.key_of(row["event"], data)
            if following is not None and row["event"] != chain.KEY_ROTATED:
                key = following  # which signs itself
            if key is None or not is_signed(row["hash"], row["signature"], key):
                yield Problem(where, "it is not signed with the key of the station")
            key = following or key
            before, hashes[expected] = row["hash"], row["hash"]
            if not is_whole:
                continue  # what it says counts for nothing
            stated = _table(data.get("schema")) or stated
            if row["event"] == chain.RESTORED:
                restored[expected] = _lost(data)
            self._note(shown, row, data)
            self._vouch(row, data)
            for what in _contradictions(name, records_id, row["event"], data):
                yield Problem(where, what)
        if hashes:
            self._schema |= dict.fromkeys(differences(stated, found))

    def _note(self, shown: str, row: Mapping[Any, Any], data: Mapping[str, Any]) -> None:
        said = f"{row['at'][:10]} by {printable(str(data.get('by')))}"
        match row["event"]:
            case chain.KEY_LOST:
                self.remarks.append(f"{shown}: the key was declared lost on {said}")
            case chain.RESTORED:
                lost = _lost(data)
                self.remarks.append(
                    f"{shown}: rows {lost.start} to {lost.stop - 1} of an earlier chain were given"
                    f" up as lost on {said}"
                )
            case chain.CLOCK:
                self.remarks.append(f"{shown}: the clock was released on {said}")
            case _:
                pass

    def _vouch(self, row: Mapping[Any, Any], data: Mapping[str, Any]) -> None:
        digests = _table(data.get("digests"))
        if row["run_id"] is None or not digests:
            return
        if row["event"] in chain.ENDINGS:
            self.endings[row["run_id"]] = digests
        elif row["event"] == chain.CLAIMED:
            self.claims[row["run_id"]] = digests

    def _heads(
        self,
        name: str,
        kept: tuple[Head | int, ...] | None,
        hashes: Mapping[int, str],
        restored: Mapping[int, range],
    ) -> Iterator[Problem]:
        """Hold a chain against the heads that are kept of it."""
        shown = printable(name)
        place = printable(str(self._place.folder))
        if not kept:
            if hashes:
                self.unkept.append(name)
                if self._place.is_named:
                    yield Problem(f"heads of {shown}", f"none of these records is kept in {place}")
            return
        heads = [each for each in kept if isinstance(each, Head)]
        for line in (each for each in kept[:-1] if not isinstance(each, Head)):
            yield Problem(f"heads of {shown}", f"line {line} in {place} is no head")
        held = _counting(heads, hashes, restored)
        missing = [head for head in held if head.number not in hashes]
        other = [head for head in held if hashes.get(head.number, head.hash) != head.hash]
        if missing:
            last = max(missing, key=lambda head: head.number)
            yield Problem(
                f"audit trail of {shown}",
                f"it ends at row {max(hashes, default=0)}, but row {last.number} of {last.at} is"
                f" kept in {place}: its end was cut off, or this is an older copy",
            )
        if other:
            first = min(other, key=lambda head: head.number)
            yield Problem(
                f"audit trail of {shown}",
                f"row {first.number} of {first.at} is not the one that is kept in {place}: the"
                " chain was made anew",
            )
        if held:
            numbers = [head.number for head in held]
            path = self._place.folder
            self.kept.append(KeptHeads(name, path, min(numbers), max(numbers)))


def _counting(
    heads: list[Head], hashes: Mapping[int, str], restored: Mapping[int, range]
) -> list[Head]:
    """The heads without those that a person gave up, when older records were put back."""
    given_up: set[int] = set()
    for number, lost in restored.items():
        given_up_at = len(heads)
        for index, head in enumerate(heads):
            if (head.number, head.hash) == (number, hashes[number]):
                given_up_at = index
        earlier = enumerate(heads[:given_up_at])
        given_up |= {index for index, head in earlier if head.number in lost}
    return [head for index, head in enumerate(heads) if index not in given_up]


def _contradictions(
    name: str, records_id: str, event: str, data: Mapping[str, Any]
) -> Iterator[str]:
    """In what an intact row does not fit these records."""
    if event == chain.BEGUN and data.get("records") != records_id:
        yield "the chain is that of other records"
    if event == chain.BEGUN and data.get("station") != name:
        yield f"the chain is that of the station {printable(str(data.get('station')))}"
    if event == chain.MIGRATED:
        yield from (
            f"found at the migration: {printable(str(x))}" for x in _list(data.get("problems"))
        )


def _table(value: Any) -> Mapping[str, str]:
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _lost(data: Mapping[str, Any]) -> range:
    """The rows that a person gave up; none where it is not said."""
    first, last = data.get("lost_from"), data.get("lost_to")
    if isinstance(first, int) and isinstance(last, int):
        return range(first, last + 1)
    return range(0)
