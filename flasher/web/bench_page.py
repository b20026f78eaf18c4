"""Bench page: renders the bench's state as page parts, and submits orders from its forms."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from flasher.errors import UsageError
from flasher.files import parse_json
from flasher.host.waivers import WAIVERS
from flasher.i18n import Text, text, without_options
from flasher.protocol.contents import RunningInformation, VersionInformation
from flasher.protocol.fields import Content
from flasher.protocol.spec import TARGETS
from flasher.protocol.text import printable
from flasher.release.places import SUFFIX
from flasher.report.base import visible
from flasher.settings.profile import FILE_NAME as PROFILE
from flasher.trace.decoder import Field, content_fields
from flasher.translation import Translator
from flasher.web.bench import BenchController
from flasher.web.bench_backup import back_up, find_areas, leave_backup
from flasher.web.bench_bike import upgrade_bike
from flasher.web.bench_compare import compare
from flasher.web.bench_state import BenchState, Done
from flasher.web.bench_watch import watch
from flasher.web.feed import is_late, page_time
from flasher.web.pages import Pages, streamed
from flasher.web.series import SHOWN_S, take_next_bikes

UPLOAD: Final = "/bench/upload"
UPLOADS: Final = {UPLOAD: 32 * 1024 * 1024}
"""Maximum upload in bytes, above the largest image as Intel HEX."""
_FILES_MAX: Final = 200
"""Maximum number of files of a folder that are checked."""
_MANIFEST: Final = ".toml"


_ORDERS: Final[Mapping[str, tuple[Callable[..., None], tuple[str, ...]]]] = {
    "adapters": (BenchController.find_adapters, ()),
    "adapter": (BenchController.use_adapter, ("name",)),
    "look": (BenchController.look, ()),
    "watch": (watch, ()),
    "areas": (find_areas, ()),
    "compare": (compare, ()),
    "backup": (back_up, ("source",)),
    "no-backup": (leave_backup, ()),
    "target": (BenchController.choose_target, ("name",)),
    "images": (BenchController.judge, ()),
    "settings": (BenchController.keep_settings, ("keep",)),
    "waive": (BenchController.waive, ("name", "waiver")),
    "folder": (BenchController.use_folder, ("path",)),
    "image": (BenchController.choose_image, ("name",)),
    "bike": (BenchController.choose_bike, ()),
    "upgrade-bike": (upgrade_bike, ("selection",)),
    "upgrade": (BenchController.upgrade, ("selection",)),
    "next": (BenchController.start_over, ()),
    "rescue": (partial(BenchController.start_over, is_rescue=True), ()),
    "next-bikes": (take_next_bikes, ()),
    "rescue-it": (BenchController.rescue_it, ()),
    "rescue-unfinished": (BenchController.rescue_unfinished, ()),
}
"""Orders by the command of a form, with the names of their fields."""


class Shelf:
    """Folders with images: a chosen one, and one for files dropped on the page."""

    def __init__(
        self, folder: Path, dropped: Path, suffixes: Sequence[str], traces: Sequence[str]
    ) -> None:
        self.folder = folder
        self._dropped = dropped
        self.traces = dropped / "traces"
        self.traces.mkdir(exist_ok=True)
        self._suffixes = tuple(f".{suffix}" for suffix in suffixes)
        self._trace_suffixes = tuple(f".{suffix}" for suffix in traces)

    def use(self, folder: str) -> None:
        """Choose the folder. Raises UsageError if it does not exist or cannot be read."""
        path = None
        try:
            with suppress(RuntimeError):  # ~ of a user that does not exist
                path = Path(folder).expanduser()
            if not folder or path is None or not path.is_dir():
                raise UsageError(
                    text("{folder} is not a folder of this computer.", folder=printable(folder)),
                    remedy=text("Name one with its whole path, as in /home/me/firmware."),
                )
            next(path.iterdir(), None)
        except OSError as error:
            raise UsageError(
                text(
                    "{folder} cannot be read: {why}.",
                    folder=printable(folder),
                    why=error.strerror or str(error),
                ),
                remedy=text("Make the folder readable for this user, or name another one."),
            ) from error
        self.folder = path.resolve()

    def files(self) -> list[Path]:
        """Possible images, dropped ones first; one hides a file of its name in the folder."""
        # A release beside its image is opened with it.
        return self._found(
            lambda each: (
                each.suffix.lower() in self._suffixes and not _belongs_to_image(each, SUFFIX)
            )
        )

    def sets(self) -> list[Path]:
        """Possible sets of images, in the same order."""
        return self._found(
            lambda each: (
                each.suffix.lower() in (SUFFIX, _MANIFEST)
                and each.name != PROFILE
                and not _belongs_to_image(each, SUFFIX, _MANIFEST)
            )
        )

    def _found(self, is_wanted: Callable[[Path], bool]) -> list[Path]:
        found: dict[str, Path] = {}
        for folder in (self._dropped, self.folder):
            if folder.is_dir():
                for each in sorted(folder.iterdir()):
                    if is_wanted(each) and each.is_file():
                        found.setdefault(each.name, each)
        return list(found.values())[:_FILES_MAX]

    def dropped(self) -> list[str]:
        """Names of dropped images and manifests."""
        return sorted(visible(each.name) for each in self._dropped.iterdir() if each.is_file())

    def take(self, name: str, data: bytes) -> Path | None:
        """Store a dropped image, manifest or trace; None for any other file. Raises OSError."""
        plain = name.replace("\\", "/").rpartition("/")[2]
        suffix = Path(plain).suffix.lower()
        is_trace = suffix in self._trace_suffixes
        is_known = is_trace or suffix in (*self._suffixes, _MANIFEST)
        if not is_known or not plain.isprintable() or plain.startswith(".") or len(plain) > 200:
            return None
        path = (self.traces if is_trace else self._dropped) / plain
        path.write_bytes(data)
        return path


def _belongs_to_image(path: Path, *suffixes: str) -> bool:
    return path.suffix.lower() in suffixes and path.with_suffix("").is_file()


class BenchPage:
    """Routes of the bench page."""

    def __init__(
        self, pages: Pages, machine: BenchController, shelf: Shelf, *, is_mock: bool
    ) -> None:
        self._pages = pages
        self._bench = machine
        self._shelf = shelf
        self._is_mock = is_mock

    @property
    def routes(self) -> list[BaseRoute]:
        return [
            Route("/", self._page),
            Route("/bench/events", self._events),
            Route("/bench/sheet", self._sheet),
            Route("/bench/order", self._order, methods=["POST"]),
            Route(UPLOAD, self._upload, methods=["POST"]),
        ]

    async def _page(self, request: Request) -> Response:
        return self._pages.show(request, "bench.html", is_mock=self._is_mock)

    async def _sheet(self, request: Request) -> Response:
        state = self._bench.state
        is_saved = "save" in request.query_params
        ended = [each.done for each in state.devices if each.done is not None]
        if state.done is None:
            return Response("No upgrade has ended.", 404)
        upgrades = [(done, compared(done), identity(done)) for done in ended or [state.done]]
        page = self._pages.show(
            request,
            "bench_sheet.html",
            upgrades=upgrades,
            waivers=WAIVERS,
            without_options=without_options,
            is_saved=is_saved,
        )
        if is_saved:
            what = "bike" if ended else state.done.target.name
            name = f"{what}-{state.done.at:%Y%m%d-%H%M%S}.html"
            page.headers["content-disposition"] = f'attachment; filename="{name}"'
        return page

    async def _events(self, request: Request) -> Response:
        return streamed(self._messages(self._pages.translator_of(request)))

    async def _messages(self, translate: Translator) -> AsyncIterator[dict[str, Any]]:
        sent: dict[str, str] = {}
        async for batch in self._bench.feed.follow():
            message: dict[str, Any] = {"at": page_time()}
            for _, state in batch.changes[-1:]:
                parts = self._parts(translate, state)
                message["parts"] = {
                    name: text for name, text in parts.items() if sent.get(name) != text
                }
                sent = parts
            yield message
        yield {"ended": True}

    def _parts(self, translate: Translator, state: BenchState) -> dict[str, str]:
        selection = state.selection
        state = as_it_is_now(state)
        return self._pages.parts(
            translate, "bench_parts.html", state=state, selection=selection,
            targets=TARGETS.values(), folder=str(self._shelf.folder), is_mock=self._is_mock,
            facts=facts(state), left_s=left_s(state), battery_answers=battery_answers(state),
            waivers=WAIVERS, shown_s=SHOWN_S, without_options=without_options,
        )  # fmt: skip

    async def _order(self, request: Request) -> Response:
        try:
            order = parse_json(await request.body())
            word = order["order"]
            if word == "stop":
                self._bench.stop()
                return JSONResponse({})
            if is_late(order["shown_at"]):
                return JSONResponse({"error": "late"}, 412)
            if word == "agree":
                self._bench.agree(int(order["question"]))
                return JSONResponse({})
            step, fields = _ORDERS[word]
            values = [order[name] for name in fields]
            is_meant = all(isinstance(value, str) for value in values) and (
                word != "waive" or order["risk"] == "known"
            )
        except (ValueError, TypeError, KeyError):
            is_meant = False
        if not is_meant:
            return JSONResponse({"error": "no order"}, 400)
        if not self._bench.order(lambda bench: step(bench, *values)):
            return JSONResponse({"error": "busy"}, 409)
        return JSONResponse({})

    async def _upload(self, request: Request) -> Response:
        data = await request.body()
        name = request.query_params.get("name", "")
        try:
            path = await asyncio.to_thread(self._shelf.take, name, data)
        except OSError as error:
            return JSONResponse({"error": error.strerror}, 507)
        if path is None:
            return JSONResponse({"error": "no file of flasher"}, 415)
        if path.parent == self._shelf.traces:
            return JSONResponse({"page": f"/kept/story?{urlencode({'trace': path.name})}"})
        self._bench.file_came(path)
        return JSONResponse({})


# -- what is shown ---------------------------------------------------------------------------------

_SHORT: Final = (
    (VersionInformation, ("model", "serial_number", "hardware_version", "firmware_version")),
    (RunningInformation, ("state_of_charge_percent", "voltage_mv", "mean_current_ma")),
)
"""Facts of a battery in short: identity, and whether it can be upgraded now."""


def _rows(content: Content) -> dict[str, tuple[str, str]]:
    """Label and value of each field, by field name."""
    return {
        shown.name: (shown.label, _listed(shown) or f"{shown.text} {shown.unit}".rstrip())
        for shown in content_fields(content)
    }


def _listed(shown: Field) -> str:
    """Names of flags, separated for translation; "" for other fields."""
    names = shown.value if isinstance(shown.value, list) else []
    if not names or not all(isinstance(name, str) for name in names):
        return ""
    values = {f"name_{number}": text(name) for number, name in enumerate(names)}
    return Text(", ".join(f"{{{name}}}" for name in values), values)


def as_it_is_now(state: BenchState) -> BenchState:
    """Return the state with the answers after an upgrade in place of those before it; without any
    while the new application was not asked.
    """
    done = state.done
    if done is None or done.before is None or done.before.target is not done.target:
        return state
    has_changed = done.is_transferred or (done.error is not None and done.error.needs_rescue)
    return replace(state, bike=done.after) if has_changed else state


def facts(state: BenchState) -> list[tuple[str, str]]:
    """Short description of the battery, with its faults last."""
    if state.bike is None:
        return []
    answers = {type(each.answer): each.answer for each in state.bike.readings if each.answer}
    found = []
    for kind, names in _SHORT:
        answer = answers.get(kind)
        rows = {} if answer is None else _rows(answer)
        found += [rows[name] for name in names if name in rows]
    if state.bike.survey.faults is not None:
        found += _rows(state.bike.survey.faults).values()
    return found


def identity(done: Done) -> list[tuple[str, str]]:
    """Identity of the upgraded device; empty if it has no query."""
    if done.before is None or done.before.target is not done.target:
        return []
    version = done.before.version
    rows = {} if version is None else _rows(version)
    return [rows[name] for name in ("model", "serial_number", "hardware_version") if name in rows]


def battery_answers(state: BenchState) -> list[tuple[str, list[tuple[str, str]]]]:
    """All answers of the battery, as `flasher info` prints them: titles with rows."""
    bike = state.bike
    if bike is None:
        return []
    faults = bike.survey.faults
    found = [("faults", list(_rows(faults).values()) if faults else [("faults", bike.no_faults)])]
    answered = {each.title: each.answer for each in bike.readings if each.answer is not None}
    found += [(title, list(_rows(answer).values())) for title, answer in answered.items()]
    missing = [(each.title, each.why) for each in bike.readings if each.answer is None]
    return [*found, ("not answered", missing)] if missing else found


def compared(done: Done) -> list[tuple[str, str, str]]:
    """Every answer before and after the upgrade: label, old, new; "" if missing."""
    sides: list[dict[tuple[str, str], tuple[str, str]]] = []
    for seen in (done.before, done.after):
        side = {}
        for reading in () if seen is None or seen.target is not done.target else seen.readings:
            if reading.answer is not None:
                for name, row in _rows(reading.answer).items():
                    side[reading.name, name] = row
        sides.append(side)
    before, after = sides
    found = []
    for key in dict.fromkeys((*before, *after)):
        was, now = before.get(key, ("", "")), after.get(key, ("", ""))
        if was[1] or now[1]:
            found.append((was[0] or now[0], was[1], now[1]))
    return found


def left_s(state: BenchState) -> float | None:
    """Estimated seconds to the end of the transfer; None before the second packet."""
    if state.transfer_began_s is None or state.offer is None or state.packet < 2:
        return None
    took_s = state.now_s - state.transfer_began_s
    return took_s / (state.packet - 1) * (state.offer.packets - state.packet)
