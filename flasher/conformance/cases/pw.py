"""PW: power cuts, and flash memory that fails.

The device stays reachable all the same, and never starts a mixture of two images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, POWER, Requirement, case
from flasher.conformance.patient_host import UPDATES_MAX
from flasher.conformance.results import Unsupported
from flasher.conformance.subject import FlashCall, FlashEffect, FlashFault, FlashFaults
from flasher.conformance.wire import (
    PACKET_BYTES,
    PACKET_FRAMES,
    Received,
    Reply,
    packet_count,
    version_in,
)

_ALL_PACKETS: Final = 8
"""An upgrade of up to this many packets is cut at each of its frames."""
_BETWEEN_MAX: Final = 6
"""Larger upgrades: packets between the first and last that are cut, each at a random frame."""
_FAR_PACKET: Final = 64
"""Cuts beyond this packet take so long on a real bus that only some are made."""
_FEW_FRAMES: Final = (1, 9, 17, 18)
_OFF_S: Final = 0.3
_ERASE_SHARES: Final = (0.1, 0.3, 0.5, 0.7, 0.9)
_JOURNAL_UPGRADES: Final = 130
"""More than the records that fill one page, which a device then erases (2 KiB, 16 bytes each)."""
_CUTS_IN_A_ROW: Final = 3
_SHARES: Final = (0.0, 0.5, 1.0)
"""Before, halfway through and after a flash operation."""
_OPERATIONS_MAX: Final = 24
"""Operations of one upgrade to cut; larger images only repeat similar ones."""
_EFFECTS: Final = {
    FlashCall.ERASE: (FlashEffect.ERROR, FlashEffect.WORN_SECTOR),
    FlashCall.WRITE: (FlashEffect.ERROR, FlashEffect.WORN_SECTOR, FlashEffect.WRONG_BIT),
    FlashCall.READ: (FlashEffect.WRONG_BIT,),
}
"""How each call of the flash driver can fail."""


class _Cut(NamedTuple):
    """A power cut after `frames` frames of a message: packet number `packet`, the update command
    (0), or end of transfer (number of packets + 1).
    """

    packet: int
    frames: int


@dataclass
class _InterruptedUpgrade:
    """The images of a case and the progress of the interrupted upgrade."""

    old: bytes
    new: bytes
    end_was_sent: bool = False
    was_requested: bool = False
    """True when the last attempt reached request transfer, so that the application is erased."""
    runs: bool = True
    """True while an application runs, so that a reset enters the bootloader."""

    operations: int = _OPERATIONS_MAX
    """About as many flash operations has an upgrade up to complete."""

    def swap(self) -> None:
        """Swap the images after the new one was installed."""
        self.old, self.new = self.new, self.old


@case(
    "PW-01",
    "power cuts in an upgrade",
    clause="R14; R19",
    stimulus="power cut at the frames of reset, update command, packets and end of transfer; while "
    "it erases, just after complete; before, in and after every flash operation (of many, the "
    f"first {_OPERATIONS_MAX}, and {_OPERATIONS_MAX} between end of transfer and complete), also "
    f"of those after complete, once and three times in a row; in {_JOURNAL_UPGRADES} upgrades, "
    "each flash operation that the others do not have",
    expectation="the device announces itself again, starts only complete images, and can be "
    "upgraded; acknowledged packets are stored, and a completed image runs",
    requires={DESTRUCTIVE, POWER, LONG},
    choices=("rs_03", "rs_03_old"),
    upgrades=1000,
)
def cuts(bench: Bench) -> None:
    upgrade = _upgrade(bench)
    for frames in range(1, len(bench.encoder.reset()) + 1):
        with bench.step(f"after frame {frames} of reset"):
            bench.send(bench.encoder.reset()[:frames])
            bench.power_cycle(_OFF_S)
            _check_after_cut(bench, upgrade)
    total = packet_count(len(upgrade.new))
    for cut in _cuts_at_frames(bench, upgrade.new):
        with bench.step(_cut_text(cut, total)):
            _upgrade_up_to(bench, upgrade, cut)
            bench.power_cycle(_OFF_S)
            _check_after_cut(bench, upgrade)
    _cut_erase(bench, upgrade)
    _cut_operations(bench, upgrade)
    _cut_after_ack(bench, upgrade)
    _cut_after_complete(bench, upgrade)
    _cut_start(bench, upgrade)
    _check_upgrade(bench, upgrade)


@case(
    "PW-02",
    "a second power cut, in the rescue",
    clause="R14; R19",
    stimulus="power cut in a transfer, and again: during the announcements, the erase, a packet, "
    "between two of them, before and at end of transfer",
    expectation="the device announces itself again, starts only complete images, and can be "
    "upgraded",
    requires={DESTRUCTIVE, POWER, LONG},
    choices=("rs_03",),
    upgrades=60,
)
def second_cut(bench: Bench) -> None:
    upgrade = _upgrade(bench)
    total = packet_count(len(upgrade.new))
    update, end = len(bench.encoder.update(1)), len(bench.encoder.end())
    second = [_Cut(0, 1), _Cut(0, update), _Cut(1, 9), _Cut(1, PACKET_FRAMES)]
    if total <= _FAR_PACKET:
        second += [_Cut(total, PACKET_FRAMES), _Cut(total + 1, end - 1), _Cut(total + 1, end)]
    else:
        why = f"the image has more than {_FAR_PACKET} packets"
        bench.unsupported("a second cut in the last packet and at end of transfer", why)
    for cut in second:
        with bench.step("first cut"):
            _upgrade_up_to(bench, upgrade, _Cut(1, 9))
            bench.power_cycle(_OFF_S)
            bench.await_message(Reply.BOOT_VERSION)
        with bench.step(f"second cut {_cut_text(cut, total)}"):
            upgrade.runs = False
            _upgrade_up_to(bench, upgrade, cut)
            bench.power_cycle(_OFF_S)
            _check_after_cut(bench, upgrade)
    _check_upgrade(bench, upgrade)


@case(
    "PW-04",
    "flash memory that fails",
    clause="Welling 5.1, figure 2 (end); R7; R14; R19",
    stimulus="upgrades in which an erase or write of the flash reports an error, once or in a "
    "worn-out sector, or in which a bit stays 1 without an error or is read wrong once: the first "
    "two calls of each kind, the middle one and the last two; then an upgrade without a fault",
    expectation="complete only when the flash holds the image and it starts, else any answer or "
    "none; only complete images run, and the device can be upgraded without the fault",
    requires={DESTRUCTIVE, POWER, LONG, Requirement.READBACK, Requirement.FAILING_FLASH},
    upgrades=200,
)
def failing_flash(bench: Bench) -> None:
    faults = bench.subject.flash_faults
    if faults is None:
        raise Unsupported("the flash of the device cannot be made to fail")
    upgrade = _upgrade(bench)
    with bench.step("without a fault"):
        faults.fail(None)
        bench.start_transfer(len(upgrade.new))
        bench.finish(upgrade.new)
        count = dict(faults.calls)
        bench.check_upgrade()
    for call, effects in _EFFECTS.items():
        total = count.get(call, 0)
        for number in sorted({0, 1, total // 2, total - 2, total - 1}.intersection(range(total))):
            for effect in effects:
                with bench.step(f"flash {call.value} {number + 1} of {total} {effect.value}"):
                    _fail(bench, faults, FlashFault(call, number, effect))


# -- the cuts -------------------------------------------------------------------------------------


def _cuts_at_frames(bench: Bench, image: bytes) -> Iterator[_Cut]:
    """Yield a cut at every frame of every message; of a large image only at some packets between
    the first and the last.
    """
    for frames in range(1, len(bench.encoder.update(len(image))) + 1):
        yield _Cut(0, frames)
    total = packet_count(len(image))
    for frames in range(1, PACKET_FRAMES + 1):
        yield _Cut(1, frames)
    if total <= _ALL_PACKETS:
        between = [_Cut(at, one) for at in range(2, total) for one in range(1, PACKET_FRAMES + 1)]
    else:
        numbers = sorted(bench.random.sample(range(2, min(total, _FAR_PACKET)), _BETWEEN_MAX))
        between = [_Cut(at, bench.random.randint(1, PACKET_FRAMES)) for at in numbers]
    yield from between
    if total > 1:
        for frames in _FEW_FRAMES if total > _FAR_PACKET else range(1, PACKET_FRAMES + 1):
            yield _Cut(total, frames)
    for frames in range(1, len(bench.encoder.end()) + 1):
        yield _Cut(total + 1, frames)


def _cut_text(cut: _Cut, total: int) -> str:
    what = {0: "the update command", total + 1: "end of transfer"}
    return f"after frame {cut.frames} of {what.get(cut.packet, f'packet {cut.packet}')}"


# -- the images -----------------------------------------------------------------------------------


def _upgrade(bench: Bench) -> _InterruptedUpgrade:
    """Upgrade between two images that can be distinguished; recorded as unsupported where they
    cannot.
    """
    upgrade = _InterruptedUpgrade(bench.good_image, bench.subject.second_image or bench.good_image)
    same = version_in(upgrade.old) == version_in(upgrade.new) or version_in(upgrade.old) is None
    if not bench.subject.has_readback and (same or not bench.encoder.has_version_query):
        bench.unsupported(
            "the image that runs after a cut is complete",
            "needs readback, or a version query and two images of different versions",
        )
    return upgrade


# -- an upgrade up to the cut ---------------------------------------------------------------------


def _enter(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Get request transfer, from the application or from a waiting bootloader."""
    upgrade.end_was_sent = False
    if upgrade.runs:
        bench.reset_to_bootloader()
    bench.update(len(upgrade.new))
    upgrade.runs = False


