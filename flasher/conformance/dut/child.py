"""Process of a bootloader that is a shared library or Python code, and the spawner that forks it.

The counterpart of `flasher_dut_process.c`.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from struct import Struct
from typing import Any, ClassVar, Final, Never, cast

from flasher.conformance.dut import Bootloader, CanFrame, Facts, SubjectError, pipes
from flasher.conformance.dut.pipes import Pipe, PipeMessage

FORK: Final = b"f"
END: Final = Struct("<d")
EXIT_CODE: Final = Struct("<i")
"""Messages between suite and spawner, which begins with `FORK`: fork a process for the two files of
its pipe; end it after so many seconds; how it ended.
"""
_WAIT_S: Final = 0.01
_FUNCTIONS: Final = tuple(
    f"flasher_dut_{name}" for name in ("about", "start", "receive", "tick", "next_frame")
)


class _ProcessHost:
    """Hardware functions that call the suite through the pipe."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self.now = 0
        self.pass_began = 0
        self.pending = 0
        self.is_idle = True
        """Nothing was sent to the suite in this pass."""

    def now_us(self) -> int:
        self.now += 1  # so that a loop that waits for a time ends
        return self.now - 1

    def flash_read(self, offset: int, size_bytes: int) -> bytes:
        self.is_idle = False
        self._pipe.write(PipeMessage.FLASH_READ, pipes.RANGE.pack(offset, size_bytes))
        return _next(self._pipe)[1]

    def flash_erase(self, offset: int) -> bool:
        self.is_idle = False
        self._pipe.write(PipeMessage.FLASH_ERASE, pipes.PLACE.pack(self.now, offset))
        return self._flash_result()

    def flash_write(self, offset: int, data: bytes) -> bool:
        self.is_idle = False
        self._pipe.write(PipeMessage.FLASH_WRITE, pipes.PLACE.pack(self.now, offset), data)
        return self._flash_result()

    def _flash_result(self) -> bool:
        result = _next(self._pipe)[1].ljust(pipes.FLASH_RESULT.size, b"\0")  # ABI 1: no error
        self.now, error = pipes.FLASH_RESULT.unpack(result)
        return not error

    def transmit_pending(self) -> int:
        return self.pending

    def start_application(self) -> None:
        self._pipe.write(PipeMessage.APPLICATION, pipes.TIME.pack(self.pass_began))
        os._exit(0)

    def reset(self) -> None:
        self._pipe.write(PipeMessage.RESET, pipes.TIME.pack(self.pass_began))
        os._exit(0)

    def log(self, text: str) -> None:
        self.is_idle = False
        self._pipe.write(PipeMessage.LOG, text.encode(errors="replace"))


# -- a shared library ------------------------------------------------------------------------------


class _Frame(ctypes.Structure):
    _fields_: ClassVar = [
        ("can_id", ctypes.c_uint32),
        *((name, ctypes.c_uint8) for name in ("length", "extended", "remote", "reserved")),
        ("data", ctypes.c_uint8 * 8),
    ]


class _Facts(ctypes.Structure):
    _fields_: ClassVar = [
        ("numbers", ctypes.c_uint8 * pipes.FACTS.size),
        ("name", ctypes.c_char_p),
    ]


_HOST: Final = {
    "now_us": ctypes.CFUNCTYPE(ctypes.c_uint64),
    "flash_read": ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32),
    "flash_erase": ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint32),
    "flash_write": ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32
    ),
    "transmit_pending": ctypes.CFUNCTYPE(ctypes.c_uint32),
    "start_application": ctypes.CFUNCTYPE(None),
    "reset": ctypes.CFUNCTYPE(None),
    "log": ctypes.CFUNCTYPE(None, ctypes.c_char_p),
}


class _HostTable(ctypes.Structure):
    _fields_: ClassVar = list(_HOST.items())


