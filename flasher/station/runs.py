"""Prepares the claim of a run from earlier runs of the unit, and saves the run's outcome.

`save` can be called again after any failure; the outcome is shown only after it is saved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

from flasher.station.codes import CODES, OF_ANOTHER, Code
from flasher.station.messages import flash_value, packed, write_key
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.errors import RuleBrokenError
from flasher.station.records.model import (
    COUNTER,
    FLASH,
    PRODUCT,
    TORN_TRACE,
    TRACE,
    Admission,
    AttachmentFile,
    Claim,
    RunDetails,
    RunResult,
    RunState,
    StepName,
    StepState,
    UnitLife,
    WriteRecord,
)
from flasher.station.records.store import Store
from flasher.station.unit_checks import BEFORE

NOT_CHECKED: Final = "duplicates not checked"
"""End of the text of a PASS of a unit that may have passed at another station."""


@dataclass
class ActiveRun:
    """A claimed run whose outcome is not saved yet."""

    claim: Claim
    begun_s: float
    admission: Admission | None = None
    gets_label: bool = False
    """A PASS gets a label."""
    where: str = StepName.CONNECT.value
    """Active step, with its target."""
    journal_error: str = ""
    """Reason why a record of the run could not be saved, so that it cannot pass; or ""."""
    reported: RunResult | None = None
    """Result that the process reported; None before."""
    ended_s: float = 0.0
    attached: list[AttachmentFile] = field(default_factory=list)
    result: RunResult | None = None
    is_save_noted: bool = False


def save(store: Store, run: ActiveRun, now_s: Callable[[], float]) -> RunResult:
    """Save the end of a run; returns the result on disk. Raises RecordError."""
    if run.result is None:
        run.result = _judged(run)
    if not run.attached:
        _attach(store, run)
    if not run.is_save_noted:
        duration_s = max(0.0, now_s() - run.ended_s)
        state = StepState.ERROR if run.result.code == Code.TRACE_NOT_SAVED.name else StepState.PASS
        store.step(run.claim.run_id, StepName.SAVE.value, state, duration_s=duration_s)
        run.is_save_noted = True
    try:
        store.finish(run.claim.run_id, _ending(run, run.result), gets_label=run.gets_label)
    except RuleBrokenError as error:
        # The records refuse this PASS: the unit gets no verdict, since the program has a bug.
        run.result = _worse(run.result, Code.INTERNAL, error.what)
        store.finish(run.claim.run_id, _ending(run, run.result))
    store.files.forget_spooled(run.claim.run_id)
    return run.result


def _judged(run: ActiveRun) -> RunResult:
    result = run.reported
    if result is None:
        raise ValueError("a run that has not ended cannot be saved")
    if run.journal_error and result.outcome is not RunState.ABORTED:
        return _worse(result, Code.RECORD_NOT_SAVED, run.journal_error)
    return result


def _attach(store: Store, run: ActiveRun) -> None:
    """Store the trace, and check that its hash is the one that the process reported."""
    trace, closed = run.claim.trace, run.reported and run.reported.trace_sha256
    if closed is None:
        if trace.exists():
            with suppress(FileNotFoundError):
                run.attached = [store.files.add(TORN_TRACE, trace)]
        if run.result is not None and run.result.outcome is RunState.PASS:
            run.result = _worse(run.result, Code.TRACE_NOT_SAVED, "There is no trace of the bus.")
        return
    file = store.files.add(TRACE, packed(trace))
    if file.sha256 != closed and run.result is not None:
        words = "The trace on disk differs from the one that was recorded."
        run.result = _worse(run.result, Code.TRACE_NOT_SAVED, words)
    run.attached = [file]


def _ending(run: ActiveRun, result: RunResult) -> RunResult:
    """The result as it is saved."""
    code = CODES.get(result.code, Code.INTERNAL)
    log = next((file.sha256 for file in run.attached if file.kind == TRACE), None)
    text = " ".join(filter(None, (sentence(result.text), code.action)))
    if result.outcome is RunState.PASS:
        text = passed_words(result, run.claim)
    files = tuple(run.attached)
    return replace(result, code=code.name, text=text, trace_sha256=log, attachments=files)


def passed_words(result: RunResult, claim: Claim) -> str:
    """Text of a PASS: what was verified, and what was not checked."""
    words = verified_words(result)
    return f"{words}; {NOT_CHECKED}" if claim.unchecked else words


def sentence(text: str) -> str:
    """Add a full stop if needed, so that another sentence can follow."""
    text = text.strip()
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def verified_words(result: RunResult) -> str:
    """Verification level of each target, for people."""
    return "; ".join(f"{name}: {level.words}" for name, level in result.verified.items())


def _worse(result: RunResult, code: Code, text: str) -> RunResult:
    return replace(result, outcome=code.outcome, code=code.name, text=text, verified={})


_OPEN: Final = frozenset({RunState.INTERRUPTED, RunState.ERROR, RunState.ABORTED})


def with_history(
    claim: Claim, lives: Sequence[UnitLife], recipe: LoadedRecipe, *, is_reworked: bool = False
) -> Claim:
    """Add results of the unit's earlier runs to a claim. `lives` are the units with this serial
    number; counters hold for all of them, anything else for the one of the recipe's part.

    Flashes count since the last PASS or FAIL, and since the last run in which the unit may have
    been exchanged. Values that must not change are those since the last PASS, since a run that
    failed after its first write may have changed them; with `is_reworked`, those since the last
    verdict, so that the run reads them again.
    """
    runs = [run for life in lives if life.part == recipe.recipe.part for run in life.runs]
    still_open = _after(runs, lambda run: run.run.state not in _OPEN)
    unfinished = _after(runs, lambda run: run.run.state is RunState.PASS)
    of_this_unit = _after(still_open, lambda run: run.run.code in OF_ANOTHER)
    passed = next((run for run in reversed(runs) if run.run.state is RunState.PASS), None)
    written = passed.writes if passed is not None else ()
    return replace(
        claim,
        known_before=_known(still_open if is_reworked else unfinished),
        flashed_before=_flashed(of_this_unit, recipe),
        written_before={
            write_key(write.target, write.what): write.value
            for write in written
            if write.what != FLASH
        },
        counters_before=_counters(claim, lives),
    )


def _counters(claim: Claim, lives: Sequence[UnitLife]) -> dict[str, int]:
    """Highest counter of a release of the same product that a device confirmed, by target."""
    highest: dict[str, int] = {}
    for run in (run for life in lives for run in life.runs):
        measured = {each.name: each for step in run.steps for each in step.measurements}
        for write in run.writes:
            counter = measured.get(f"{write.target} {COUNTER}")
            product = measured.get(f"{write.target} {PRODUCT}")
            signature = claim.signatures.get(write.target)
            if (
                write.what == FLASH
                and write.verified_at is not None
                and signature is not None
                and counter is not None
                and (product.text if product else "") == signature.product
            ):
                found = int(counter.value or 0)
                highest[write.target] = max(found, highest.get(write.target, 0))
    return highest


def _after(runs: list[RunDetails], ends: Callable[[RunDetails], bool]) -> list[RunDetails]:
    """Runs after the last one for which `ends` is true."""
    last = next((at for at in reversed(range(len(runs))) if ends(runs[at])), -1)
    return runs[last + 1 :]


def _known(runs: Sequence[RunDetails]) -> dict[str, str]:
    """Values that must not change, as the first run with a write read them before that write."""
    known: dict[str, str] = {}
    for run in runs:
        if not run.writes:
            continue
        for step in run.steps:
            for each in step.measurements:
                if each.name.startswith(BEFORE) and each.text is not None:
                    known.setdefault(each.name.removeprefix(BEFORE), each.text)
    return known


def _flashed(runs: Sequence[RunDetails], recipe: LoadedRecipe) -> frozenset[str]:
    """Targets whose last flash in these runs wrote this image and was read back."""
    last: dict[str, WriteRecord] = {}
    for run in runs:
        last |= {write.target: write for write in run.writes if write.what == FLASH}
    wanted = {each.name: flash_value(each.version, each.image.sha256) for each in recipe.targets}
    return frozenset(
        name
        for name, write in last.items()
        if write.value == wanted.get(name) and write.read_back is not None
    )
