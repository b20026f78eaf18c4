"""`flasher plant claims`: units that stations claim, and the release of expired claims."""

from __future__ import annotations

from collections.abc import Iterator

from flasher.cli.output import Output, counted, utc_time
from flasher.cli.plant.commands import ClaimOptions
from flasher.cli.plant.documents import PlantClaimsDocument
from flasher.errors import UsageError
from flasher.plant.central import open_central
from flasher.plant.claim_functions import NO_STATION
from flasher.plant.claim_list import (
    ClaimFilter,
    ReleasedClaim,
    UnitClaim,
    claims_of,
    release,
    releases_of,
)
from flasher.protocol.text import printable
from flasher.station.records.model import RunState


def claims(
    output: Output, url: str, options: ClaimOptions, *, releases: bool, reason: str | None
) -> int:
    chosen = ClaimFilter(options.station, options.part, options.serial)
    reason = (reason or "").strip()
    if releases != bool(reason):
        raise UsageError(
            "--release and --reason belong together.",
            remedy='Give both: --release --reason "its disk is broken, its records are lost".',
        )
    if releases and chosen == ClaimFilter():
        raise UsageError(
            "--release would release the claims of all stations.",
            remedy="Choose which: --station NAME or --serial SERIAL.",
        )
    with open_central(url) as central:
        if releases:
            count = release(central, chosen, reason)
            output.result(f"released {counted(count, 'claim')}")
        with central.reading() as connection:
            found, released = claims_of(connection, chosen), releases_of(connection, chosen)
    output.results(printable(line) for line in _lines(found, released))
    return output.document(PlantClaimsDocument(found, released))


def _lines(found: list[UnitClaim], released: list[ReleasedClaim]) -> Iterator[str]:
    for each in found:
        state = "EXPIRED" if each.is_expired else "valid until"
        yield f"{_what(each)}: {state} {utc_time(each.expires_at)}"
    if not found:
        yield "no claims"
    for old in released:
        when = utc_time(old.released_at)
        yield f"{_what(old)}: released {when} by {old.released_by}: {old.reason}"
        if old.run_id is not None:
            outcome = old.outcome or "retired"
            recheck = "; recheck the unit" if outcome == RunState.PASS else ""
            yield f"  its run arrived since: {outcome}, marked as not checked{recheck}"


def _what(claim: UnitClaim | ReleasedClaim) -> str:
    where = f"{claim.station or NO_STATION}, socket {claim.socket}"
    return f"{claim.part} {claim.serial}, {where}, claimed {utc_time(claim.claimed_at)}"
