"""What a profile holds: the choices for one target, each with where it comes from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, make_dataclass, replace
from typing import Any

from flasher.errors import ImageError
from flasher.host.identity import Identity
from flasher.host.options import UpgradeOptions
from flasher.host.query import Request
from flasher.image.image import Image
from flasher.image.plausible import Cpu
from flasher.profile.keys import GROUPS
from flasher.protocol.catalogue import Item
from flasher.protocol.contents import Empty, VersionInformation
from flasher.protocol.fields import Bytes, Content, Text, TextField
from flasher.protocol.fields import field as wire_field
from flasher.protocol.spec import WELLING, Command, Dialect, Mode, Node, Target, can_id, data_size
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings


def sent_ids(target: Target) -> dict[int, Node | None]:
    """The CAN ids that a device sends on, with their receivers; None is all."""
    receivers = (None, *(node for node in Node if node is not target.node))
    return {can_id(target.node, receiver): receiver for receiver in receivers}


@dataclass(frozen=True)
class ApplicationArea:
    """Where a device's application lies; what is outside of it must not be sent (R8)."""

    start: int
    size_bytes: int

    @property
    def end(self) -> int:
        """One past the last address."""
        return self.start + self.size_bytes


@dataclass(frozen=True)
class VersionQuery:
    """How to ask a device for its firmware version: a query without data, and where the text stands
    in the data of its answer.
    """

    command: int
    answer_id: int
    answer_command: int
    offset: int
    size_bytes: int

    def request(self, target: Target) -> Request:
        """The question for `flasher.host.query`; its answer is a `VersionAnswer`."""
        rest_bytes = data_size(self.answer_command) - self.offset - self.size_bytes
        answer = Item(
            target.node,
            sent_ids(target)[self.answer_id],
            Mode.REPORT,
            self.answer_command,
            _version_answer(self.offset, self.size_bytes, rest_bytes),
            "version",
        )
        item = Item(Node.CDL, target.node, Mode.READ, self.command, Empty, "read version")
        return Request(item, answer=answer)


class VersionAnswer(Content):
    """The answer to a version query that a profile describes."""

    firmware_version: Text


def _version_answer(before_bytes: int, text_bytes: int, behind_bytes: int) -> type[Content]:
    """The content of such an answer: what stands around the text is kept, not read."""
    return make_dataclass(
        "VersionAnswer",
        [
            ("before", bytes, wire_field(Bytes(before_bytes))),
            ("firmware_version", Text, wire_field(TextField(text_bytes))),
            ("behind", bytes, wire_field(Bytes(behind_bytes))),
        ],
        bases=(VersionAnswer,),
        frozen=True,
    )


def documented_query(target: Target) -> VersionQuery | None:
    """Version information as chapter 3 has it, for the BMS only."""
    if not target.has_version_query:
        return None
    offset = 0
    for name, codec in VersionInformation.LAYOUT:
        if name == "firmware_version":
            break
        offset += codec.size_bytes
    return VersionQuery(
        Command.READ_VERSION,
        target.broadcast_id,
        Command.VERSION_INFORMATION,
        offset,
        codec.size_bytes,
    )


@dataclass(frozen=True)
class Profile:
    """What holds for one target in one dialect. `sources` has "default" (a reading of this
    project), "document", or the path of a file for each name of `values()`.
    """

    target: Target
    dialect: Dialect = WELLING
    has_upgrade: bool = WELLING.has_upgrade
    """False where the document has cancelled the upgrade (section 6)."""
    timings: Timings = DEFAULT_TIMINGS
    attempts: int = UpgradeOptions.attempts
    timeout_s: float | None = None
    """Overall deadline; None computes one from the plan."""
    power_up_timeout_s: float = UpgradeOptions.power_up_timeout_s
    adapter_return_s: float = UpgradeOptions.adapter_return_s
    cpu: Cpu = Identity.cpu
    """What kind of program its images are expected to look like."""
    low_charge_percent: int = Identity.low_charge_percent
    """Below this state of charge there is a warning before an upgrade."""
    in_use_ma: int = Identity.in_use_ma
    """A discharge beyond this means that the vehicle is in use."""
    frame_gap_s: float = UpgradeOptions.frame_gap_s
    packet_gap_s: float = UpgradeOptions.packet_gap_s
    nak_next_is_ack: bool = UpgradeOptions.nak_next_is_ack
    reset_command: int = Command.RESET
    reset_data: bytes = b"RESET"
    """Restarts the application into the bootloader (R3)."""
    image_limit_bytes: int | None = None
    """Largest image that the device takes; None where nobody knows it."""
    application_area: ApplicationArea | None = None
    version_query: VersionQuery | None = None
    sources: Mapping[str, str] = field(default_factory=dict)

    def check_fits(self, image: Image) -> None:
        """Raise ImageError when the image is too large for the device, or lies outside of its
        application area (R8). What the profile does not know is not judged.
        """
        area = self.application_area
        limits = (self.image_limit_bytes, area.size_bytes if area else None)
        limit = min((each for each in limits if each is not None), default=None)
        if limit is not None and image.size_bytes > limit:
            raise ImageError(
                f"{image.source}: {image.size_bytes} bytes are more than the device takes, {limit}",
                where="the profile's limit",
                cause="a merged file, or an image for another device",
                remedy="choose the application with --range START:END",
            )
        if area is None or image.base is None:
            return
        if not area.start <= image.base <= image.base + image.size_bytes <= area.end:
            raise ImageError(
                f"{image.source} lies outside of the device's application area",
                where=f"0x{image.base:08X}..0x{image.base + image.size_bytes - 1:08X}, the area is "
                f"0x{area.start:08X}..0x{area.end - 1:08X}",
                cause="a merged file, or an image for another device",
                remedy="choose the application with --range START:END",
            )

    def upgrade_options(self, **overrides: Any) -> UpgradeOptions:
        """The options of an upgrade. `overrides` are its fields or those of `Timings`, by name;
        one that is None was not given. Raises TypeError for another name.

        The product's own version query is among them, not the document's: its answer tells the
        hardware version too.
        """
        given = {name: value for name, value in overrides.items() if value is not None}
        names = {known.name for known in fields(UpgradeOptions)}
        shared = {known.name: getattr(self, known.name) for known in fields(self)}
        timings = {
            known.name: given.pop(known.name) for known in fields(Timings) if known.name in given
        }
        options = {name: value for name, value in shared.items() if name in names}
        query = self.version_query
        if query is not None and query != documented_query(self.target):
            options["version_request"] = query.request(self.target)
        options |= given
        base: Timings = options["timings"]
        options["timings"] = replace(base, **timings)
        return UpgradeOptions(**options)

    def identity(self, **overrides: Any) -> Identity:
        """What is checked before an upgrade, with the limits of this product. `overrides` are the
        other fields of `Identity`.
        """
        return Identity(
            low_charge_percent=self.low_charge_percent,
            in_use_ma=self.in_use_ma,
            cpu=self.cpu,
            **overrides,
        )

    def values(self) -> Iterator[tuple[str, object]]:
        """Every value with its name; those of a table have the table's name before a point. A table
        that is not there is one value, None.
        """
        for name in (known.name for known in fields(self)):
            value = getattr(self, name)
            if name in GROUPS and value is not None:
                for part in fields(value):
                    yield f"{name}.{part.name}", getattr(value, part.name)
            elif name not in ("target", "dialect", "sources"):
                yield name, value
