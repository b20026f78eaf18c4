"""Runs a bootloader in a child process: starts, calls, watches and kills it."""

from __future__ import annotations

import os
import select
import signal
import tempfile
import traceback
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Final, Never

from flasher.conformance.dut import Facts, SubjectError, pipes
from flasher.conformance.dut.pipes import Pipe, PipeMessage
from flasher.conformance.results import LINE_JOINT
from flasher.errors import FlasherError, UsageError, printable

WATCHDOG_S: Final = 5.0
"""A call that takes longer in real time counts as not returning."""
_AFTER_HANG_S: Final = 0.5
"""The same once a call of this bootloader has not returned: most cases meet the same loop."""
_WAIT_S: Final = 0.01
_OUTPUT_SIZE: Final = 65_536
_LINES: Final = 80
_LINE_SIZE: Final = 240
_FILE_MAX_SIZE: Final = 64 * 1024 * 1024
"""A process that prints without end is ended, by SIGXFSZ, before it fills the disk."""
_DUMP_MARK: Final = "Shadow bytes around"
"""Start of the memory dump after AddressSanitizer's readable report."""
_STDIN, _STDOUT, _STDERR = range(3)
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
        self._process: int | None = None
        self._pipe = Pipe(-1, -1)
        self._poll = select.poll()
        self._watchdog_s = WATCHDOG_S

    @property
    def is_program(self) -> bool:
        """True for a program, which contains the code that answers the suite."""
        return self._is_program

    @property
    def is_running(self) -> bool:
        return self._process is not None

    def start(self) -> Facts:
        """Start a process and return its facts. Raises BootloaderError, and UsageError when it does
        not speak the protocol.
        """
        self.kill()
        if not self._is_program:  # loaded once, not in each process
            from flasher.conformance.dut import child  # noqa: F401, PLC0415
        self._stderr.seek(0)
        self._stderr.truncate()
        read_fd, its_write_fd = os.pipe()
        its_read_fd, write_fd = os.pipe()
        self._pipe = Pipe(read_fd, write_fd)
        try:
            if self._is_program and hasattr(os, "pidfd_open"):  # Linux
                self._process = self._spawn(its_read_fd, its_write_fd)
            else:
                self._process = os.fork()
                if not self._process:
                    self._pipe.close()
                    self._become_bootloader(its_read_fd, its_write_fd)
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
        doing = f"flasher_dut_{kind.name.lower()}"
        try:
            self._pipe.write(kind, *parts)
            while True:
                asked, data = self._next(doing)
                if asked is PipeMessage.DONE:
                    return asked, data
                if asked in {PipeMessage.APPLICATION, PipeMessage.RESET}:
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

    def kill(self) -> int | None:
        """Kill the process immediately, like a power cut. Returns its exit code, None without a
        process.
        """
        process, self._process = self._process, None
        if process is None:
            return None
        self._poll.unregister(self._pipe.read_fd)
        self._pipe.close()
        os.kill(process, signal.SIGKILL)  # until it is waited for, its number is its own
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])

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

    def _become_bootloader(self, read_fd: int, write_fd: int) -> Never:
        """Replace this child process by the bootloader."""
        try:
            # The suite handles Ctrl-C and signals to the process group, and ends this process.
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)
            import resource  # noqa: PLC0415  Windows has none, and no bootloader under test

            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_MAX_SIZE, _FILE_MAX_SIZE))
            os.dup2(self._stderr.fileno(), _STDERR)
            if self._is_program:
                os.dup2(read_fd, _STDIN)
                os.dup2(write_fd, _STDOUT)
                try:
                    os.execv(self.subject, [self.subject])  # noqa: S606  chosen by the user
                except OSError as error:
                    raise SubjectError(f"this computer cannot run it: {error.strerror}") from error
            os.dup2(_STDERR, _STDOUT)  # what it prints is no message
            from flasher.conformance.dut.child import serve  # noqa: PLC0415  only here

            serve(self.subject, Pipe(read_fd, write_fd))
        except SubjectError as error:
            os.write(_STDERR, str(error).encode(errors="replace"))
        except BaseException:  # noqa: BLE001  nothing of the suite may go on in this process
            os.write(_STDERR, traceback.format_exc(limit=-2).encode())
        finally:
            os._exit(1)

    def _next(self, doing: str) -> tuple[PipeMessage, bytes]:
        while (found := self._pipe.take()) is None:
            if not self._poll.poll(self._watchdog_s * 1000):
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
        assert self._process is not None  # noqa: S101  it was started
        for _ in range(round(WATCHDOG_S / _WAIT_S)):  # its pipe is closed a little sooner
            if os.waitid(os.P_PID, self._process, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                break
            select.select([], [], [], _WAIT_S)
        status = self.kill() or 0
        how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        return BootloaderError(f"the bootloader ended {how} in {doing}", cause=self.output())
