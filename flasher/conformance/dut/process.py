"""Runs a bootloader in a child process: starts, calls, watches and kills it."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Final

from flasher.conformance.dut import Facts, pipes
from flasher.conformance.dut.child import END, EXIT_CODE, FORK, end_process, spawner_command
from flasher.conformance.dut.pipes import Pipe, PipeMessage
from flasher.conformance.results import LINE_JOINT
from flasher.errors import FlasherError, UsageError, printable

WATCHDOG_S: Final = 5.0
"""A call that takes longer in real time counts as not returning."""
_WATCHDOG_PARTS: Final = 10
"""The time is waited in so many parts: a pause of this computer counts as one of them only."""
_AFTER_HANG_S: Final = 0.5
"""The same once a call of this bootloader has not returned: most cases meet the same loop."""
_SPAWNER_S: Final = 10.0
"""Real time in which a bootloader's module has to be loaded, and a process to end."""
_OUTPUT_SIZE: Final = 65_536
_LINES: Final = 80
_LINE_SIZE: Final = 240
_FILE_MAX_SIZE: Final = 64 * 1024 * 1024
"""A process that prints without end is ended, by SIGXFSZ, before it fills the disk."""
_DUMP_MARK: Final = "Shadow bytes around"
"""Start of the memory dump after AddressSanitizer's readable report."""
_STDIN, _STDOUT, _STDERR = range(3)
_CALLS: Final = {kind: f"flasher_dut_{kind.name.lower()}" for kind in PipeMessage}
_LIBRARY: Final = frozenset((".so", ".dylib"))


class BootloaderError(FlasherError):
    """The bootloader process ended or was killed during a call."""


