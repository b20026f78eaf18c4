"""What a deliberately wrong bootloader is, and what several of them are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeVar

from flasher.mock.memory import Flash, FlashNotErasedError, FlashRangeError
from flasher.mock.model import AnyRow, MockDevice
from flasher.mock.store import ApplicationStore
from flasher.protocol.frame import Frame
from flasher.protocol.wire import Damage, Message

__all__ = ["DECLARED", "AnyRow", "HangingDevice", "PlainFlash", "PlainStore", "Variant", "variant"]

_ANY: Final = "*"
_WrongT = TypeVar("_WrongT", bound=type[object])


@dataclass(frozen=True)
class Variant:
    """A device model that violates one clause, and is right in everything else."""

    name: str
    """In lower case, parted by hyphens."""
    clause: str
    """The case of the catalogue that it fails."""
    summary: str
    """What it does, in a line."""
    device_type: type[MockDevice] = MockDevice
    also: tuple[str, ...] = ()
    """Other cases that it may fail: what it does wrong is part of their stimulus too. Where no
    upgrade works, any case that needs a transfer may fail as well.
    """
    everywhere: bool = False
    """True when every transfer meets the fault, so that any case that has one may fail."""
    unseen: str = ""
    """Why no case sees it on a bench."""
    upgrade_works: bool = True
    """False when not even an undisturbed upgrade to an ordinary image (of some 1000 bytes, no
    multiple of 128) ends with that image running."""
    profile: Mapping[str, object] = field(default_factory=dict)
    """Choices of the device profile with which it shows; they are set when it is made."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Timings that are its fault."""


DECLARED: Final[list[Variant]] = []
"""All that the modules of this package declare."""


def variant(
    name: str,
    clause: str,
    summary: str,
    *,
    also: str = "",
    unseen: str = "",
    upgrade_works: bool = True,
    profile: Mapping[str, object] | None = None,
    timings: Mapping[str, float] | None = None,
) -> Callable[[_WrongT], _WrongT]:
    """Declares a class as what is wrong with a `Variant`: a device, or one of the parts that it is
    made of. The cases in `also` are parted by blanks; "*" stands for `everywhere`.
    """

    def declare(wrong: _WrongT) -> _WrongT:
        device_type = wrong if issubclass(wrong, MockDevice) else _device_with(wrong)
        others = () if also == _ANY else tuple(also.split())
        DECLARED.append(
            Variant(
                name,
                clause,
                summary,
                device_type,
                others,
                also == _ANY,
                unseen,
                upgrade_works,
                profile or {},
                timings or {},
            )
        )
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

    _hangs = False

    @property
    def hangs(self) -> bool:
        """True from when it hung up to the next power cut."""
        return self._hangs

    def receive(self, frame: Frame, now: float) -> None:
        if not self._hangs:
            super().receive(frame, now)

    def tick(self, now: float) -> None:
        if not self._hangs:
            super().tick(now)

    def deadline(self) -> float | None:
        return None if self._hangs else super().deadline()

    def next_frame(self, now: float) -> Frame | None:
        return None if self._hangs else super().next_frame(now)

    def power_cut(self, now: float) -> None:
        self._hangs = False
        super().power_cut(now)

    def _take(self, found: Message | Damage, now: float) -> None:
        if not self._hangs:
            super()._take(found, now)

    def _hang(self) -> str:
        """Nothing is heard, said or due from now on; what waited to be sent is lost."""
        self._lose_memory()
        self._hangs = True
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
