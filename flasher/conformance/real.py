"""Subject for a device on a real bus.

Any link; power by a command or function; readback by a command that dumps the flash to a file.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from flasher.bus.link import Clock, Link, StampingLink
from flasher.conformance.firmware import Firmware
from flasher.conformance.results import Unsupported
from flasher.conformance.subject import Arrival, FlashFaults
from flasher.conformance.wire import RawFrame
from flasher.errors import BusError, ErrorCode, UsageError
from flasher.files import read
from flasher.protocol.frame import Frame

PowerControl = Callable[[bool], None]
"""Called with True to switch the device on."""
Readback = Callable[[], bytes]
"""Returns the application area from its first byte on."""
HOST_UNCERTAINTY_S: Final = 0.002
"""Uncertainty of a frame's time: the adapter's driver and, where the kernel does not stamp incoming
frames, the computer's scheduler.
"""
_OWN_FRAMES: Final = 256
_SWITCH: Final = re.compile(r"\{([^{}|]*)\|([^{}|]*)\}")
_FILE: Final = "{file}"
_READBACK_LIMIT_S: Final = 60.0
_READBACK_MAX_SIZE: Final = 64 * 1024 * 1024
"""In bytes, far more than a device has."""


class RealPort:
    """A link as the bench's port; `echoes` says that the adapter echoes sent frames. Times come
    from the kernel if possible, otherwise from this process.
    """

    sends_error_frames = False

    def __init__(
        self,
        link: Link,
        clock: Clock,
        bitrate_bps: int,
        *,
        echoes: bool = False,
        uncertainty_s: float = HOST_UNCERTAINTY_S,
    ) -> None:
        self.bitrate_bps = bitrate_bps
        self.echoes = echoes
        self.uncertainty_s = uncertainty_s
        self._link = link
        self._clock = clock
        self._stamps = link if isinstance(link, StampingLink) and link.stamp_source else None
        source = "host" if self._stamps is None else self._stamps.stamp_source
        self.timestamp_source = f"{source}, sent frames by echo" if echoes else source
        self._last_at = clock.now()
        self._own: deque[Frame] = deque(maxlen=_OWN_FRAMES)
        self._has_echoed = False

    def now(self) -> float:
        return self._clock.now()

    def send(self, frame: RawFrame) -> None:
        """Hand a frame to the adapter. Raises Unsupported for a kind that a link cannot send."""
        if frame.is_error:
            raise Unsupported("an adapter sends no error frames")
        made = Frame(*frame)
        if not (self.echoes or self._has_echoed) and len(self._own) == _OWN_FRAMES:
            # None was echoed: an equal frame that arrives from now on is another node's (BU-06).
            self._own = deque(maxlen=0)
        self._own.append(made._replace(data=b"") if made.is_remote else made)
        self._link.send(made)

    def receive(self, deadline: float) -> Arrival | None:
        while (frame := self._link.receive(deadline)) is not None:
            stamped_at = None if self._stamps is None else self._stamps.received_at
            # Times never go back.
            at = max(self._last_at, self.now() if stamped_at is None else stamped_at)
            self._last_at = at
            frame = Frame(*frame[:5])  # ownership is decided here, not by the link
            is_own = self._take_own(frame)
            if self.echoes or not is_own:
                return Arrival(RawFrame(*frame[:5]), at, is_own)
        return None

    def _take_own(self, frame: Frame) -> bool:
        """True for an echo of a sent frame. With `echoes`, a lost echo does not hide later ones."""
        if self.echoes and frame in self._own:
            while self._own.popleft() != frame:
                pass
            return True
        if self._own and frame == self._own[0]:
            self._own.popleft()
            self._has_echoed = True
            return True
        return False


class RealSubject:
    """A device on an open adapter, by default without power control and readback."""

    has_own_clock = True
    has_bus_off = False
    has_timed_cuts = False
    flash_faults: FlashFaults | None = None

    def __init__(
        self,
        port: RealPort,
        target: str,
        good_image: bytes,
        *,
        name: str,
        second_image: bytes | None = None,
        power: PowerControl | None = None,
        readback: Readback | None = None,
    ) -> None:
        self.name = name
        self.target = target
        self.good_image = good_image
        self.second_image = second_image
        self.firmware = Firmware(good_image, second_image)
        self.has_power = power is not None
        self.has_readback = readback is not None
        self.port = port
        self._power = power
        self._readback = readback

    def power(self, *, on: bool) -> None:
        if self._power is None:
            raise Unsupported("the bench has no power control")
        self._power(on)

    def readback(self) -> bytes:
        if self._readback is None:
            raise Unsupported("the bench has no readback")
        return self._readback()

    def bus_off(self, for_s: float) -> None:
        raise Unsupported("a real device cannot be forced into bus-off")

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        raise Unsupported("the start of a flash operation is not visible from outside")

    @property
    def is_cut_pending(self) -> bool:
        return False

    def take_cut(self) -> bool:
        return False


class DevicePowerCommand:
    """Switches the power by a command such as `relay {on|off}`; the first word in braces is on.

    Raises UsageError for a command without braces.
    """

    def __init__(self, template: str, limit_s: float = 10.0) -> None:
        if not _SWITCH.search(template):
            raise UsageError(
                f"The power command {template!a} does not define on and off.",
                remedy="Write both in braces, like `relay 3 {on|off}`.",
            )
        self._template = _split(template, "power")
        self._limit_s = limit_s

    def __call__(self, on: bool) -> None:  # noqa: FBT001  it is the one argument
        """Switch the device. Raises BusError when the command fails or takes too long."""
        words = [_SWITCH.sub(r"\1" if on else r"\2", word) for word in self._template]
        _run(words, self._limit_s, "power")


class ReadbackCommand:
    """Reads the flash by a command such as `st-flash read {file} 0x8008000 0x18000`, which writes
    the application area to a file. Raises UsageError for a command without `{file}`.
    """

    def __init__(self, template: str) -> None:
        if _FILE not in template:
            raise UsageError(
                f"The readback command {template!a} has no {{file}}.",
                remedy="Write {file} in place of the output file.",
            )
        self._template = _split(template, "readback")

    def __call__(self) -> bytes:
        """Run the command and read its file. Raises BusError."""
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "readback.bin"
            words = [word.replace(_FILE, str(path)) for word in self._template]
            _run(words, _READBACK_LIMIT_S, "readback")
            try:
                return read(path, _READBACK_MAX_SIZE)
            except UsageError as error:
                raise _failed("readback", "wrote no readable file", words, error.what) from error


def _split(template: str, what: str) -> Sequence[str]:
    try:
        words = shlex.split(template)
    except ValueError as error:
        raise UsageError(f"The {what} command {template!a} is invalid: {error}.") from error
    return words


def _run(words: Sequence[str], limit_s: float, what: str) -> None:
    try:
        done = subprocess.run(  # noqa: S603  the user's own command
            words, check=False, capture_output=True, timeout=limit_s, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired as error:
        raise _failed(what, f"took longer than {limit_s:g} s", words) from error
    except OSError as error:
        raise _failed(what, f"cannot be run: {error.strerror}", words) from error
    if done.returncode:
        output = done.stderr.decode(errors="replace").strip()[-300:]
        raise _failed(what, f"failed with exit code {done.returncode}", words, ascii(output)[1:-1])


def _failed(what: str, how: str, words: Sequence[str], cause: str = "") -> BusError:
    return BusError(
        f"The {what} command {how}.",
        where=shlex.join(words),
        cause=cause,
        code=ErrorCode.COMMAND_FAILED,
    )