class _Library:
    """A shared library with the functions of the header, as a `Bootloader`."""

    def __init__(self, path: str) -> None:
        try:
            # Without a directory the loader would search the system's directories.
            self._library = library = ctypes.CDLL(os.path.abspath(path))  # noqa: PTH100
            for name in _FUNCTIONS:
                getattr(library, name)
        except (OSError, AttributeError) as error:
            raise SubjectError(str(error)) from error
        library.flasher_dut_about.restype = ctypes.POINTER(_Facts)
        library.flasher_dut_tick.restype = ctypes.c_uint64
        library.flasher_dut_tick.argtypes = [ctypes.c_uint64]
        about = library.flasher_dut_about()
        if not about:
            raise SubjectError("flasher_dut_about returns NULL")
        found = about.contents
        self.facts = pipes.unpack_facts(bytes(found.numbers) + (found.name or b""))
        self._table: _HostTable | None = None
        self._out = _Frame()

    def start(self, host: _ProcessHost, cause: int) -> None:
        def read(offset: int, data: int, size: int) -> None:
            ctypes.memmove(data, host.flash_read(offset, size), size)

        def erase(offset: int) -> int:
            return not host.flash_erase(offset)

        def write(offset: int, data: int, size: int) -> int:
            return not host.flash_write(offset, ctypes.string_at(data, size))

        def log(text: bytes) -> None:
            host.log(text.decode(errors="replace"))

        own: dict[str, Callable[..., Any]] = {
            "flash_read": read,
            "flash_erase": erase,
            "flash_write": write,
            "log": log,
        }
        calls = [made(own.get(name) or getattr(host, name)) for name, made in _HOST.items()]
        self._table = _HostTable(*calls)
        self._library.flasher_dut_start(ctypes.byref(self._table), cause)

    def receive(self, frame: CanFrame) -> None:
        packed = _Frame.from_buffer_copy(pipes.pack_frame(frame))
        self._library.flasher_dut_receive(ctypes.byref(packed))

    def tick(self, now_us: int) -> int | None:
        return cast("int", self._library.flasher_dut_tick(now_us))

    def next_frame(self) -> CanFrame | None:
        if not self._library.flasher_dut_next_frame(ctypes.byref(self._out)):
            return None
        return pipes.unpack_frame(bytes(self._out))


# -- the process -----------------------------------------------------------------------------------


def _make(subject: str) -> Bootloader:
    if os.path.exists(subject):  # noqa: PTH110  as the suite has seen it
        return cast("Bootloader", _Library(subject))
    try:
        made = _factory(subject)()
    except (Exception, SystemExit) as error:  # whatever the code of a user raises
        last = traceback.extract_tb(error.__traceback__)[-1]
        is_its = last.filename != __file__ and not last.filename.startswith("<")
        where = f" ({last.filename}, line {last.lineno})" if is_its else ""
        raise SubjectError(f"{type(error).__name__}: {error}{where}") from error
    if not isinstance(getattr(made, "facts", None), Facts):
        raise SubjectError(f"it returns {made!r}, which has no `facts`")
    return made


def _factory(subject: str) -> Callable[[], Bootloader]:
    name, _, attribute = subject.partition(":")
    found = importlib.import_module(name)
    for part in attribute.split("."):
        found = getattr(found, part)
    return cast("Callable[[], Bootloader]", found)


def _next(pipe: Pipe) -> tuple[PipeMessage, bytes]:
    """Read the next message; ends the process when the suite has ended."""
    while (found := pipe.take()) is None:
        if not pipe.fill():
            os._exit(0)
    return found


def end_process(process: int, after_s: float) -> int:
    """Wait `after_s` for the end of a child process, then kill it; return its exit code."""
    give_up_at = time.perf_counter() + after_s
    while not (ended := os.waitpid(process, os.WNOHANG))[0]:
        if time.perf_counter() >= give_up_at:
            os.kill(process, signal.SIGKILL)
            ended = os.waitpid(process, 0)
            break
        time.sleep(_WAIT_S)
    return os.waitstatus_to_exitcode(ended[1])


