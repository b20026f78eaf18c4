"""Checks a unit's answers against recipe and manifest: versions, limits, written values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Final

from flasher.errors import NoAnswerError
from flasher.host.identity import IdentityCheck
from flasher.host.items import Readable
from flasher.host.write import WritePlan, field_changes
from flasher.station.codes import Code
from flasher.station.messages import write_key
from flasher.station.recipe import Limit, Scan, fill
from flasher.station.recipe_file import LoadedRecipe, codec_of, readable_of
from flasher.station.records.model import (
    COUNTER,
    PRODUCT,
    SIGNATURE,
    Claim,
    Measurement,
    RunKind,
    StepName,
)
from flasher.station.unit_target import Identified, StepFailedError, UnitTarget

NOT_IDENTIFIED: Final = "not identified before flashing"
BEFORE: Final = "before "
"""Prefix of measurements of values that must not change, read before the first write."""
OF_CHECK: Final = {
    IdentityCheck.HARDWARE: Code.WRONG_HARDWARE,
    IdentityCheck.DOWNGRADE: Code.OLD_VERSION,
    IdentityCheck.PREVIOUS: Code.OLD_VERSION,
    IdentityCheck.IN_USE: Code.IN_USE,
    IdentityCheck.CHARGE: Code.LOW_CHARGE,
    IdentityCheck.UNSIGNED: Code.OLD_RELEASE,
}
"""Codes of failed checks; NOT_FOR_DEVICE for all others."""


def check_texts(allowed: Sequence[str], reported: str | None, code: Code) -> None:
    """Compare a reported text with the patterns of a recipe. Raises StepFailedError."""
    if not allowed or reported is None:
        return
    # These patterns have only *.
    plain = [each.replace("[", "[[]").replace("?", "[?]") for each in allowed]
    if not any(fnmatchcase(reported, each) for each in plain):
        raise StepFailedError(code, f"It has {reported}, the recipe lists {', '.join(allowed)}.")


def check_measured(measured: Sequence[Measurement]) -> None:
    """Compare measurements with their limits. Raises StepFailedError."""
    for each in measured:
        if each.is_within:
            continue
        shown = f"{each.text!a}, expected is {each.expected!a}"
        if each.value is not None:
            low = "" if each.low is None else f"from {each.low:g} "
            high = "" if each.high is None else f"to {each.high:g}"
            shown = f"{each.value:g} {each.unit}; allowed is {low}{high}".strip()
        raise StepFailedError(Code.LIMIT, f"{each.name} is {shown}.")


def wanted_text(plan: WritePlan) -> str:
    """The value to write, as it is recorded."""
    return ", ".join(change.new for change in field_changes(plan, None))


def identity_measurements(target: UnitTarget, identified: Identified) -> list[Measurement]:
    """The reported identity of a device as measurements without limits."""
    name, version = target.name, identified.seen.version
    if version is None:
        return [Measurement(f"{name} identity", text=NOT_IDENTIFIED)]
    words = ("model", "serial_number", "hardware_version", "firmware_version")
    texts = {word: getattr(version, word, None) for word in words}
    return [
        Measurement(f"{name} {word.replace('_', ' ')}", text=str(text))
        for word, text in texts.items()
        if text is not None
    ]


def signature_measurements(target: str, claim: Claim) -> Iterator[Measurement]:
    """What was found about the signatures of an image, as measurements without limits."""
    found = claim.signatures.get(target)
    if found is None:
        return
    yield Measurement(f"{target} {SIGNATURE}", text=found.text)
    if found.counter is not None:
        yield Measurement(f"{target} {COUNTER}", float(found.counter))
    if found.product:
        yield Measurement(f"{target} {PRODUCT}", text=found.product)


def state_text(target: UnitTarget, identified: Identified) -> str:
    if identified.is_in_bootloader:
        return f"in its bootloader {target.watcher.version}, {NOT_IDENTIFIED}".replace(" ,", ",")
    if identified.seen.version is None:
        return "no version query" if target.version_request is None else "silent"
    return identified.seen.firmware_version or "answers"


class UnitReads:
    """Reads and checks the items of one run."""

    def __init__(
        self, claim: Claim, recipe: LoadedRecipe, scan: Scan, targets: Sequence[UnitTarget]
    ) -> None:
        self._claim = claim
        self._recipe = recipe
        self._scan = scan
        self._targets = {target.name: target for target in targets}
        self._before: dict[str, str] = {}

    def limits(
        self, step: StepName, askable: Collection[str] | None = None
    ) -> Iterator[Measurement]:
        """Take the measurements of a step, of targets that run an application (`askable`). Raises
        NoAnswerError.
        """
        for limit in self._recipe.recipe.limit:
            if limit.step is step and (askable is None or limit.target in askable):
                yield self._measure(limit)

    def _measure(self, limit: Limit) -> Measurement:
        codec = codec_of(self._recipe, limit)
        values = self._targets[limit.target].read(readable_of(self._recipe, limit))
        value, shown = values[limit.field]
        name = f"{limit.target} {limit.item} {limit.field}"
        if limit.expected is not None:
            return Measurement(name, text=shown, expected=fill(limit.expected, self._scan))
        if not isinstance(value, int | float):
            raise StepFailedError(Code.RECIPE, f"{name} is not a number.")
        return Measurement(name, float(value), codec.unit, low=limit.low, high=limit.high)

    # -- values that must not change --------------------------------------------------------------

    def before(self, askable: Collection[str]) -> Iterator[Measurement]:
        """Read the values that must not change, and store them. Values that an interrupted run of
        this unit read take precedence. Targets that are not `askable` run no application.
        """
        known = self._claim.known_before
        for target, readable in self._unchanged():
            if target in askable:
                now = self._texts(target, readable)
            else:
                start = f"{target} {readable.name} "
                now = {name: text for name, text in known.items() if name.startswith(start)}
                if not now:
                    raise StepFailedError(
                        Code.UNCHANGED_UNKNOWN,
                        f"{target} {readable.name} cannot be read: it runs no application.",
                    )
            for name, text in now.items():
                self._before[name] = known.get(name, text)
                self._check_unchanged(name, text)
                yield Measurement(f"{BEFORE}{name}", text=text)

    def unchanged(self, measured: list[Measurement]) -> None:
        """Read the values that must not change again. Raises StepFailedError for a changed one."""
        for target, readable in self._unchanged():
            for name, text in self._texts(target, readable).items():
                first = self._before.get(name)
                measured.append(Measurement(f"unchanged {name}", text=text, expected=first))
                self._check_unchanged(name, text)

    def _check_unchanged(self, name: str, text: str) -> None:
        first = self._before.get(name)
        if text != first:
            raise StepFailedError(Code.CHANGED, f"{name} was {first!a}, and is {text!a} now.")

    def _unchanged(self) -> Iterator[tuple[str, Readable]]:
        for part in self._recipe.recipe.unchanged:
            yield part.target, readable_of(self._recipe, part)

    def _texts(self, target: str, readable: Readable) -> dict[str, str]:
        fields = self._targets[target].read(readable)
        return {f"{target} {readable.name} {name}": shown for name, (_, shown) in fields.items()}

    # -- written values ---------------------------------------------------------------------------

    def written(self, plans: Sequence[WritePlan], measured: list[Measurement]) -> None:
        """Read every written field again. Raises StepFailedError for a different value."""
        for plan in plans:
            key = write_key(plan.target.name, plan.writable.name)
            try:
                fields = self._targets[plan.target.name].read(plan.writable.read_back)
            except NoAnswerError as error:
                raise StepFailedError(Code.NOT_RUNNING, error.what) from error
            wanted = [name for name, _ in type(plan.content).LAYOUT if name in fields]
            value = ", ".join(fields[name][1] for name in wanted)
            expected = wanted_text(plan)
            if self._claim.kind is RunKind.VERIFY_ONLY:
                # An earlier run may have written another date.
                expected = self._claim.written_before.get(key, expected)
            measured.append(Measurement(key, text=value, expected=expected))
            if value != expected:
                raise StepFailedError(
                    Code.WRITE_DIFFERS, f"{key} reads {value!a} instead of {expected!a}."
                )
