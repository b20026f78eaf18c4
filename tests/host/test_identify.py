"""Asking a device who it is before anything is written to it."""

from __future__ import annotations

from flasher.host.duplicates import SECOND_DEVICE_WAIT_S
from flasher.host.identify import LISTEN_FIRST_S, IdentifyStage
from flasher.host.options import UpgradeOptions
from flasher.host.query import Request
from flasher.host.runner import Runner
from flasher.image.plan import plan
from flasher.protocol import catalogue
from flasher.protocol.bittime import frame_bits
from flasher.protocol.contents import BatteryStatus, RunningInformation, VersionInformation
from flasher.protocol.fields import Content, WireText
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BMS, OBC, WELLING, WMC, Target
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, Reassembler, encode, split
from tests.host.bench import answer_frames, image_of
from tests.loops import each

VERSION, RUNNING = (0x720, 0x1540), (0x720, 0x1010)
BATTERY = RunningInformation(40_000, -8, 8000, 9800, 22, 85, BatteryStatus(0), 98, bytes(4))


def version(serial: str = "W1", firmware: str = "V1r0r0_20220512") -> VersionInformation:
    texts = ("BM36", serial, "V1r2r0_20220512", firmware)
    return VersionInformation(*(WireText(encode_text(text, 16)) for text in texts))


class Asked:
    """The machine under test, its time, and the commands that it has sent."""

    def __init__(self, target: Target = BMS, options: UpgradeOptions | None = None) -> None:
        planned = plan(image_of(300), target, WELLING.bitrate_bps)
        chosen = options or UpgradeOptions()
        self.noted = IdentifyStage(planned, chosen)
        self.engine = Runner(self.noted.stage, bitrate_bps=planned.bitrate_bps)
        self.now = 10.0 - LISTEN_FIRST_S
        self.commands: list[int] = []
        self._wire = Reassembler(target.request_id, 1.0)
        self.run(9.999)
        assert self.commands == [], "it listens first"

    def run(self, until: float) -> None:
        """Let it send what it wants to until then."""
        while not self.engine.done:
            wanted = self.engine.deadline()
            if wanted is None or wanted > until:
                break
            self.now = max(self.now, wanted)
            self.engine.tick(self.now)
            self.flush()
        self.now = max(self.now, until)

    def flush(self) -> None:
        while (frame := self.engine.next_frame(self.now)) is not None:
            self.engine.frame_sent(self.now)
            self.now += frame_bits(frame) / WELLING.bitrate_bps
            for found in self._wire.feed(frame.data, self.now):
                assert isinstance(found, Message)
                self.commands.append(found.command)

    def say(self, key: tuple[int, int], content: Content) -> None:
        message = catalogue.encode(catalogue.BY_KEY[key], content)
        self.hear(split(message.can_id, encode(message)))

    def hear(self, frames: list[Frame]) -> None:
        for frame in frames:
            self.engine.receive(frame, self.now)
        self.flush()


def asked_both() -> Asked:
    asked = Asked()
    asked.run(10.01)
    asked.say(VERSION, version())
    asked.run(10.02)
    asked.say(RUNNING, BATTERY)
    return asked


def test_a_battery_is_asked_for_its_version_and_its_state_and_no_more() -> None:
    asked = asked_both()
    asked.run(asked.now + SECOND_DEVICE_WAIT_S)
    assert asked.engine.done
    assert asked.commands == [0x3300, 0x3400]
    assert asked.noted.answers.version == version()
    assert asked.noted.answers.running == BATTERY
    assert asked.noted.answers.hardware_version == "V1r2r0_20220512"
    assert asked.noted.answers.firmware_version == "V1r0r0_20220512"
    assert asked.noted.two_devices == ""


@each("target", [WMC, OBC])
def test_who_has_no_query_is_not_asked(target: Target) -> None:
    asked = Asked(target)
    assert asked.engine.deadline() is not None, "it listens all the same"
    asked.run(10.0)
    assert asked.engine.done
    assert asked.engine.next_frame(10.0) is None
    assert asked.noted.answers.version is None


def test_a_products_own_query_is_asked_too() -> None:
    """Here with the battery's own rows, sent to another target."""
    own = Request(catalogue.BY_KEY[(0x752, 0x3300)])
    asked = Asked(WMC, UpgradeOptions(version_request=own))
    assert asked.noted.asks


def test_silence_ends_it_after_a_second_and_the_rest_is_not_asked() -> None:
    asked = Asked()
    asked.run(20.0)
    assert asked.engine.done
    assert set(asked.commands) == {0x3300}
    assert asked.noted.answers.version is None
    assert asked.noted.announcement is None
    assert not asked.noted.cancelled


def test_an_announcement_ends_it_at_once() -> None:
    asked = Asked()
    asked.run(10.1)
    asked.hear(answer_frames(BootVersion("BMS", "V1.2.3")))
    assert asked.engine.done
    assert asked.noted.announcement is not None
    assert asked.engine.next_frame(asked.now) is None


def test_an_announcement_while_it_listens_first_is_kept_until_it_has_listened() -> None:
    asked = Asked()
    asked.hear(answer_frames(BootVersion("BMS", "V1.2.3")))
    assert asked.engine.deadline() is not None
    asked.run(10.0)
    assert asked.engine.done
    assert asked.noted.announcement is not None
    assert asked.commands == []


def test_an_announcement_in_the_middle_of_a_question_lets_it_go_to_its_end_only() -> None:
    asked = Asked()
    asked.now = 10.0
    asked.engine.tick(asked.now)
    first = asked.engine.next_frame(asked.now)
    assert first is not None
    asked.engine.frame_sent(asked.now)
    for frame in answer_frames(BootVersion("BMS", "V1.2.3")):
        asked.engine.receive(frame, asked.now)
    assert not asked.engine.done
    assert asked.engine.next_frame(asked.now) is not None
    asked.engine.frame_sent(asked.now)
    assert asked.engine.next_frame(asked.now) is None
    asked.engine.tick(asked.now)
    assert asked.engine.done


@each("other", [version("W2"), version(firmware="V9r0r0_20250101")])
def test_different_answers_are_two_devices(other: Content) -> None:
    asked = Asked()
    asked.run(10.01)
    asked.say(VERSION, version())
    asked.say(VERSION, other)
    asked.run(20.0)
    assert asked.engine.done
    assert "two devices answered" in asked.noted.two_devices
    assert "W1 / W2" in asked.noted.two_devices or "V9r0r0_20250101" in asked.noted.two_devices


def test_other_frames_on_its_ids_are_nothing() -> None:
    asked = Asked()
    asked.run(10.01)
    for can_id in (0x720, 0x725):
        asked.hear([Frame(can_id, b"\x05"), Frame(can_id, b"", is_remote=True)])
        asked.hear([Frame(can_id, b"\x55\xaa\x0c", is_extended=True)])
    assert asked.noted.answers.version is None
    assert asked.noted.announcement is None
    asked.now = 10.2
    asked.say(VERSION, version())
    assert asked.noted.answers.version == version()


def test_it_ends_at_the_end_of_the_message_when_it_is_cancelled() -> None:
    asked = Asked()
    asked.now = 10.0
    asked.engine.tick(asked.now)
    asked.engine.next_frame(asked.now)
    asked.engine.frame_sent(asked.now)
    asked.engine.cancel(asked.now)
    assert asked.noted.cancelled
    assert not asked.engine.done
    asked.flush()
    asked.engine.tick(asked.now)
    assert asked.engine.done
