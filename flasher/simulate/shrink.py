"""Shrinks a plan that shows a violation to fewer faults, and to a simpler device and adapter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final

from flasher.conformance.shrink import shrink as shrink_items
from flasher.simulate import plan as plans
from flasher.simulate.play import play

if TYPE_CHECKING:
    from flasher.simulate.subject import SubjectBench

TRIES: Final = 300
"""Maximum number of plans that are played."""


def shows(plan: plans.Plan, kind: str, bench: SubjectBench | None = None) -> bool:
    """Return True if a plan ends in a violation of this kind."""
    if bench is not None and plan.job.target != bench.target.name:
        return False
    return any(each.kind == kind for each in play(plan, bench=bench).violations)


def shrink(
    plan: plans.Plan,
    kind: str,
    *,
    is_bad: Callable[[plans.Plan, str], bool] = shows,
    is_over: Callable[[], bool] = lambda: False,
) -> plans.Plan:
    """Return the shortest plan found, until it is over, that still ends in a violation of this
    kind.
    """
    tries = TRIES

    def is_still_bad(shorter: plans.Plan) -> bool:
        nonlocal tries
        tries -= 1
        return tries >= 0 and not is_over() and is_bad(shorter, kind)

    events = [*plan.events]
    lasting = [each for each in plan.clauses if each not in events]

    def attempt(left: Sequence[plans.Clause]) -> Sequence[plans.Clause] | None:
        return left if is_still_bad(plans.Plan((*lasting, *left))) else None

    best = plans.Plan((*lasting, *shrink_items(events, attempt, tries=tries)))
    simplified = True
    while simplified:
        simplified = False
        for simpler in _simpler(best):
            if is_still_bad(simpler):
                best, simplified = simpler, True
                break
    return best


def _simpler(plan: plans.Plan) -> Iterator[plans.Plan]:
    """Yield plans that have one clause, choice or value less."""
    for index, clause in enumerate(plan.clauses):
        before, after = plan.clauses[:index], plan.clauses[index + 1 :]
        if isinstance(clause, plans.Adapter):
            yield plans.Plan((*before, *after))
        for simpler in _simpler_clauses(clause):
            yield plans.Plan((*before, simpler, *after))


def _simpler_clauses(clause: plans.Clause) -> Iterator[plans.Clause]:
    if isinstance(clause, plans.Independent | plans.Mock):
        words = clause.choices.split()
        for index in range(len(words)):
            yield replace(clause, choices=" ".join(words[:index] + words[index + 1 :]))
    for known in fields(clause):
        value = getattr(clause, known.name)
        if known.name not in ("when", "choices") and value != known.default:
            yield replace(clause, **{known.name: known.default})  # type: ignore[arg-type]
    packets = getattr(clause, "packets", 0)
    if packets > 3:
        yield replace(clause, packets=max(3, packets // 2))  # type: ignore[call-arg]
