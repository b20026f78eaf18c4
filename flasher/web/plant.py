"""Supervisor pages of a plant: those of a station over all stations, and the page of stations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from flasher.i18n import text
from flasher.plant.alerts import (
    USUAL_BOUNDS,
    Bounds,
    CheckState,
    StationOverview,
    alerts,
    lasting,
    overviews,
)
from flasher.web.query_processes import Answer, Question
from flasher.web.supervisor import PAGES, SupervisorPages

STATIONS: Final = "/stations"
"""Path of the page of all stations."""
_STATES: Final = {
    CheckState.OK: ("good", text("in order")),
    CheckState.UNKNOWN: ("neutral", text("not known")),
    CheckState.ALERT: ("bad", text("alert")),
}
"""Class and word of a state."""


@dataclass(frozen=True)
class PlantPages(SupervisorPages):
    """Renders the pages of a plant."""

    bounds: Bounds = USUAL_BOUNDS

    @staticmethod
    def routes() -> Mapping[str, Callable[[Any, Question], Answer]]:
        return PLANT_PAGES

    @property
    def names(self) -> Mapping[str, str]:
        return {STATIONS: text("Stations"), **super().names}

    def stations(self, question: Question) -> Answer:
        """All stations with their checks; those with alerts first."""
        with self.store.database.reading() as connection:
            found = overviews(connection, self.bounds, self.shifts, self.now())
        return self._page(
            question,
            "stations.html",
            stations=sorted(found, key=_urgency),
            alerts=list(alerts(found)),
            states=_STATES,
            lasting=lasting,
            problem_of=lambda each, kind: next(
                check for check in each.checks if check.kind.value == kind
            ),
        )


def _urgency(each: StationOverview) -> tuple[int, str]:
    return -[*CheckState].index(each.state), each.status.station


PLANT_PAGES: Final[Mapping[str, Callable[[Any, Question], Answer]]] = {
    **PAGES,
    STATIONS: PlantPages.stations,
}
"""Methods by route."""
