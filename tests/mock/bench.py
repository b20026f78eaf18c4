"""A device on a virtual clock: frames in, whole messages out, each with the time of its start."""

from __future__ import annotations

from typing import Final, NamedTuple, TypeVar

from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, FRAME_DATA_SIZE, PACKET_DATA_SIZE, WELLING, Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Message, Reassembler, encode, split

START_S: Final = 1000.0
"""The clock does not begin at 0, as none does."""
QUICK: Final = DeviceProfile(
    application_area_bytes=256 * 1024, erase_time_s=0.0, program_time_s=0.0
)
"""Everything the document leaves open as by default, flash in no time and soon made."""
SMALL: Final = DeviceProfile(
    application_area_bytes=1024, page_size_bytes=256, erase_time_s=0.02, program_time_s=0.002
)
"""Four pages of application, each operation with a time of its own."""
_ENOUGH_S: Final = 60.0
_BLOCKED_STEP_S: Final = 0.01
_EventT = TypeVar("_EventT")


class VersionQuery:
    """The tool asks the application for its version."""

    def to_message(self, can_id: int) -> Message:
        return Message(can_id, 0x11, 0x3300, b"")


READ_VERSION: Final = VersionQuery()


class Sent(NamedTuple):
    """A whole message that the device has sent."""

    at_s: float
    can_id: int
    wire: bytes


def image_of(size_bytes: int, version: str = "V2r0r0_20260101", seed: int = 7) -> bytes:
    """An image that carries a version, and no two packets of it alike."""
    body = version.encode("ascii")
    body += bytes((seed * index + index // 128) % 251 for index in range(size_bytes))
    return body[:size_bytes]


def packets_of(image: bytes) -> list[messages.Packet]:
    """The packets of an image, the last one filled with FF."""
    total = -(-len(image) // PACKET_DATA_SIZE)
    return [
        messages.Packet(
            number,
            total,
            image[(number - 1) * PACKET_DATA_SIZE : number * PACKET_DATA_SIZE].ljust(
                PACKET_DATA_SIZE, b"\xff"
            ),
        )
        for number in range(1, total + 1)
    ]


class Bench:
    """Runs one device; what it sends is accepted at once."""

    def __init__(
        self,
        profile: DeviceProfile = QUICK,
        *,
        target: Target = BMS,
        has_application: bool = True,
        timings: Timings = DEFAULT_TIMINGS,
    ) -> None:
        self.now = START_S
        self.target = target
        self.device = MockDevice(
            target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=profile,
            timings=timings,
            has_application=has_application,
        )
        self.events: list[object] = []
        self.accepts_frames = True
        self._sent: list[Sent] = []
        self._partial = b""
        self._partial_at = 0.0

    # -- time -------------------------------------------------------------------------------------

    def run(self, duration_s: float) -> None:
        """Let time pass, ticking exactly when the device asks for it."""
        self.run_until(self.now + duration_s)

    def run_until(self, until_s: float) -> None:
        self._collect()
        while (wanted := self.device.deadline()) is not None and wanted <= until_s:
            # With a frame that the bus does not take, the deadline stays in the past.
            step_s = 0.0 if self.accepts_frames else _BLOCKED_STEP_S
            self.now = max(self.now + step_s, wanted)
            self.device.tick(self.now)
            self._collect()
            if self.now > until_s:
                break
        self.now = max(self.now, until_s)

    def run_to(self, state: BootloaderState) -> None:
        """Let time pass until the device is in that state."""
        end = self.now + _ENOUGH_S
        while self.device.state is not state:
            wanted = self.device.deadline()
            assert wanted is not None, f"{self.device.state} waits for ever"
            assert wanted < end, f"{state} did not come"
            self.run_until(max(wanted, self.now))

    def _collect(self) -> None:
        while self.accepts_frames and (frame := self.device.next_frame(self.now)) is not None:
            if not self._partial:
                self._partial_at = self.now
            self._partial += frame.data
            # No message of this protocol's upgrade fills its last frame.
            if len(frame.data) < FRAME_DATA_SIZE:
                self._sent.append(Sent(self._partial_at, frame.can_id, self._partial))
                self._partial = b""
            self.device.frame_sent(self.now)
        self.events += self.device.take_events()

    def is_in(self, state: BootloaderState) -> bool:
        return self.device.state is state

    # -- to the device ----------------------------------------------------------------------------

    def put(self, *frames: Frame) -> None:
        """Frames as they are."""
        for frame in frames:
            self.device.receive(frame, self.now)
            self._collect()

    def put_wire(self, wire: bytes, can_id: int | None = None) -> None:
        """A message as bytes, whatever it is worth."""
        self.put(*split(self.target.request_id if can_id is None else can_id, wire))

    def put_hex(self, text: str) -> None:
        self.put_wire(bytes.fromhex(text))

    def send(self, *rows: messages.UpgradeMessage | VersionQuery) -> None:
        for row in rows:
            self.put_wire(self.encoded(row))

    def encoded(self, row: messages.UpgradeMessage | VersionQuery) -> bytes:
        return encode(row.to_message(self.target.request_id))

    # -- from the device --------------------------------------------------------------------------

    def take_sent(self) -> list[Sent]:
        """Whole messages since the last call."""
        self._collect()
        sent, self._sent = self._sent, []
        return sent

    def take_hex(self) -> list[str]:
        return [sent.wire.hex() for sent in self.take_sent()]

    def take(self) -> list[object]:
        """The same, decoded by the protocol's own reassembler."""
        rows: list[object] = []
        for sent in self.take_sent():
            reassembler = Reassembler(sent.can_id, DEFAULT_TIMINGS.inter_frame_timeout_s)
            (found,) = reassembler.feed(sent.wire, 0.0)
            assert isinstance(found, Message)
            rows.append(messages.decode(found))
        return rows

    def events_of(self, kind: type[_EventT]) -> list[_EventT]:
        self._collect()
        return [event for event in self.events if isinstance(event, kind)]

    # -- the dialogue -----------------------------------------------------------------------------

    def update_row(self, size_bytes: int) -> messages.UpdateCommand:
        return messages.UpdateCommand(self.target.update_text, size_bytes)

    def enter_bootloader(self) -> None:
        """Reset the application; the first announcement has been sent afterwards."""
        self.send(messages.ResetCommand())
        self.run_to(BootloaderState.ANNOUNCING)
        self.take_sent()

    def enter_transfer(self, size_bytes: int) -> None:
        """From the announcements to where packet 1 is awaited."""
        self.send(self.update_row(size_bytes))
        self.run_to(BootloaderState.TRANSFER)
        assert messages.RequestTransfer() in self.take()

    def transfer(self, *packets: messages.Packet) -> None:
        """Send packets; each one is acknowledged."""
        for packet in packets:
            self.send(packet)
            self.run_to(BootloaderState.TRANSFER)
            assert self.take() == [messages.Ack(packet.number)]

    def end(self) -> None:
        """End of transfer; it completes."""
        self.send(messages.EndOfTransfer())
        self.run_to(BootloaderState.STARTING)
        assert self.take() == [messages.Complete()]

    def upgrade(self, image: bytes) -> None:
        """A whole upgrade of a device that announces itself or will do so."""
        if self.device.state is BootloaderState.APPLICATION:
            self.send(messages.ResetCommand())
        self.run_to(BootloaderState.ANNOUNCING)
        self.take_sent()
        self.enter_transfer(len(image))
        self.transfer(*packets_of(image))
        self.end()
        self.run_to(BootloaderState.APPLICATION)
