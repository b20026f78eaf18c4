"""Base classes and declaration of deliberately wrong bootloaders (variants)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, TypeVar

from flasher.mock.memory import FlashMemory, FlashNotErasedError, FlashRangeError
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.store import ApplicationStore
from flasher.mock.table import BootloaderEvent
from flasher.protocol.messages import Malformed
from flasher.protocol.spec import Command, Mode
from flasher.protocol.wire import Message
from flasher.validation import json_keys

_ANY: Final = "*"
_SENTENCE_END: Final = re.compile(r"\.\s+(?=[A-Z])")
_WrongT = TypeVar("_WrongT", bound=type[object])


def bad_write(row: AnyMessage, command: Command) -> Message | None:
    """Return a malformed write of this command; None for other messages."""
    if not isinstance(row, Malformed):
        return None
    message = row.message
    return message if (message.command, message.mode) == (command, Mode.WRITE) else None


@json_keys("name clause also summary upgrade_works")
@dataclass(frozen=True)
class Variant:
    """Deliberately wrong bootloader: its clause, summary and device class."""

    # It violates one clause, and is right in everything else.

    name: str  # in lower case, parted by hyphens
    clause: str
    """Case of the conformance suite that it fails."""
    summary: str  # what it does, in a line
    device_type: type[MockDevice] = MockDevice
    also: tuple[str, ...] = ()
    """Other cases that it may fail."""
    # Their stimulus triggers the fault too. Where no upgrade works, any case that needs a transfer
    # may fail as well.
    everywhere: bool = False
    """Every transfer triggers the fault, so that any case with one may fail."""
    upgrade_works: bool = True
    """False when not even an undisturbed upgrade to an ordinary image succeeds."""
    # Ordinary: of some 1000 bytes, no multiple of 128. Well: with that image running.
    profile: Mapping[str, object] = field(default_factory=dict)
    """Profile options that are needed to show the fault."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Timings that are the fault."""


DECLARED: Final[list[Variant]] = []
"""All variants declared in this package."""


def variant(name: str, clause: str, *, also: str = "", **more: Any) -> Callable[[_WrongT], _WrongT]:
    """Declare a class as the faulty device, or part of a device, of a `Variant`. The first sentence
    of its docstring is the summary. The cases in `also` are separated by spaces; "*" means
    `everywhere`; `more` are further fields of the variant.
    """

    def declare(wrong: _WrongT) -> _WrongT:
        device_type = wrong if issubclass(wrong, MockDevice) else _device_with(wrong)
        is_any = also == _ANY
        others = () if is_any else tuple(also.split())
        sentence = _SENTENCE_END.split(" ".join((wrong.__doc__ or "").split()))[0].rstrip(".")
        summary = sentence[:1].lower() + sentence[1:]
        DECLARED.append(Variant(name, clause, summary, device_type, others, is_any, **more))
        return wrong

    return declare


def _device_with(part: type[object]) -> type[MockDevice]:
    """Create a device class with this part."""
    for attribute in ("reassembler_type", "store_type", "transfer_type"):
        if issubclass(part, getattr(MockDevice, attribute)):
            return type(part.__name__, (MockDevice,), {attribute: part})
    raise TypeError(f"{part.__name__} is not a part of a device")


class HangingDevice(MockDevice):
    """Device that can hang: it neither receives nor sends until its power is cut."""

    hangs = False
    in_ram: ClassVar[tuple[str, ...]] = ("hangs",)

    def _handle(self, event: BootloaderEvent, now: float) -> None:
        super()._handle(event, now)
        if self.hangs:
            self._is_deaf, self._runs_application = True, False

    def _hang(self) -> str:
        """Stop receiving and sending; unsent messages are lost."""
        self._lose_memory()
        self.hangs = self._is_deaf = True
        self._runs_application = False
        self._report("it hangs until its power is cut")
        return "hangs"


class PlainFlash(FlashMemory):
    """Flash without checks: programming again can only clear bits, as in plain NOR parts;
    programming outside has no effect.
    """

    def program(self, address: int, data: bytes) -> None:
        try:
            super().program(address, data)
        except FlashNotErasedError:
            offset = self._offset(address, len(data))
            old = self.read(address, len(data))
            both = bytes(before & after for before, after in zip(old, data, strict=True))
            self._put(offset, both)
            self._used_units.update(self._units(offset, len(data)))
            self.program_count += 1
        except FlashRangeError:
            return


class PlainStore(ApplicationStore):
    """Application store on a flash without checks."""

    flash_type = PlainFlash
