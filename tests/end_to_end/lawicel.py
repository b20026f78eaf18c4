"""An slcan adapter as LAWICEL's CAN232 and CANUSB are, at a pseudo terminal, and what befalls it.

    with Lawicel(folder / "port") as adapter, adapter.device(MockDevice(...)):
        can.Bus(interface="slcan", channel=str(folder / "port"), ...)

`Program` is what the adapter's own processor does: commands in, answers out. `Lawicel` is the
adapter with its plug: a link (`flasher.bus.link`) on whose other side a device is driven.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Self

from flasher.bus.health import HealthKeeper, LinkHealth
from flasher.bus.link import MonotonicClock
from flasher.driver import drive
from flasher.protocol.engine import Engine
from flasher.protocol.frame import EXTENDED_ID_MAX, STANDARD_ID_MAX, Frame

OK: Final = b"\r"
ERROR: Final = b"\a"
BIT_RATES: Final = (10, 20, 50, 100, 125, 250, 500, 800, 1000)
"""In kbit/s, of the commands S0 to S8."""
_FRAME: Final = re.compile(rb"([tr])([0-9A-Fa-f]{3})([0-8])|([TR])([0-9A-Fa-f]{8})([0-8])")
_LINE: Final = re.compile(rb"[^\r]+\r?|\r")
_PIECE: Final = 4096
_GONE_S: Final = 0.01
"""Between two looks whether it is plugged in again."""


class Program:
    """The adapter's program. It knows what the documents of LAWICEL list, and refuses the rest."""

    def __init__(self, bus_kbit: int = 250) -> None:
        self._bus_kbit = bus_kbit
        self._held = b""
        self.kbit: int | None = None
        """The bit rate that was set."""
        self.is_open = False
        self.may_send = False
        self.has_stamps = False
        self.confirms_frames = True
        """Answers `z` and `Z` to a frame (auto poll), and not only CR."""
        self.refuses: Callable[[], bool] = lambda: False
        """Whether its transmit queue is full now."""
        self.commands: list[bytes] = []
        """All that came but for frames."""

    def take(self, data: bytes) -> Iterator[tuple[bytes, Frame | None]]:
        """The answer to each command in what came, and the frame that it sends on the bus."""
        *lines, self._held = (self._held + data).split(b"\r")
        for line in lines:
            frame = self._frame_of(line)
            if frame is None:
                yield self._answer(line), None
            elif not (self.is_open and self.may_send) or self.refuses():
                yield ERROR, None
            else:
                letter = b"Z" if frame.is_extended else b"z"
                yield (letter if self.confirms_frames else b"") + OK, self._on_bus(frame)

    def line_of(self, frame: Frame) -> bytes:
        """A frame of the bus as sent to the computer; nothing while it is closed."""
        if not self.is_open or self._on_bus(frame) is None:
            return b""
        letter = b"r" if frame.is_remote else b"t"
        can_id = b"%03X" % frame.can_id
        if frame.is_extended:
            letter, can_id = letter.upper(), b"%08X" % frame.can_id
        data = b"" if frame.is_remote else frame.data.hex().upper().encode()
        stamp = b"%04X" % (int(time.perf_counter() * 1000) % 60_000) if self.has_stamps else b""
        return letter + can_id + b"%d" % len(frame.data) + data + stamp + b"\r"

    def _on_bus(self, frame: Frame) -> Frame | None:
        """At another bit rate it neither understands the others nor they it."""
        return frame if self.kbit == self._bus_kbit else None

    def _answer(self, line: bytes) -> bytes:
        self.commands.append(line)
        match line[:1], line[1:]:
            case (b"", _):
                return OK
            case (b"S", number) if not self.is_open and number in (b"%d" % n for n in range(9)):
                self.kbit = BIT_RATES[int(number)]
            case (b"O" | b"L", b"") if not self.is_open and self.kbit is not None:
                self.is_open, self.may_send = True, line == b"O"
            case (b"C", b"") if self.is_open:
                self.is_open = False
            case (b"Z", b"0" | b"1") if not self.is_open:
                self.has_stamps = line == b"Z1"
            case (b"F", b"") if self.is_open:
                return b"F00\r"
            case (b"V", b""):
                return b"V1013\r"
            case (b"N", b""):
                return b"NA123\r"
            case _:
                return ERROR
        return OK

    @staticmethod
    def _frame_of(line: bytes) -> Frame | None:
        head = _FRAME.match(line)
        if head is None:
            return None
        short, short_id, short_size, long, long_id, long_size = head.groups()
        is_extended, is_remote = long is not None, (short or long) in (b"r", b"R")
        can_id, size = int(long_id or short_id, 16), int(long_size or short_size)
        rest = line[head.end() :]
        if can_id > (EXTENDED_ID_MAX if is_extended else STANDARD_ID_MAX):
            return None
        if is_remote:
            return None if rest else Frame(can_id, b"", is_extended, is_remote=True)
        try:
            data = bytes.fromhex(rest.decode("ascii"))
        except ValueError:
            return None
        return Frame(can_id, data, is_extended) if len(data) == size else None


