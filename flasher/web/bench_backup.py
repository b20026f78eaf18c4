"""Backup on the bench: the battery's answers and memory, saved to a file."""

from __future__ import annotations

from contextlib import suppress

from flasher import events
from flasher.errors import FlasherError
from flasher.host.query import memory_bytes
from flasher.protocol.contents import Memory
from flasher.protocol.spec import BMS
from flasher.settings.area import area_of_image, area_of_profile
from flasher.web.bench import BenchController, known
from flasher.web.bench_state import Activity


def find_areas(bench: BenchController) -> None:
    """Find memory areas for a backup in the images that fit: reading an address that does not
    exist may crash a device.
    """
    bench.adapter()
    bench.show(doing=Activity.JUDGING, areas=None)
    found = [area_of_profile(bench.backend.profile(BMS)) or bench.backend.model_area()]
    for path in bench.backend.images():
        if bench.cancelled():
            return
        with suppress(FlasherError):
            found.append(area_of_image(bench.job(path, BMS).plan.image))
    bench.show(areas=tuple(each for each in found if each is not None))


def leave_backup(bench: BenchController) -> None:
    bench.show(areas=None)


def back_up(bench: BenchController, source: str) -> None:
    """Save the battery's answers and the memory of this area; "" for no memory."""
    areas = {area.source: area for area in bench.state.areas or ()}
    area = known(areas, source) if source else None

    def happened(event: object) -> None:
        match event:
            case events.QueryAnswered(content=Memory() as piece):
                bench.show(saved_bytes=bench.state.saved_bytes + len(memory_bytes(piece)))

    bench.show(doing=Activity.SAVING, saved=None, saved_bytes=0)
    bench.check_same_bike(bench.state.battery)
    bench.show(
        saved=bench.backend.back_up(
            bench.adapter(), area, on_event=happened, cancelled=bench.cancelled
        ),
        areas=None,
    )
