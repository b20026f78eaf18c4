"""Simulated hardware around a compiled bootloader: flash, CAN controller, power, application."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf
from struct import Struct
from typing import Final

from flasher.conformance.dut import CanFrame, pipes
from flasher.conformance.dut.failing_flash import FailingFlash
from flasher.conformance.dut.pipes import PipeMessage
from flasher.conformance.dut.process import BootloaderError, BootloaderProcess
from flasher.errors import FlasherError
from flasher.events import DeviceStateEntered
from flasher.mock.application import Application
from flasher.mock.bms import BmsApplication
from flasher.mock.machine import Machine
from flasher.mock.memory import FlashError, FlashMemory, Operation
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import AREA_START, MemoryMap, checksum_fits, with_checksum
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.bittime import frame_bits
from flasher.protocol.frame import Frame
from flasher.protocol.spec import DIALECTS, Node, Target
from flasher.protocol.text import find_firmware_version
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Damage, Message

POWER_ON: Final = 0
RESET: Final = 1
_RESTART_S: Final = 0.01
"""From a reset or watchdog to the first instruction."""
_IDLE_S: Final = 1.0
"""Passes of so much time may be made in one call, which the watchdog times."""
_US: Final = 1_000_000
_MAGIC: Final = b"FLASHERA"
_HEAD: Final = Struct("<II8sI")
_STACK: Final = 0x2000_1000
_ENTRY: Final = AREA_START + 0x101
_FLASH_PASSES_MAX: Final = 16
"""A call may read, erase, write and log this many times the size of the flash."""


def application_image(version: str, size_bytes: int, content: bytes = b"") -> bytes:
    """Make an image of `content` (default: filler) that the simulated application runs: it starts
    like a Cortex-M program and contains its size and checksum.
    """
    head = _HEAD.pack(_STACK, _ENTRY, _MAGIC, size_bytes) + version.encode("ascii") + b"\0"
    return with_checksum(head, size_bytes, content)


def _is_incomplete(area: bytes) -> bool:
    """True for erased flash and for an incomplete image of `application_image`."""
    if len(area) < _HEAD.size:
        return False
    _, _, magic, size_bytes = _HEAD.unpack_from(area)
    if magic != _MAGIC:
        return bool(magic == b"\xff" * len(_MAGIC))
    return not checksum_fits(area[:size_bytes])


class CompiledDevice(Machine):
    """A device that runs the bootloader of `process`, as an engine; initially without application.

    Raises FlasherError for a forbidden flash access and for a bootloader that ends or does not
    return; the device then restarts, as after a watchdog reset.
    """

    def __init__(self, target: Target, process: BootloaderProcess, *, bitrate_bps: int) -> None:
        self.target = target
        self._process = process
        self.facts = facts = process.start()
        process.kill()
        self.flash = FlashMemory(
            AREA_START - facts.application_offset,
            facts.flash_bytes,
            page_size_bytes=facts.sector_bytes,
            program_unit_bytes=facts.write_bytes,
        )
        self.flash_faults = FailingFlash(self.flash)
        profile = DeviceProfile()
        application = Application(target.node, DIALECTS[profile.dialect])
        if target.node is Node.BMS:
            application = BmsApplication(profile, MemoryMap(self.flash))
        super().__init__(
            application,
            frozenset((target.request_id,)),
            bitrate_bps=bitrate_bps,
            timings=DEFAULT_TIMINGS,
        )
        self.quiet_until: Callable[[], float] = lambda: -inf
        """Time until which no frame to the device is sent, and nobody acts on it."""
        self._skips_idle_passes = facts.abi >= pipes.ABI_WITH_ERRORS or not process.is_program
        self._has_power = False
        self._is_starting_application = False
        self._received: deque[CanFrame] = deque()
        self._to_send: deque[tuple[Frame, float]] = deque()
        """Frames in the controller, which sends them while the processor waits for the flash, and
        the ends of the calls that handed them over.
        """
        self._left_at = -inf
        """End of the frame that the bus took last."""
        self._is_full = False
        """The bootloader may have more frames to send than the controller had room for."""
        self._busy_until = -inf
        """Until then the processor executes a call or waits for the flash."""
        self._tick_at = inf
        self._called_at = 0.0
        self._handled_bytes = 0
        """Bytes that the current call has read, erased, written and logged."""
        self._operations = 0
        self._cut: tuple[int, float, float] | None = None
        self._cause = POWER_ON
        self._log: deque[str] = deque(maxlen=3)
        self.power_on(0.0)

    # -- the engine interface: the bootloader's part, else the machine's ---------------------------

    def receive(self, frame: Frame, now: float) -> None:
        if self._runs_application:
            super().receive(frame, now)
            return
        if self._off_bus_until is not None:
            self._rejoin_bus(now)
        is_deaf = self._off_bus_until is not None or not self._process.is_running
        if is_deaf or frame.is_error or len(self._received) >= self.facts.receive_frames:
            return
        self._received.append(CanFrame(*frame[:4]))
        self._call_when_free(now)

    def tick(self, now: float) -> None:
        super().tick(now)
        self._call_when_free(now)

    def deadline(self) -> float | None:
        due_at = inf if (found := super().deadline()) is None else found
        if self._process.is_running:
            turn_at = self._busy_until
            if not self._received and self._tick_at > turn_at:
                turn_at = self._tick_at
            if turn_at < due_at:  # noqa: PLR1730  as in the machine
                due_at = turn_at
        if self._to_send and self._to_send[0][1] < due_at and not self.is_off_bus:
            due_at = self._to_send[0][1]
        return None if due_at == inf else due_at

    def next_frame(self, now: float) -> Frame | None:
        if self._to_send:
            frame, ready_at = self._to_send[0]
            return frame if now >= ready_at and not self.is_off_bus else None
        return super().next_frame(now)

    def frame_sent(self, now: float) -> None:
        if self._to_send:
            # The bus may take a frame while the one before is on the wire.
            begins_at = max(now, self._left_at)
            self._left_at = begins_at + frame_bits(self._to_send.popleft()[0]) / self._bitrate_bps
            if self._is_full:
                self._tick_at = min(self._tick_at, self._left_at)
        else:
            super().frame_sent(now)

    # -- power and reset ---------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        return self._has_power

    def power_cut(self, now: float) -> None:
        self._has_power = False
        self._restart(POWER_ON, inf)

    def power_on(self, now: float) -> None:
        if not self._has_power:
            self._has_power = True
            self._restart(POWER_ON, now)

    def set_cut(self, operation: int, share: float, off_s: float) -> None:
        """Cut the power for `off_s` seconds when `share` (0 to 1) of flash operation number
        `operation` (counted from now) is done.
        """
        self._operations = 0
        self._cut = (operation, share, off_s)

    @property
    def is_cut_pending(self) -> bool:
        """True until the cut has happened or is cancelled."""
        return self._cut is not None

    def take_cut(self) -> bool:
        """True when the cut has happened; otherwise cancels it."""
        happened, self._cut = self._cut is None, None
        return happened

    def bus_off(self, now: float, off_s: float = 0.02) -> None:
        super().bus_off(now, off_s)
        self._to_send.clear()
        self._received.clear()
        self._tick_at = min(self._tick_at, now)  # the controller has room again

    def readback(self) -> bytes:
        return self.flash.read(AREA_START, self.facts.application_bytes)

    def _restart(self, cause: int, at: float) -> None:
        """Restart the bootloader at time `at`; RAM and pending work are lost."""
        self._process.kill()
        if self._runs_application:
            self.application.stop()
        self._runs_application = self._is_starting_application = False
        self._lose_memory()
        self._received.clear()
        self._to_send.clear()
        self._busy_until = -inf
        self._tick_at = inf
        self._cause = cause
        self._due_at = at

    def _expire(self, now: float) -> None:
        """Start the bootloader after a reset or power-up."""
        self._due_at = inf
        if self._is_starting_application:
            self._start_application(now)
            return
        if self._runs_application:
            self._restart(RESET, now)
            self._due_at = inf
        self._has_power = True
        cause = "power on" if self._cause == POWER_ON else "reset"
        self.emit(DeviceStateEntered("bootloader", cause))
        self._process.start()
        self._log.clear()
        self._call(PipeMessage.START, self._cause, now)

    # -- the running application -------------------------------------------------------------------

    def _take_message(self, message: Message, now: float) -> None:
        row = messages.decode(message) if message.can_id == self.target.request_id else None
        if isinstance(row, messages.ResetCommand):
            self.send(messages.GeneralFeedbackMessage().to_message(self.target.answer_id))
            self._due_at = now + _RESTART_S
        else:
            self.application.take(message, now)

    def _take_damage(self, damage: Damage, now: float) -> None:
        pass

    def _start_application(self, now: float) -> None:
        area = self.readback()
        if _is_incomplete(area):
            self._restart(POWER_ON, inf)  # its behaviour would be undefined
            raise FlasherError("the bootloader started an incomplete application")
        self._restart(RESET, inf)
        self._runs_application = True
        version = find_firmware_version(area.rstrip(b"\xff")) or "unknown"
        self.emit(DeviceStateEntered(BootloaderState.APPLICATION.value, f"version {version}"))
        self.application.start(version, now)

    # -- the bootloader ----------------------------------------------------------------------------

    @property
    def _next_turn_at(self) -> float:
        return max(self._tick_at, self._busy_until)

    def _call_when_free(self, now: float) -> None:
        """Pass received frames to the bootloader and call its tick, unless it is busy."""
        while self._process.is_running and self._received and now >= self._busy_until:
            frame = pipes.pack_frame(self._received.popleft())
            self._call(PipeMessage.RECEIVE, self._pending(now), now, frame)
        if self._process.is_running and now >= self._next_turn_at:
            until_us = max(0, int(self._quiet_until(now) * _US) - 1)
            until = pipes.TIME.pack(until_us) if self._skips_idle_passes else b""
            self._call(PipeMessage.TICK, self._pending(now), now, until)

    def _quiet_until(self, now: float) -> float:
        """Until then the bootloader is on its own: passes in which nothing happens need no call."""
        due = super().deadline()
        if self._pending(now) or self._received or self.is_off_bus:
            return 0.0
        return max(0.0, min(self.quiet_until(), now + _IDLE_S, inf if due is None else due))

    def _pending(self, now: float) -> int:
        return len(self._to_send) + (now < self._left_at)

    def _call(self, kind: PipeMessage, number: int, now: float, more: bytes = b"") -> None:
        self._handled_bytes = 0
        self._called_at = called_at = now
        try:
            answer = self._process.call(
                kind, pipes.TURN.pack(round(now * _US), number), more, during=self._hardware
            )
        except FlasherError as error:
            self._restart(RESET, now + _RESTART_S)
            if isinstance(error, BootloaderError) and self._log:
                lines = "; ".join(self._log)
                raise BootloaderError(
                    f"{error.what}; its last log lines: {lines}", cause=error.cause
                ) from error
            raise
        if answer is None:
            return
        how, data = answer
        if how is not PipeMessage.DONE and self._skips_idle_passes:
            now = max(now, pipes.TIME.unpack(data)[0] / _US)
        if how is PipeMessage.APPLICATION and now > called_at:
            self._restart(RESET, now)
            self._is_starting_application = True
        elif how is PipeMessage.APPLICATION:
            self._start_application(now)
        elif how is PipeMessage.RESET:
            self._restart(RESET, now + _RESTART_S)
        else:
            left_us, wanted_us = pipes.DONE.unpack_from(data)
            self._busy_until = max(now, left_us / _US)
            self._tick_at = inf
            if wanted_us != pipes.NEVER:
                is_later = wanted_us > left_us
                self._tick_at = (wanted_us if is_later else left_us + pipes.TURN_US) / _US
            size = pipes.FRAME.size
            for at in range(pipes.DONE.size, len(data), size):
                made = pipes.unpack_frame(data[at : at + size])
                self._to_send.append((Frame(*made[:4]), self._busy_until))
            self._is_full = self._pending(now) >= pipes.TRANSMIT_FRAMES

    def _hardware(self, asked: PipeMessage, data: bytes) -> bytes | None:
        """Perform a hardware function; None when it has no reply."""
        if asked is PipeMessage.LOG:
            self._count_bytes(pipes.HEADER.size + len(data))
            self._log.append(data.decode(errors="replace"))
            self._report(self._log[-1])
            return None
        try:
            return self._flash_operation(asked, data)
        except FlashError as error:
            row = pipes.RANGE if asked is PipeMessage.FLASH_READ else pipes.PLACE
            offset = row.unpack_from(data)[asked is not PipeMessage.FLASH_READ]
            # The bootloader knows offsets; addresses are those of the simulated application.
            what = error.what.replace(f" at 0x{self.flash.start + offset:08X}", "")
            raise FlashError(f"{asked.name.lower()} at offset 0x{offset:X}: {what}") from error

    def _flash_operation(self, asked: PipeMessage, data: bytes) -> bytes | None:
        """Read, erase or write flash; None when the power was cut."""
        if asked is PipeMessage.FLASH_READ:
            offset, size_bytes = pipes.RANGE.unpack(data)
            self._count_bytes(size_bytes)
            address = self.flash.start + offset
            return self.flash_faults.read(address, size_bytes, self._called_at)
        now_us, offset = pipes.PLACE.unpack_from(data)
        content = None if asked is PipeMessage.FLASH_ERASE else data[pipes.PLACE.size :]
        operation = Operation(self.flash.start + offset, content)
        takes_us, size_bytes = self.facts.erase_us, self.facts.sector_bytes
        if content is not None:
            takes_us = len(content) // self.facts.write_bytes * self.facts.write_us
            size_bytes = len(content)
        self._count_bytes(size_bytes)
        self._operations += 1
        if self._cut is not None and self._operations == self._cut[0] + 1:
            (_, share, off_s), self._cut = self._cut, None
            self.flash.tear(operation, share)
            self.power_cut(now_us / _US)
            self._due_at = (now_us + share * takes_us) / _US + off_s
            return None
        is_done = self.flash_faults.execute(operation, now_us / _US)
        if self.facts.abi < pipes.ABI_WITH_ERRORS:
            return pipes.TIME.pack(now_us + takes_us)
        return pipes.FLASH_RESULT.pack(now_us + takes_us, not is_done)

    def _count_bytes(self, size_bytes: int) -> None:
        self._handled_bytes += size_bytes
        if self._handled_bytes > _FLASH_PASSES_MAX * self.facts.flash_bytes:
            raise BootloaderError(
                "the bootloader read, erased, wrote and logged more than "
                f"{_FLASH_PASSES_MAX} times its flash in one call and was ended: it does not return"
            )
