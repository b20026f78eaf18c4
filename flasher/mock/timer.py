"""When something that repeats is due again."""

from __future__ import annotations


def due_again(due: float | None, delay_s: float, now: float) -> float:
    """`delay_s` after it was due, so that lateness does not add up, unless that is over already."""
    following = now if due is None else due + delay_s
    return following if following > now else now + delay_s


def due_until(due: float | None, delay_s: float, end: float, now: float) -> float:
    """The same, but `end` once that is nearer than half of `delay_s`: what is repeated last keeps
    its time to be answered, whatever the sums of times say.
    """
    following = due_again(due, delay_s, now)
    return end if following > end - delay_s / 2 else following