class BootloaderProcess:
    """Runs one bootloader, each start in a new process. `subject` is the path of a program or
    shared library, or MODULE:FACTORY. Raises UsageError when it is unusable.
    """

    def __init__(self, subject: str) -> None:
        if not hasattr(os, "fork"):
            raise UsageError(
                "A bootloader under test needs a system with fork and pipes.",
                remedy="Use Linux, macOS, or WSL on Windows.",
            )
        self.subject = subject
        path = Path(subject)
        self._is_program = path.is_file() and not _LIBRARY.intersection(path.suffixes)
        if not path.is_file() and ":" not in subject:
            raise UsageError(
                f"There is no bootloader {printable(subject)}.",
                cause="it is not a file and not MODULE:FACTORY",
                remedy="Give a program, a shared library, or a function that returns a bootloader, "
                "as package.module:make.",
            )
        if self._is_program and not os.access(path, os.X_OK):
            raise UsageError(
                f"{printable(subject)} is not a program or shared library.",
                remedy="Link it with flasher_dut_process.c, or as a shared library (.so).",
            )
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as this object
        self._end: Callable[[float], int] | None = None
        """Ends the process that runs, after some seconds, and returns its exit code."""
        self._spawner: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._pipe = Pipe(-1, -1)
        self._poll = select.poll()
        self._watchdog_s = WATCHDOG_S

    @property
    def is_program(self) -> bool:
        """True for a program, which contains the code that answers the suite."""
        return self._is_program

    @property
    def is_running(self) -> bool:
        return self._end is not None

    def start(self) -> Facts:
        """Start a process and return its facts. Raises BootloaderError, and UsageError when it does
        not speak the protocol.
        """
        self.kill()
        self._stderr.seek(0)
        self._stderr.truncate()
        read_fd, its_write_fd = os.pipe()
        its_read_fd, write_fd = os.pipe()
        self._pipe = Pipe(read_fd, write_fd)
        try:
            if self._is_program and hasattr(os, "pidfd_open"):  # Linux
                self._end = partial(end_process, self._spawn(its_read_fd, its_write_fd))
            else:
                self._fork(its_read_fd, its_write_fd)
                self._end = self._end_forked
        finally:
            os.close(its_read_fd)
            os.close(its_write_fd)
        self._poll.register(read_fd, select.POLLIN)
        try:
            kind, data = self._next("flasher_dut_about")
            if kind is not PipeMessage.FACTS:
                raise ValueError("its first message contains no facts")  # noqa: TRY301
            return pipes.unpack_facts(data)
        except ValueError as error:
            self.kill()
            raise self.unusable(f"cannot be tested: {error}", self.output()) from error

    def call(
        self, kind: PipeMessage, *parts: bytes, during: Callable[[PipeMessage, bytes], bytes | None]
    ) -> tuple[PipeMessage, bytes] | None:
        """Call the bootloader; `during` answers its hardware requests.

        Returns the final message (DONE, APPLICATION or RESET) with its data, or None when `during`
        killed the process. Raises BootloaderError when the process ends or does not return.
        """
        doing = _CALLS[kind]
        try:
            self._pipe.write(kind, *parts)
            while True:
                asked, data = self._next(doing)
                if asked is PipeMessage.DONE:
                    return asked, data
                if asked in (PipeMessage.APPLICATION, PipeMessage.RESET):
                    self.kill()
                    return asked, data
                reply = during(asked, data)
                if not self.is_running:
                    return None
                if reply is not None:
                    is_read = asked is PipeMessage.FLASH_READ
                    self._pipe.write(
                        PipeMessage.FLASH_DATA if is_read else PipeMessage.FLASH_DONE, reply
                    )
        except (BrokenPipeError, ValueError):
            raise self._died(doing) from None

    def kill(self) -> None:
        """Kill the process immediately, like a power cut."""
        self._end_after(0.0)

    def _end_after(self, after_s: float) -> int:
        """Kill the process if it has not ended after `after_s`; return its exit code, 0 without a
        process.
        """
        end, self._end = self._end, None
        if end is None:
            return 0
        self._poll.unregister(self._pipe.read_fd)
        self._pipe.close()
        return end(after_s)

    def unusable(self, why: str, cause: str) -> UsageError:
        """Make the error for a subject that cannot be tested."""
        return UsageError(
            f"{printable(self.subject)} {why}.",
            cause=cause,
            remedy="Build it with the two files that `flasher conformance header` writes."
            if Path(self.subject).is_file()
            else "Give a function without arguments that returns a bootloader: an object with "
            "`facts` and the methods of flasher.conformance.dut.Bootloader.",
        )

    def close(self) -> None:
        """Kill the process and discard its output."""
        self.kill()
        self._end_spawner()
        self._stderr.close()

    def output(self) -> str:
        """Output of the process, such as a sanitizer report without its memory dump."""
        self._stderr.seek(0)
        lines = self._stderr.read(_OUTPUT_SIZE).decode(errors="replace").splitlines()
        report = takewhile(lambda line: not line.startswith(_DUMP_MARK), lines)
        shown = [printable(line)[:_LINE_SIZE] for line in report if line.strip(" =")]
        return LINE_JOINT.join(shown[:_LINES])

    def _spawn(self, read_fd: int, write_fd: int) -> int:
        """Start the program without a copy of this process, which takes five times as long."""
        import resource  # noqa: PLC0415  Windows has none, and no bootloader under test

        files = ((read_fd, _STDIN), (write_fd, _STDOUT), (self._stderr.fileno(), _STDERR))
        try:
            process = os.posix_spawn(
                self.subject,
                [self.subject],
                os.environ,
                file_actions=[(os.POSIX_SPAWN_DUP2, *each) for each in files],
                setpgroup=0,  # the suite handles Ctrl-C and signals to its group
                setsigdef=[signal.SIGXFSZ],
            )
        except OSError as error:
            self._pipe.close()
            why = f"this computer cannot run it: {error.strerror}"
            raise BootloaderError("the bootloader cannot be started", cause=why) from error
        resource.prlimit(process, resource.RLIMIT_FSIZE, (_FILE_MAX_SIZE, _FILE_MAX_SIZE))
        return process

    def _fork(self, read_fd: int, write_fd: int) -> None:
        """Have a process forked by the spawner, which is started first if there is none: a fork of
        this process, which holds all of the suite, takes several times as long, and copies locks of
        its other threads.
        """
        if self._spawner is None:
            self._control, control = socket.socketpair()
            with control:
                self._spawner = subprocess.Popen(  # noqa: S603  our own interpreter
                    spawner_command(
                        self.subject, int(self._is_program), control.fileno(), _FILE_MAX_SIZE
                    ),
                    stdin=subprocess.DEVNULL,
                    stdout=self._stderr,
                    stderr=self._stderr,
                    pass_fds=[control.fileno()],
                    process_group=0,  # the suite handles Ctrl-C and signals to its group
                )
            if not select.select([self._control], [], [], _SPAWNER_S)[0]:
                self._spawner.kill()
                self._pipe.close()
                raise BootloaderError(f"its module was not loaded within {_SPAWNER_S:g} s")
            self._control.recv(len(FORK))
        assert self._control is not None  # noqa: S101  as the spawner
        with suppress(ConnectionError):  # it has ended, which is seen at the pipe
            socket.send_fds(self._control, [FORK], [read_fd, write_fd])

    def _end_forked(self, after_s: float) -> int:
        assert self._control is not None  # noqa: S101  as the spawner
        self._control.settimeout(after_s + _SPAWNER_S)
        with suppress(OSError):  # also TimeoutError
            self._control.send(END.pack(after_s))
            if answer := self._control.recv(EXIT_CODE.size):
                return int(EXIT_CODE.unpack(answer)[0])
        return self._end_spawner()

    def _end_spawner(self) -> int:
        """End the spawner; return its exit code if it has ended by itself, like its module."""
        if self._spawner is None or self._control is None:
            return 0
        self._control.close()
        try:
            return self._spawner.wait(_SPAWNER_S)
        except subprocess.TimeoutExpired:
            self._spawner.kill()
            return self._spawner.wait()
        finally:
            self._spawner = None

    def _next(self, doing: str) -> tuple[PipeMessage, bytes]:
        while (found := self._pipe.take()) is None:
            part_ms = self._watchdog_s * 1000 / _WATCHDOG_PARTS
            if not any(self._poll.poll(part_ms) for _ in range(_WATCHDOG_PARTS)):
                self.kill()
                limit_s, self._watchdog_s = self._watchdog_s, min(WATCHDOG_S, _AFTER_HANG_S)
                raise BootloaderError(
                    f"the bootloader did not return from {doing} within {limit_s:g} s of real "
                    "time and was killed"
                )
            if not self._pipe.fill():
                raise self._died(doing)
        return found

    def _died(self, doing: str) -> BootloaderError:
        """The error for a process that ended or sent invalid data, with its output as cause."""
        status = self._end_after(WATCHDOG_S)  # its pipe is closed a little sooner
        how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        return BootloaderError(f"the bootloader ended {how} in {doing}", cause=self.output())
