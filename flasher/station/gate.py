"""Asks the plant about a unit before its run, in threads, so that nothing here delays the station.

    gate.ask(order)                 # may this unit be here? has it passed elsewhere?
    for asked, admission in gate.take():
        ...                         # an answer, or the fact that none came within the time limit

The recipe decides what follows from an `Admission` (`records.claims`). A claim is renewed from the
answer to `ended` or `dropped`; the plant's database forgets it when it has the end of the run.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol
from uuid import uuid4

from flasher.errors import FlasherError
from flasher.i18n import text
from flasher.log import log_event
from flasher.station.recipe import Recipe
from flasher.station.records.model import Admission, Elsewhere, Order, RunId

if TYPE_CHECKING:
    from flasher.station.question import Question
    from flasher.station.recipe_file import LoadedRecipe

HUNG_MAX: Final = 64
"""Threads that may wait for a plant that does not answer; further units are not asked about."""
_GRACE_S: Final = 0.5
"""Time after the time limits within which an answer is still taken."""


class Claims(Protocol):
    """Claims of units in the plant's database. Threads may share it."""

    def claim(self, token: str, order: Order, part: str) -> Elsewhere | None:
        """Claim a unit if no other station does. Raises FlasherError if it is not known whether
        the unit was claimed.
        """

    def clock_offset_s(self) -> float | None:
        """This computer's clock minus that of the database; None: not known."""

    def ended(self, token: str) -> None:
        """Renew a claim no more: its run has ended."""

    def dropped(self, token: str) -> None:
        """Release a claim with which no run began."""

    def take_released(self) -> set[RunId]:
        """Runs, found since the last call, whose claim the plant released before their end arrived
        there: the unit may have passed at another station.
        """

    def close(self) -> None:
        """Release what is left, for a moment."""


@dataclass(eq=False)
class _Asked:
    """A question that is not answered yet."""

    order: Order
    began_s: float
    give_up_at_s: float
    admission: Admission
    """What is known so far."""
    recipe: Recipe
    """Recipe of the socket when it was asked."""
    loaded: LoadedRecipe | None
    is_over: bool = False


def _in_thread(work: Callable[[], None]) -> None:
    threading.Thread(target=work, name="gate", daemon=True).start()


class Gate:
    """`claims`: None without a plant's database; `question`: None without one. `wake` is called
    from any thread when an answer can be taken; `start` starts a thread.
    """

    def __init__(
        self,
        recipe: Recipe,
        claims: Claims | None,
        question: Question | None,
        monotonic_s: Callable[[], float],
        *,
        start: Callable[[Callable[[], None]], None] = _in_thread,
    ) -> None:
        self._recipe, self._claims, self._question = recipe, claims, question
        self._now, self._start = monotonic_s, start
        self.wake: Callable[[], None] = lambda: None
        self.recipes: Mapping[str, LoadedRecipe] = {}
        """Recipes by socket, where they may differ from the first one."""
        self._open: list[_Asked] = []
        self._over: deque[_Asked] = deque()
        self._threads = 0
        self._mutex = threading.Lock()

    def ask(self, order: Order) -> None:
        """Ask about a unit; `take` returns the answer."""
        loaded = self.recipes.get(order.socket)
        recipe = self._recipe if loaded is None else loaded.recipe
        rule, question, now = recipe.plant, self._question, self._now()
        golden = recipe.golden
        limit_s = 0.0 if self._claims is None else rule.time_limit_s
        admission = Admission()
        if self._claims is not None:
            words = text("no answer within {limit:g} s", limit=rule.time_limit_s)
            admission = Admission(uuid4().hex, words)
        if question is not None:
            limit_s += question.time_limit_s
            admission = replace(admission, answer=question.silence())
        asked = _Asked(order, now, now + limit_s + _GRACE_S, admission, recipe, loaded)
        self._open.append(asked)
        if golden is not None and order.serial in golden.serial_numbers:
            asked.admission = Admission()  # it is no product
            self._end(asked)
            return
        with self._mutex:
            is_full = self._threads >= HUNG_MAX
            self._threads += not is_full
        if is_full:
            asked.give_up_at_s = now
            return
        self._start(lambda: self._work(asked))

    def take(self) -> list[tuple[Order, Admission]]:
        """Answers since the last call, and questions whose time limit is over."""
        now, found = self._now(), []
        late = [each for each in self._open if now >= each.give_up_at_s]
        with self._mutex:
            done = [*self._over, *(each for each in late if not each.is_over)]
            self._over.clear()
            for each in done:
                each.is_over = True
        for each in done:
            self._open.remove(each)
            offset_s = None if self._claims is None else self._claims.clock_offset_s()
            found.append(
                (
                    each.order,
                    replace(each.admission, clock_offset_s=offset_s, duration_s=now - each.began_s),
                )
            )
        return found

    def take_released(self) -> set[RunId]:
        """As in `Claims`."""
        return set() if self._claims is None else self._claims.take_released()

    def ended(self, admission: Admission | None) -> None:
        """The run of an admission has ended, and is in the station's records."""
        if self._claims is not None and admission is not None and admission.claim:
            self._claims.ended(admission.claim)

    def dropped(self, admission: Admission | None) -> None:
        """No run began with an admission."""
        if self._claims is not None and admission is not None and admission.claim:
            self._claims.dropped(admission.claim)

    def close(self) -> None:
        """Release the claims of questions without an answer."""
        for asked in self._open:
            self.dropped(asked.admission)
        if self._claims is not None:
            self._claims.close()

    # -- in a thread of its own -------------------------------------------------------------------

    def _work(self, asked: _Asked) -> None:
        try:
            self._ask(asked)
        except Exception as error:  # noqa: BLE001  a bug must not stop the station
            log_event(error)
        finally:
            with self._mutex:
                self._threads -= 1
            self._end(asked)

    def _ask(self, asked: _Asked) -> None:
        order = asked.order
        if self._question is not None:
            answer = self._question.ask(order, asked.loaded)
            self._learn(asked, replace(asked.admission, answer=answer))
            if not answer.may_begin:
                return  # no claim is needed
        if self._claims is None or asked.is_over:
            return
        try:
            other = self._claims.claim(asked.admission.claim, order, asked.recipe.part)
        except FlasherError as error:
            words = error.what.rstrip(".")
            is_in_time = self._learn(asked, replace(asked.admission, unchecked=words))
        else:
            admission = replace(asked.admission, unchecked="", elsewhere=other)
            is_in_time = self._learn(asked, admission)
        if not is_in_time:
            self._claims.dropped(asked.admission.claim)

    def _learn(self, asked: _Asked, admission: Admission) -> bool:
        """Store an answer; False if it comes too late."""
        with self._mutex:
            if not asked.is_over:
                asked.admission = admission
            return not asked.is_over

    def _end(self, asked: _Asked) -> None:
        with self._mutex:
            if asked.is_over:
                return
            asked.is_over = True
            self._over.append(asked)
        self.wake()
