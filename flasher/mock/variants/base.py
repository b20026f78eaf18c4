"""What a deliberately wrong bootloader is, and what several of them are made of."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, TypeVar

from flasher.mock.memory import Flash, FlashNotErasedError, FlashRangeError
from flasher.mock.model import AnyRow, MockDevice
from flasher.mock.store import ApplicationStore
from flasher.mock.table import BootloaderEvent
from flasher.protocol.messages import Malformed
from flasher.protocol.spec import Command, Mode
from flasher.protocol.wire import Message
from flasher.validation import json_keys

_ANY: Final = "*"
_SENTENCE_END: Final = re.compile(r"\.\s+(?=[A-Z])")
_WrongT = TypeVar("_WrongT", bound=type[object])


def bad_write(row: AnyRow, command: Command) -> Message | None:
    """A write of that command which is no row of the upgrade; None for anything else."""
    if not isinstance(row, Malformed):
        return None
    message = row.message
    return message if (message.command, message.mode) == (command, Mode.WRITE) else None


@json_keys("name clause also summary upgrade_works")
@dataclass(frozen=True)
class Variant:
    """A deliberately wrong device model."""

    # It violates one clause, and is right in everything else.

    name: str  # in lower case, parted by hyphens
    clause: str
    """The case that it fails."""
    summary: str  # what it does, in a line
    device_type: type[MockDevice] = MockDevice
    also: tuple[str, ...] = ()
    """Other cases that it may fail."""
    # What it does wrong is part of their stimulus too. Where no upgrade works, any case that needs
    # a transfer may fail as well.
    everywhere: bool = False
    """True when every transfer meets the fault, so that any case that has one may fail."""
    unseen: str = ""
    """Why no case sees it on a bench."""
    upgrade_works: bool = True
    """False when not even an undisturbed upgrade to an ordinary image ends well."""
    # Ordinary: of some 1000 bytes, no multiple of 128. Well: with that image running.
    profile: Mapping[str, object] = field(default_factory=dict)
    """Choices of the device profile with which it shows; they are set when it is made."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Timings that are its fault."""


DECLARED: Final[list[Variant]] = []
"""All that the modules of this package declare."""


def variant(name: str, clause: str, *, also: str = "", **more: Any) -> Callable[[_WrongT], _WrongT]:
    """Declares a class as what is wrong with a `Variant`: a device, or one of the parts that it is
    made of; the first sentence of its docstring is the summary. The cases in `also` are parted by
    blanks; "*" stands for `everywhere`; `more` are further fields of the variant.
    """

    def declare(wrong: _WrongT) -> _WrongT:
        device_type = wrong if issubclass(wrong, MockDevice) else _device_with(wrong)
        is_any = also == _ANY
        others = () if is_any else tuple(also.split())
        told = _SENTENCE_END.split(" ".join((wrong.__doc__ or "").split()))[0].rstrip(".")
        summary = told[:1].lower() + told[1:]
        DECLARED.append(Variant(name, clause, summary, device_type, others, is_any, **more))
        return wrong

    return declare


def _device_with(part: type[object]) -> type[MockDevice]:
    """A device that is made with this part, and is right in everything else."""
    for attribute in ("reassembler_type", "store_type", "transfer_type"):
        if issubclass(part, getattr(MockDevice, attribute)):
            return type(part.__name__, (MockDevice,), {attribute: part})
    raise TypeError(f"{part.__name__} is no part of a device")


class HangingDevice(MockDevice):
    """A device that can hang: deaf and dumb until its power is cut."""

    hangs = False
    in_ram: ClassVar[tuple[str, ...]] = ("hangs",)

    def _handle(self, event: BootloaderEvent, now: float) -> None:
        super()._handle(event, now)
        if self.hangs:
            self._is_deaf, self._runs_application = True, False

    def _hang(self) -> str:
        """Nothing is heard, said or due from now on; what waited to be sent is lost."""
        self._lose_memory()
        self.hangs = self._is_deaf = True
        self._runs_application = False
        self._report("it hangs until its power is cut")
        return "hangs"


class PlainFlash(Flash):
    """Flash that does not refuse: programmed again, bits that are 0 stay 0, as in plain NOR parts;
    programming outside of it goes nowhere.
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
    """The application on a flash that does not refuse."""

    flash_type = PlainFlash
