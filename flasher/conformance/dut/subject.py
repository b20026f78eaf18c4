"""Subject for a compiled bootloader on a simulated bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

from flasher.conformance.dut.device import CompiledDevice, application_image
from flasher.conformance.dut.pipes import ABI_WITH_ERRORS
from flasher.conformance.dut.process import BootloaderError, BootloaderProcess
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.simulated import SimulatedSubject
from flasher.protocol.spec import TARGETS, WELLING


class CompiledSubject(SimulatedSubject[CompiledDevice]):
    """A device with the bootloader of `process`. Without `good_image` it uses images that the
    simulated application runs.
    """

    has_own_clock = True

    def __init__(
        self,
        process: BootloaderProcess,
        target: str,
        *,
        good_image: bytes | None = None,
        second_image: bytes | None = None,
    ) -> None:
        device = CompiledDevice(TARGETS[target], process, bitrate_bps=WELLING.bitrate_bps)
        super().__init__(
            device,
            target,
            application_image,
            sector_bytes=device.facts.sector_bytes,
            area_bytes=device.facts.application_bytes,
            name=f"{device.facts.name or 'the bootloader'} ({process.subject})",
            good_image=good_image,
            second_image=second_image,
        )
        self.bus.attach(device)
        device.quiet_until = self.port.quiet_until
        if device.facts.abi >= ABI_WITH_ERRORS:
            self.flash_faults = device.flash_faults

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        self.device.set_cut(operation, share, off_s)

    @property
    def is_cut_pending(self) -> bool:
        return self.device.is_cut_pending

    def take_cut(self) -> bool:
        return self.device.take_cut()


@contextmanager
def open_subject(
    what: str,
    target: str,
    profile: ConformanceProfile | None,
    *,
    good_image: bytes | None,
    second_image: bytes | None,
) -> Iterator[tuple[CompiledSubject, ConformanceProfile]]:
    """Open the bootloader named `what` (see `BootloaderProcess`). The profile gets the bootloader's
    own sizes where it does not set them. Raises UsageError.
    """
    with closing(BootloaderProcess(what)) as process:
        try:
            subject = CompiledSubject(
                process, target, good_image=good_image, second_image=second_image
            )
        except BootloaderError as error:
            raise process.unusable(f"does not start: {error.what}", error.cause) from error
        profile = profile or ConformanceProfile()
        size_bytes = subject.device.facts.application_bytes
        area_bytes = profile.given.get("device.application_bytes", size_bytes)
        sizes = {"device.application_bytes": size_bytes, "device.largest_image_bytes": area_bytes}
        yield subject, replace(profile, given={**sizes, **profile.given})