class Damage:
    """Damages a share of the lines, in the ways of a bad plug and of a bad program."""

    def __init__(self, share: float, seed: int) -> None:
        self._share = share
        self._draw = random.Random(seed)
        self.lines = 0
        """How many were damaged."""

    def __call__(self, line: bytes) -> bytes:
        if self._draw.random() >= self._share:
            return line
        self.lines += 1
        draw = self._draw
        at = draw.randrange(len(line))
        match draw.randrange(7):
            case 0:  # a bit
                return line[:at] + bytes([line[at] ^ 1 << draw.randrange(8)]) + line[at + 1 :]
            case 1:  # a byte
                return line[:at] + draw.randbytes(1) + line[at + 1 :]
            case 2:  # bytes are lost, perhaps with the end of the line
                return line[:at] + line[at + draw.randrange(1, 6) :]
            case 3:  # a byte too many
                return line[:at] + draw.randbytes(1) + line[at:]
            case 4:  # garbage
                return line + draw.randbytes(draw.randrange(1, 64))
            case 5:  # twice
                return line + line
            case _:
                return b""


class Lawicel:
    """The adapter at the symbolic link `port`, pulled out and plugged in as its name says. A link
    for one device, which is driven in a thread.
    """

    def __init__(self, port: Path, program: Program | None = None) -> None:
        self.port = port
        self.program = program or Program()
        self.damage: Callable[[bytes], bytes] = lambda line: line
        """What becomes of a line to the computer."""
        self.damage_of_computer: Callable[[bytes], bytes] = lambda line: line
        """What becomes of a line from there."""
        self.is_slow = False
        """It writes in pieces of a few bytes, and reads as slowly."""
        self.traffic: Callable[[], list[Frame]] = list
        """What others say on the bus; asked for whenever it looks."""
        self.at_frame: dict[int, Callable[[], None]] = {}
        """What happens when the computer has sent so many frames."""
        self.failure: BaseException | None = None
        """What ended the device's thread."""
        self._frames = 0
        self._came: deque[Frame] = deque()
        self._ends: tuple[int, int] | None = None
        self._back_at: float | None = None

    # -- the plug --------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        self.pull()

    def plug(self) -> None:
        """Plug it in: a new terminal under the same name."""
        ours, theirs = os.openpty()
        tty.setraw(theirs)  # held open: a port stays there when a program closes it
        os.set_blocking(ours, False)
        self._ends, self._back_at = (ours, theirs), None
        new = self.port.with_suffix(".new")
        new.symlink_to(os.ttyname(theirs))
        new.replace(self.port)

    def pull(self, back_after_s: float | None = None) -> None:
        """Pull it out; the terminal of who has it open hangs up."""
        if self._ends is not None:
            self.port.unlink()
            for end in self._ends:
                os.close(end)
            self._ends = None
            self.program = Program()
        self._back_at = None if back_after_s is None else time.perf_counter() + back_after_s

    @contextmanager
    def device(self, engine: Engine) -> Iterator[None]:
        """A device on the other side of it, for as long as the block runs."""
        over = threading.Event()

        def run() -> None:
            try:
                drive(engine, self, MonotonicClock(), cancelled=over.is_set)
            except BaseException as failure:  # noqa: BLE001  reported by its caller
                self.failure = failure

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
        if self.failure is not None:
            raise self.failure

    # -- as a link, for the device ---------------------------------------------------------------

    def send(self, frame: Frame) -> None:
        """A frame of the device, to the computer."""
        line = self.program.line_of(frame)
        if line:
            self._write(self.damage(line))

    def receive(self, deadline: float) -> Frame | None:
        """A frame of the computer, to the device."""
        while not self._came:
            for frame in self.traffic():
                self.send(frame)
            left_s = deadline - time.perf_counter()
            if self._ends is None:
                if self._back_at is not None and time.perf_counter() >= self._back_at:
                    self.plug()
                elif left_s <= 0:
                    return None
                else:
                    time.sleep(min(_GONE_S, left_s))
                continue
            wait_s = max(0.0, min(left_s, _GONE_S))
            if select.select([self._ends[0]], [], [], wait_s)[0]:
                self._look(self._ends[0])
            elif left_s <= 0:
                return None
        return self._came.popleft()

    def drain(self) -> int:
        """Nothing is stale for a device."""
        return 0

    def close(self) -> None:
        """The block of the adapter does it."""

    def reopen(self) -> None:
        """It is the computer that has lost it."""

    is_off = False
    is_physical = False

    def health(self) -> LinkHealth:
        return HealthKeeper().health()

    def _look(self, ours: int) -> None:
        lines = _LINE.findall(os.read(ours, 5 if self.is_slow else _PIECE))
        came = b"".join(map(self.damage_of_computer, lines))
        for answer, frame in self.program.take(came):
            self._write(self.damage(answer))
            if frame is None:
                continue
            self._frames += 1
            self._came.append(frame)
            if self._frames in self.at_frame:
                self.at_frame[self._frames]()
                if self._ends is None:
                    return

    def _write(self, data: bytes) -> None:
        """A computer that reads nothing loses what does not fit."""
        step = 3 if self.is_slow else max(1, len(data))
        for start in range(0, len(data), step):
            if self._ends is not None:
                with contextlib.suppress(BlockingIOError):
                    os.write(self._ends[0], data[start : start + step])
            if self.is_slow:
                time.sleep(0)
