"""Harness of the plans of simulated upgrades."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Final

from flasher.errors import UsageError
from flasher.simulate import draw
from flasher.simulate.independent import Choices
from flasher.simulate.plan import CLAUSES, Plan
from tests.fuzz.harness import Harness


def take_plan(data: bytes) -> None:
    try:
        plan = Plan.parse(data.decode("utf-8", "replace"))
    except (ValueError, UsageError):
        return  # UsageError: what the device model refuses
    text = str(plan)
    try:
        again = Plan.parse(text)
    except ValueError as error:
        raise AssertionError(f"{text!r} is a plan, and cannot be read") from error
    assert again == plan, text
    assert [plan.job, plan.adapter, *plan.devices, *plan.events]


def _plans() -> Iterator[bytes]:
    for seed in range(20):
        yield str(draw.drawn(seed)).encode()
    yield "\n".join(str(kind()) for kind in CLAUSES.values()).encode()


def _words() -> list[str]:
    names = {f"{known.name}=" for kind in (*CLAUSES.values(), Choices) for known in fields(kind)}
    moments = ("packet", "frame", "flash", "reset", "update", "end")
    return [*CLAUSES, *sorted(names), *(f"@{moment}" for moment in moments), " ; ", "true", "nan"]


HARNESSES: Final = {
    "plan": Harness(take_plan, _plans, "flasher.simulate.plan._text", max_size=512, words=_words),
}
