"""The runner of stages: when it wants to be woken, and what it hears."""

from __future__ import annotations

from typing import Any

from flasher.host.runner import Runner, Signal, Stage, StageInput
from flasher.protocol.frame import Frame
from flasher.protocol.wire import Damage, Message
from tests.peers.wording import build, payloads


def parts(can_id: int) -> list[bytes]:
    """The frames' data of a message."""
    return payloads(build(can_id, 0x0C, 0x1204, bytes((4, 0, 1, 0))))


PARTS = parts(0x720)


def runner(
    *can_ids: int, until: float | None = None
) -> tuple[Runner[list[StageInput]], list[StageInput]]:
    """A stage that keeps what comes, until it is cancelled."""
    came: list[StageInput] = []

    def stage(run: Runner[Any]) -> Stage[list[StageInput]]:
        run.listen(*can_ids)
        while Signal.CANCEL not in came:
            came.append((yield until))
        return came

    made = Runner(stage, bitrate_bps=250_000)
    made.tick(0.0)
    return made, came


def test_half_a_message_is_judged_when_its_rest_is_missing() -> None:
    made, came = runner(0x720)
    assert made.deadline() is None
    made.receive(Frame(0x720, PARTS[0]), 1.0)
    assert made.deadline() == 1.1
    made.tick(1.1)
    (damage,) = came
    assert isinstance(damage, Damage)
    assert damage.data == PARTS[0]
    assert made.deadline() is None


def test_it_wants_to_be_woken_at_the_earliest_of_all_times() -> None:
    made, _ = runner(0x720, until=1.05)
    assert made.deadline() == 1.05
    made.receive(Frame(0x720, PARTS[0]), 1.0)
    assert made.deadline() == 1.05
    made.limit_at = 1.02
    assert made.deadline() == 1.02
    made.tick(1.02)
    assert made.done
    assert made.is_cancelled
    assert made.deadline() is None


def test_what_is_on_other_ids_or_is_no_payload_is_not_received() -> None:
    made, came = runner(0x720)
    for part in parts(0x721):
        made.receive(Frame(0x721, part), 1.0)
        made.receive(Frame(0x720, b"", is_remote=True), 1.0)
    assert came == []
    for part in PARTS:
        made.receive(Frame(0x720, part), 1.0)
    assert came == [Message(0x720, 0x0C, 0x1204, bytes((4, 0, 1, 0)))]


def test_what_is_received_always_stays_when_something_else_is_listened_for() -> None:
    made, came = runner()
    made.listen_always(0x720)
    made.also_listen_on(0x730)
    made.listen(0x721)
    for can_id in (0x720, 0x721, 0x730):
        for part in parts(can_id):
            made.receive(Frame(can_id, part), 1.0)
    made.listen()
    for can_id in (0x720, 0x721):
        for part in parts(can_id):
            made.receive(Frame(can_id, part), 2.0)
    heard = [each.can_id for each in came if isinstance(each, Message)]
    assert heard == [0x720, 0x721, 0x730, 0x720]


def test_a_message_under_way_is_received_by_the_next_stage() -> None:
    came: list[StageInput] = []

    def stage(run: Runner[Any]) -> Stage[None]:
        run.listen_always(0x720)
        yield 1.0
        run.listen_always(0x720)
        came.append((yield None))

    made = Runner(stage, bitrate_bps=250_000)
    made.tick(0.0)
    made.receive(Frame(0x720, PARTS[0]), 1.0)
    made.tick(1.0)
    for part in PARTS[1:]:
        made.receive(Frame(0x720, part), 1.0)
    assert came == [Message(0x720, 0x0C, 0x1204, bytes((4, 0, 1, 0)))]