def _upgrade_up_to(bench: Bench, upgrade: _InterruptedUpgrade, cut: _Cut) -> None:
    """Perform the upgrade up to the cut."""
    total, encoder = packet_count(len(upgrade.new)), bench.encoder
    if not cut.packet:
        if upgrade.runs:
            bench.reset_to_bootloader()
        bench.wait_for_window()
        bench.send(encoder.update(len(upgrade.new))[: cut.frames])
        return
    _enter(bench, upgrade)
    bench.packets(upgrade.new, 1, min(cut.packet - 1, total))
    if cut.packet > total:
        upgrade.end_was_sent = True
        bench.send(encoder.end()[: cut.frames])
    else:
        bench.send(encoder.packet_of(upgrade.new, cut.packet)[: cut.frames])


def _check_upgrade(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Without a running application start from a power-up, since a listening bootloader may ignore
    the reset of a host (rs_03).
    """
    with bench.step("afterwards"):
        if not upgrade.runs:
            bench.power_cycle(_OFF_S)
        bench.check_upgrade()


def _check_after_cut(
    bench: Bench, upgrade: _InterruptedUpgrade, first: Received | None = None
) -> None:
    """Check that the device announces itself (`first` is its boot version) or starts an
    application, and that only a complete image runs.
    """
    if first is None and bench.wait_for(Reply.BOOT_VERSION) is None:
        # RS-05 checks that it should have announced itself.
        upgrade.runs = _check_whole(bench, upgrade)
        bench.require(
            upgrade.runs, Reply.BOOT_VERSION.value, "neither boot version nor application"
        )
        return
    spacing_s = bench.limit("version_spacing_s") + bench.limit("version_spacing_tolerance_s")
    replies = bench.collect(bench.waits.burst_s + 2 * spacing_s)
    announced = 1 + sum(one.kind is Reply.BOOT_VERSION for one in replies)
    # More than a burst means that it has no application to start.
    upgrade.runs = announced <= bench.number("versions") and _check_whole(bench, upgrade)
    if not upgrade.runs and bench.choice("rs_03_old") == "kept":
        bench.fail("the old application runs (rs_03_old)", "none is started")
    elif not upgrade.runs:
        bench.succeed("no application is started", "none")


def _check_whole(bench: Bench, upgrade: _InterruptedUpgrade) -> bool:
    """Check that the old image runs, or the new one if its end was sent. False when none runs."""
    images = [upgrade.old, upgrade.new] if upgrade.end_was_sent else [upgrade.old]
    if bench.encoder.has_version_query:
        version = bench.application_version(bench.limit("start_s"))
        if version is None:
            return False
        known = [version_in(image) for image in images]
        expected = f"a complete image runs, version {' or '.join(map(str, known))}"
        bench.require(None in known or version in known, expected, f"version {version!a}")
        images = [image for image in images if version_in(image) in (None, version)]
    elif not bench.application_runs():
        return False
    if bench.subject.has_readback:
        stored = bench.subject.readback()
        images = [image for image in images if stored[: len(image)] == image]
        got = "a complete one" if images else "a mixture"
        bench.require(bool(images), "the flash holds a complete image", got)
    if images == [upgrade.new]:
        upgrade.swap()
    return True


def _restore_old_image(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Install the old image so that there is an application to erase. Starts from a power-up, since
    a listening bootloader may ignore the reset of a host (rs_03).
    """
    if upgrade.runs:
        return
    bench.power_cycle(_OFF_S)
    done = bench.upgrade(upgrade.old, reset=False)
    bench.require(done.ok, "the device can be upgraded", done.reason or "it was")
    upgrade.runs = bench.application_runs()


# -- in the flash ---------------------------------------------------------------------------------


def _cut_erase(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Cut the power at several shares of the measured erase time."""
    _restore_old_image(bench, upgrade)
    upgrade.end_was_sent = upgrade.runs = False
    bench.reset_to_window()
    reply = bench.update(len(upgrade.new))
    erase_s = reply.at - bench.tester.left_at
    for share in _ERASE_SHARES:
        with bench.step(f"at {share:.0%} of the time until request transfer"):
            _restore_old_image(bench, upgrade)
            bench.reset_to_window()
            bench.send(bench.encoder.update(len(upgrade.new)))
            bench.wait(share * erase_s)
            bench.power_cycle(_OFF_S)
            _check_after_cut(bench, upgrade)


def _cut_operations(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Cut the power before, during and after each flash operation of an upgrade."""
    if not bench.subject.has_timed_cuts:
        bench.unsupported(
            "power cuts before, in and after every flash operation",
            "the start of a flash operation is not visible from outside",
        )
        return
    for operation in range(_OPERATIONS_MAX):
        for share in _SHARES:
            with bench.step(f"flash operation {operation + 1}, {share:.0%} of it done"):
                _begin(bench, upgrade)
                bench.subject.cut_in_operation(operation, share, _OFF_S)
                if not _was_cut(bench, upgrade, _upgrade_until_cut(bench, upgrade)):
                    upgrade.operations = operation
                    return
    _cut_end(bench, upgrade)


def _cut_end(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Cut the power in the flash operations between end of transfer and complete."""
    counts: dict[bytes, int] = {}
    if (faults := bench.subject.flash_faults) is not None:
        while upgrade.new not in counts:
            _begin(bench, upgrade)
            version = _upgrade_until_cut(bench, upgrade, at_end=lambda: faults.fail(None))
            counts[upgrade.new] = _operations(faults)
            _was_cut(bench, upgrade, version)
    for index in range(_OPERATIONS_MAX):
        for share in _SHARES:
            # An image that was completed before its cut has changed places with the other one.
            operation = _sampled(index, counts.get(upgrade.new, 0))
            named = f"flash operation {operation + 1} after end of transfer"
            with bench.step(f"{named}, {share:.0%} of it done"):
                _begin(bench, upgrade)
                cut = partial(bench.subject.cut_in_operation, operation, share, _OFF_S)
                if not _was_cut(bench, upgrade, _upgrade_until_cut(bench, upgrade, at_end=cut)):
                    return
    bench.info(
        f"of many flash operations the first {_OPERATIONS_MAX} of the upgrade were cut, and "
        f"{_OPERATIONS_MAX} between end of transfer and complete"
    )


def _sampled(index: int, count: int) -> int:
    """Operation number `index` of those to cut: of more than are tried, some at the beginning, some
    spread over all, and the last ones.
    """
    third = _OPERATIONS_MAX // 3
    if count <= _OPERATIONS_MAX or index < third:
        return index
    if index < 2 * third:
        return count * (index - third + 1) // (third + 1)
    return count - _OPERATIONS_MAX + index


def _begin(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Get a device that takes an update command."""
    if not upgrade.was_requested:
        _restore_old_image(bench, upgrade)
    if upgrade.runs:
        bench.reset_to_window()
    upgrade.end_was_sent = False


def _was_cut(bench: Bench, upgrade: _InterruptedUpgrade, version: Received | None) -> bool:
    """Check the device after the cut; False when the upgrade was completed without it."""
    if bench.subject.take_cut():
        _check_after_cut(bench, upgrade, version)
        return True
    got = "boot version, and no power cut"
    bench.require(version is None, "the update command is accepted", got)
    # EN-01 and EN-07 judge its result.
    upgrade.runs = bench.application_runs()
    upgrade.swap()
    return False


def _upgrade_until_cut(
    bench: Bench, upgrade: _InterruptedUpgrade, *, at_end: Callable[[], None] | None = None
) -> Received | None:
    """Upgrade until the device announces itself again; None when the upgrade was completed.
    `at_end` is called before end of transfer.
    """
    limit = bench.limit
    back_s = _OFF_S + limit("first_version_s")
    bench.forget()
    for _ in range(UPDATES_MAX):
        sent = bench.send(bench.encoder.update(len(upgrade.new)))
        reply = bench.host.request_or_version(sent.left_at, limit("erase_s") + back_s)
        was_deaf = reply is not None and reply.kind is Reply.BOOT_VERSION
        # Without an application, it may be deaf between two windows (R2, R14).
        if not was_deaf or not (at_end or bench.subject.is_cut_pending):
            break
    upgrade.was_requested = reply is not None and reply.kind is Reply.REQUEST
    for number in range(1, packet_count(len(upgrade.new)) + 1):
        if reply is None or reply.kind is Reply.BOOT_VERSION:
            return reply
        bench.send_packet(upgrade.new, number)
        reply = bench.wait_for(Reply.ACK, Reply.BOOT_VERSION, within_s=limit("ack_s") + back_s)
    if reply is None or reply.kind is Reply.BOOT_VERSION:
        return reply
    upgrade.end_was_sent = True
    if at_end:
        at_end()
    bench.send(bench.encoder.end())
    reply = bench.wait_for(
        Reply.COMPLETE, Reply.BOOT_VERSION, within_s=limit("complete_s") + back_s
    )
    return reply if reply is not None and reply.kind is Reply.BOOT_VERSION else None


def _cut_after_ack(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Check that acknowledged packets are still stored after a power cut (R10)."""
    written = 2 * PACKET_BYTES
    last = packet_count(written + bench.number("buffer_bytes"))
    with bench.step(f"after ACK {last}"):
        if not bench.subject.has_readback or packet_count(len(upgrade.new)) <= last:
            why = f"needs readback and {last + 1} packets"
            bench.unsupported("acknowledged packets are stored", why)
            return
        _enter(bench, upgrade)
        bench.packets(upgrade.new, 1, last)
        bench.power_off()
        with bench.step("the first two packets"):
            bench.check_stored(upgrade.new[:written])
        bench.wait(_OFF_S)
        bench.forget()
        bench.power_on()
        _check_after_cut(bench, upgrade)


def _cut_after_complete(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Check that a completed image runs after a power cut."""
    _restore_old_image(bench, upgrade)
    with bench.step("just after complete"):
        _enter(bench, upgrade)
        bench.packets(upgrade.new)
        bench.end_transfer()
        bench.power_cycle(_OFF_S)
        bench.wait_for(Reply.BOOT_VERSION)  # without one: RS-05
        bench.collect(bench.waits.burst_s)
        bench.check_image(upgrade.new)
        upgrade.runs = True
        upgrade.swap()


def _cut_start(bench: Bench, upgrade: _InterruptedUpgrade) -> None:
    """Cut the power in each flash operation between complete and the start of the application (a
    swap of banks, a copy, a journal). The completed image has to run.
    """
    if not bench.subject.has_timed_cuts:  # reported by `_cut_operations`
        return
    _restore_old_image(bench, upgrade)
    more = 0
    while more < _OPERATIONS_MAX and all(
        _cut_after(bench, upgrade, more, share) for share in _SHARES
    ):
        _cut_after(bench, upgrade, more, _SHARES[1], times=_CUTS_IN_A_ROW)
        more += 1
    before, faults = upgrade.operations, bench.subject.flash_faults
    are_many = max(before, more) >= _OPERATIONS_MAX
    if are_many and faults is None:
        what = "power cuts in flash operations that only some upgrades have"
        bench.unsupported(what, f"an upgrade has more than {_OPERATIONS_MAX} flash operations")
        return
    if upgrade.old != bench.good_image:  # else a device with two banks may go back to it
        bench.check_upgrade()
    if are_many and faults is not None:
        bench.reset_to_window()
        faults.fail(None)
        _upgrade_until_cut(bench, _InterruptedUpgrade(bench.good_image, bench.good_image))
        before = _operations(faults)
        bench.application_runs()
        more = _operations(faults) - before
    _cut_rare_operations(bench, bench.good_image, before, more)


def _operations(faults: FlashFaults) -> int:
    """Flash operations since `FlashFaults.fail`."""
    return faults.calls[FlashCall.ERASE] + faults.calls[FlashCall.WRITE]


def _cut_rare_operations(bench: Bench, image: bytes, before: int, more: int) -> None:
    """Upgrade to the same image so often that a journal begins a new page, and cut the power in
    the flash operations that only such an upgrade has. Up to complete other upgrades have about
    `before` operations, and `more` after it.
    """
    upgrade = _InterruptedUpgrade(image, image)
    while _cut_before(bench, upgrade, before):
        before += 1
    bench.application_runs()
    while before and not _cut_before(bench, upgrade, before - 1):
        bench.application_runs()
        before -= 1
    while _cut_after(bench, upgrade, more, _SHARES[0]):
        more += 1
    while more and not _cut_after(bench, upgrade, more - 1, _SHARES[0]):
        more -= 1
    bench.info(f"{before} flash operations before complete and {more} after it were cut")
    for turn in range(1, _JOURNAL_UPGRADES + 1):
        with bench.step(f"upgrade {turn} in a row"):
            if not _cut_before(bench, upgrade, before):
                _check_cuts(bench, upgrade, more, _SHARES[0])


def _cut_before(bench: Bench, upgrade: _InterruptedUpgrade, operation: int) -> bool:
    """Upgrade the running application, and cut the power before that flash operation. Returns
    whether it was cut; otherwise the new application starts.
    """
    with bench.step(f"before flash operation {operation + 1}"):
        bench.reset_to_window()
        upgrade.end_was_sent = False
        bench.subject.cut_in_operation(operation, _SHARES[0], _OFF_S)
        version = _upgrade_until_cut(bench, upgrade)
        was_cut = bench.subject.take_cut()
        if was_cut:
            _check_after_cut(bench, upgrade, version)
            _restore_old_image(bench, upgrade)
        upgrade.runs = True
    return was_cut


def _cut_after(
    bench: Bench, upgrade: _InterruptedUpgrade, operation: int, share: float, *, times: int = 1
) -> bool:
    """Complete an upgrade, and cut the power in that flash operation after it, and in the first one
    after each further restart. Returns whether it was cut.
    """
    named = f"flash operation {operation + 1} after complete, {share:.0%} of it done"
    with bench.step(f"{named}, {times} times in a row" if times > 1 else named):
        _enter(bench, upgrade)
        bench.packets(upgrade.new)
        bench.end_transfer()
        was_cut = _check_cuts(bench, upgrade, operation, share, times)
        upgrade.runs = True
        upgrade.swap()
    return was_cut


def _check_cuts(
    bench: Bench, upgrade: _InterruptedUpgrade, operation: int, share: float, times: int = 1
) -> bool:
    """After complete, cut the power; then check that the new image runs. Returns whether the device
    did that operation before its application ran.
    """
    subject, was_cut = bench.subject, False
    for turn in range(times):
        subject.cut_in_operation(0 if turn else operation, share, _OFF_S)
        deadline = bench.now + _OFF_S + bench.waits.restart_s
        while subject.is_cut_pending and bench.now < deadline:
            bench.wait(_OFF_S / 2)
        if not subject.take_cut():
            break
        was_cut = True
    if was_cut:
        bench.wait_for(Reply.BOOT_VERSION, within_s=_OFF_S + bench.limit("first_version_s"))
        bench.collect(bench.waits.burst_s)
        bench.check_image(upgrade.new)
    return was_cut


# -- a failing flash ------------------------------------------------------------------------------


def _fail(bench: Bench, faults: FlashFaults, fault: FlashFault) -> None:
    """Attempt an upgrade with a fault of the flash, check what runs, and upgrade without it."""
    upgrade = _InterruptedUpgrade(bench.good_image, bench.subject.second_image or bench.good_image)
    upgrade.end_was_sent = True
    faults.fail(fault)
    try:
        is_success = _attempt(bench, faults, upgrade.new)
        if is_success and not bench.is_kept_aside(upgrade.new):
            bench.check_stored(upgrade.new)  # before it starts
        bench.wait(bench.waits.restart_s)
    finally:
        faults.fail(None)
    bench.power_cycle(_OFF_S)
    bench.wait_for(Reply.BOOT_VERSION)  # without one: RS-05
    bench.collect(bench.waits.burst_s)
    if is_success and fault.call is not FlashCall.READ:
        bench.check_image(upgrade.new)
        upgrade.runs = True
    else:
        if is_success:
            upgrade.old = upgrade.new
        upgrade.runs = _check_whole(bench, upgrade)
    if not upgrade.runs:
        bench.power_cycle(_OFF_S)
    with bench.step("afterwards"):
        again = bench.upgrade(bench.good_image, reset=upgrade.runs)
        bench.require(again.ok, "the device can be upgraded", again.reason or "it was")
        bench.check_image(bench.good_image)


def _attempt(bench: Bench, faults: FlashFaults, image: bytes) -> bool:
    """Upgrade the running application; True when the device reported success after the fault."""
    bench.reset_to_window()
    sent = bench.send(bench.encoder.update(len(image)))
    reply = bench.host.request_or_version(sent.left_at, bench.limit("erase_s"))
    if reply is None or reply.kind is not Reply.REQUEST or not bench.host.transfer(image).ok:
        return False
    # What fails after complete (a swap of banks) cannot change the answer.
    answered_at = bench.now - bench.tester.wire_s(bench.encoder.end())
    return faults.failed_at is not None and faults.failed_at < answered_at