def spawner_command(*words: str | int) -> list[str]:
    """Command that runs `fork_each` with its arguments, and finds the modules that this process
    finds.
    """
    program = (
        "import sys; sys.path[:] = sys.argv[5:]; "
        f"from {__name__} import fork_each; fork_each(sys.argv[1], *map(int, sys.argv[2:5]))"
    )
    return [sys.executable, "-c", program, *map(str, words), *sys.path]


def fork_each(subject: str, is_program: int, control_fd: int, file_max_size: int) -> Never:
    """Fork a process for each start that the suite asks for, until the suite has ended."""
    import resource  # noqa: PLC0415  Windows has none, and no bootloader under test

    # Inherited by the processes. The suite ends them.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_max_size, file_max_size))
    sys.path.insert(0, os.getcwd())  # noqa: PTH109  as for `python -m`
    if not os.path.exists(subject):  # noqa: PTH110  a library loads quickly, and may begin threads
        with suppress(Exception, SystemExit):  # each start reports it
            _factory(subject)
    gc.freeze()  # else each process copies what the collector touches
    suite = socket.socket(fileno=control_fd)
    suite.send(FORK)
    while True:
        asked, files, _, _ = socket.recv_fds(suite, len(FORK), 2)
        if not asked:
            os._exit(0)
        process = os.fork()
        if not process:
            suite.close()
            _become_bootloader(subject, *files, is_program=bool(is_program))
        for file in files:
            os.close(file)
        if not (asked := suite.recv(END.size)):
            os._exit(0)
        suite.send(EXIT_CODE.pack(end_process(process, *END.unpack(asked))))


def _become_bootloader(subject: str, read_fd: int, write_fd: int, *, is_program: bool) -> Never:
    try:
        if not is_program:
            _serve(subject, Pipe(read_fd, write_fd))
        os.dup2(read_fd, 0)
        os.dup2(write_fd, 1)
        try:
            os.execv(subject, [subject])  # noqa: S606  chosen by the user
        except OSError as error:
            raise SubjectError(f"this computer cannot run it: {error.strerror}") from error
    except SubjectError as error:
        os.write(2, str(error).encode(errors="replace"))
    except BaseException:  # noqa: BLE001  the spawner goes on in its own process alone
        os.write(2, traceback.format_exc(limit=-2).encode())
    finally:
        os._exit(1)


def _serve(subject: str, pipe: Pipe) -> Never:
    """Run one start of the bootloader until it ends. `subject` is the path of a library or
    MODULE:FACTORY.
    """
    bootloader, host = _make(subject), _ProcessHost(pipe)
    pipe.write(PipeMessage.FACTS, pipes.pack_facts(bootloader.facts))
    while True:
        kind, data = _next(pipe)
        host.now, number = pipes.TURN.unpack_from(data)
        host.pass_began, until = host.now, 0
        if kind is PipeMessage.START:
            bootloader.start(host, number)
        else:
            host.pending = number
            if kind is PipeMessage.RECEIVE:
                bootloader.receive(pipes.unpack_frame(data[pipes.TURN.size :]))
            elif len(data) == pipes.TICK.size:
                until = pipes.TICK.unpack(data)[2]
        pipe.write(PipeMessage.DONE, *_turn(bootloader, host, until))


def _turn(bootloader: Bootloader, host: _ProcessHost, until: int) -> list[bytes]:
    """Make a pass of the main loop, and further ones until `until` as long as nothing happens in
    them; returns times and frames.
    """
    while True:
        host.is_idle = True
        wanted = bootloader.tick(host.now)
        due = pipes.NEVER if wanted is None else wanted
        frames: list[bytes] = []
        while host.pending + len(frames) < pipes.TRANSMIT_FRAMES:
            frame = bootloader.next_frame()
            if frame is None:
                break
            frames.append(pipes.pack_frame(frame))
        following = due if due > host.now else host.now + pipes.TURN_US
        if not host.is_idle or frames or following > until:
            return [pipes.DONE.pack(host.now, due), *frames]
        host.pass_began = host.now = following
