"""The upgrade step by step, as a case takes it to get somewhere: `reset_to_bootloader`,
`start_transfer`, `packet`, ... check what the device answers, and end the case when it is wrong.
"""

from __future__ import annotations

from flasher.conformance.hearing import Heard, Kind, describe
from flasher.conformance.model import Unsupported
from flasher.conformance.patient import UPDATES_MAX, PatientHost
from flasher.conformance.wire import packet_count


class Dialogue(PatientHost):
    """A patient host that can also go step by step."""

    def second_image(self) -> bytes:
        """Another image that runs, smaller. Raises Unsupported without one."""
        image = self.subject.second_image
        if image is None:
            raise Unsupported("the bench has no second good image")
        return image

    def filler(self, packets: int) -> bytes:
        """Bytes for a transfer that is never ended, so that nobody starts them; by the seed."""
        return self.random.randbytes(packets * 128)

    # -- steps ------------------------------------------------------------------------------------

    def reset_to_bootloader(self) -> Heard:
        """Reset the device; returns the first boot version. General feedback is not judged here."""
        self.forget()
        self.send(self.words.reset())
        limit_s = self.profile.limit("first_version_s")
        heard = self.wait_for(Kind.BOOT_VERSION, within_s=limit_s)
        return self.require_heard(heard, Kind.BOOT_VERSION.value, limit_s)

    def wait_to_be_heard(self) -> None:
        """After the first boot version: until the device takes the update command. That is at once,
        or when the burst is over (up_04_burst).
        """
        if self.profile.choice("up_04_burst") != "accepted":
            self.wait_for_window()

    def wait_for_window(self) -> None:
        """After the first boot version: until the middle of the window behind the last one."""
        limit, gaps = self.profile.limit, self.profile.number("versions") - 1
        self.wait(gaps * limit("version_spacing_s") + limit("window_s") / 2)
        self.forget()

    def next_version(self) -> Heard:
        """The next boot version of the burst."""
        spacing_s = self.profile.limit("version_spacing_s")
        return self.expect(Kind.BOOT_VERSION, within_s=4 * spacing_s)

    def update(self, size_bytes: int) -> Heard:
        """Get request transfer: the update command now, and at every boot version that follows
        (R2).
        """
        limit_s = self.profile.limit("erase_s")
        heard: Heard | None = None
        for _ in range(UPDATES_MAX):
            sent = self.send(self.words.update(size_bytes))
            heard = self.request_or_version(sent.left_at, limit_s)
            if heard is None or heard.kind is Kind.REQUEST:
                break
        if heard is not None and heard.kind is not Kind.REQUEST:
            heard = None
        found = self.require_heard(heard, Kind.REQUEST.value, limit_s)
        self.measure("update command to request transfer", found.at - sent.left_at)
        return found

    def start_transfer(self, size_bytes: int) -> None:
        """From the running application to request transfer."""
        self.reset_to_bootloader()
        self.update(size_bytes)

    def packet(self, image: bytes, number: int) -> None:
        """Send a packet of `image`; its ACK has to come."""
        sent = self.send_packet(image, number)
        heard = self.expect(Kind.ACK, within_s=self.profile.limit("ack_s"), number=number)
        self.measure("packet to ACK", heard.at - sent.left_at)

    def packets(self, image: bytes, first: int = 1, last: int | None = None) -> None:
        """Packets `first` to `last` (the last one of the image), each one acknowledged."""
        final = packet_count(len(image)) if last is None else last
        for number in range(first, final + 1):
            self.packet(image, number)

    def check_packet_rejected(self, wanted: int, named: int | None = None) -> bool:
        """The packet just sent was not taken: the answer is as the profile says (tx_01), with the
        number `wanted` by the device or the one that the packet `named` (None: any).
        """
        choice = self.profile.choice("tx_01")
        heard = self.collect(self.profile.limit("ack_s"))
        numbers = [one.number for one in heard if one.kind is Kind.NAK]
        if choice == "silence":
            return self.check(not heard, "no answer", describe(heard))
        if choice == "either":
            right = named is None or all(number in (wanted, named) for number in numbers)
            ok = right and len(numbers) == len(heard) <= 1
            return self.check(ok, "NAK or no answer", describe(heard))
        number = wanted if choice == "nak_expected" else named
        ok = len(numbers) == len(heard) == 1 and number in (None, numbers[0])
        return self.check(ok, "NAK" if number is None else f"NAK {number}", describe(heard))

    def end_transfer(self) -> None:
        """End of transfer; complete has to come."""
        sent = self.send(self.words.end())
        heard = self.expect(Kind.COMPLETE, within_s=self.profile.limit("complete_s"))
        self.measure("end of transfer to complete", heard.at - sent.left_at)

    def finish(self, image: bytes, first: int = 1) -> None:
        """The rest of a transfer from packet `first` on, its end, and the application it starts."""
        self.packets(image, first)
        self.end_transfer()
        self.check_application(image)
        self.check_stored(image)

    def check_upgrade(self, image: bytes | None = None) -> None:
        """The device can be upgraded from where it is: to `image`, or to the good one."""
        chosen = self.good_image if image is None else image
        done = self.upgrade(chosen)
        self.require(done.ok, "the device can be upgraded", done.reason or "it was")
        self.check_application(chosen)
        self.check_stored(chosen)

    # -- out of a transfer ------------------------------------------------------------------------

    def leave_transfer(self) -> None:
        """Abandon a transfer and be at an announcing bootloader without an application.

        By reset or a pause where the profile says that they end a transfer, else, or where they do
        not, by power. Raises Unsupported where nothing of it is there.
        """
        limit = self.profile.limit
        self.forget()
        within_s = limit("first_version_s")
        if self.profile.choice("tx_13") == "restarts":
            self.send(self.words.reset())
        elif self.profile.choice("tx_12") == "announces":
            within_s += limit("pause_s")
        elif not self.subject.has_power:
            raise Unsupported("no power control, and nothing else ends a transfer (tx_12, tx_13)")
        else:
            within_s = 0.0
        heard = self.wait_for(Kind.BOOT_VERSION, within_s=within_s)
        if heard is None and self.subject.has_power:
            self.power_cycle()
            within_s = limit("first_version_s")
            heard = self.wait_for(Kind.BOOT_VERSION, within_s=within_s)
        self.require_heard(heard, Kind.BOOT_VERSION.value, within_s)

    def without_application(self) -> None:
        """From the running application to an announcing bootloader that has none to start."""
        self.start_transfer(len(self.good_image))
        self.leave_transfer()
