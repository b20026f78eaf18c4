"""What every upgradable device is, right or deliberately wrong: a flash of its own, power, and the
way from messages and time to events of the table.

What happens becomes an event (`classify`, `_elapsed`), the table says what follows, and an action
does it. The actions are in `model`. An action may change everything but the state, and returns a
few words for those who watch.

Flash operations take their time in the controller. While they last the device hears, but a packet
that comes before the answer to the one before is out of turn.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar, Final

from flasher.errors import UsageError
from flasher.events import DeviceStateEntered
from flasher.mock.application import Application
from flasher.mock.bms import BmsApplication
from flasher.mock.classify import Situation, Transfer, classify, is_damaged_packet, named_number
from flasher.mock.machine import Machine
from flasher.mock.memory import FlashController
from flasher.mock.memory_map import memory_map
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import ApplicationStore, checksum_fits, factory_image
from flasher.mock.table import TABLE, Action, Event, Row, State
from flasher.protocol import messages
from flasher.protocol.spec import BOOT_VERSION_BURST, DIALECTS, Node, Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message

_DEFAULT_PROFILE: Final = DeviceProfile()
_DEAF: Final = frozenset((State.OFF, State.RESTARTING))
_WORKS_ON_FLASH: Final = frozenset((State.ERASING, State.PROGRAMMING, State.CHECKING))
_PER_PACKET: Final = frozenset((State.TRANSFER, State.PROGRAMMING))
_TIMER_EVENTS: Final = {
    State.RESTARTING: Event.RESTART_DUE,
    State.TRANSFER: Event.PAUSE_OVER,
    State.REFUSED: Event.HOLD_OVER,
}


class DeviceCore(Machine):
    """A device without the actions of its table: the base of `MockDevice`.

    At construction it has been on for a while: its application runs, or, when there is none, its
    bootloader announces itself from the first time it is given. A BMS has an application that
    answers, others a silent one unless another is given. Raises UsageError for timings that would
    make it announce without a pause.
    """

    table: ClassVar[Mapping[State, Row]] = TABLE
    store_type: ClassVar[type[ApplicationStore]] = ApplicationStore
    transfer_type: ClassVar[type[Transfer]] = Transfer
    burst: ClassVar[int] = BOOT_VERSION_BURST
    """How often it announces itself before it starts the application."""

    def __init__(
        self,
        target: Target,
        *,
        bitrate_bps: int,
        profile: DeviceProfile = _DEFAULT_PROFILE,
        timings: Timings = DEFAULT_TIMINGS,
        has_application: bool = True,
        application: Application | None = None,
    ) -> None:
        if timings.boot_version_spacing_s <= 0:
            raise UsageError("the time between two announcements is greater than 0")
        self.target = target
        self.profile = profile
        self.store = self.store_type(profile)
        super().__init__(
            application or _own_application(target, profile, self.store),
            frozenset((target.request_id,)),
            bitrate_bps=bitrate_bps,
            timings=timings,
        )
        self.state = State.APPLICATION if has_application else State.ANNOUNCING
        self._controller = FlashController(
            self.store.flash,
            erase_time_s=profile.erase_time_s,
            program_time_s=profile.program_time_s,
        )
        self._transfer = self.transfer_type(0)
        self._announced = 0
        self._has_whole_application = has_application
        self._runs_application = has_application
        # What the message in hand brought, for the action that follows it.
        self._offered_bytes = 0
        self._number: int | None = None
        self._payload = b""
        self._message: Message | None = None
        self._actions = self._make_actions()
        if has_application:
            self.store.load(factory_image(profile))
            detail = self._actions[Action.START](0.0)
        else:
            self._due = float("-inf")
            detail = "no application"
        self._events.append(DeviceStateEntered(self.state.value, detail))

    # -- what tests and the conformance suite look at ---------------------------------------------

    @property
    def stored_image(self) -> bytes | None:
        """The image of the whole application in the flash, exactly its size; None without one."""
        return self.store.image()

    @property
    def erase_count(self) -> int:
        """Pages erased to the end since construction."""
        return self.store.flash.erase_count

    @property
    def program_count(self) -> int:
        """Program operations (a packet, or the final record) done to the end since construction."""
        return self.store.flash.program_count

    def readback(self, size_bytes: int | None = None) -> bytes:
        """The first `size_bytes` of the application area, whole or torn, as a debugger reads them;
        all of it without a size.
        """
        return self.store.read(
            self.profile.application_area_bytes if size_bytes is None else size_bytes
        )

    @property
    def operations_done(self) -> int:
        """Flash operations, erasing a page or programming, done to the end since construction."""
        return self.erase_count + self.program_count

    def operation_reaches(self, share: float) -> float | None:
        """When `share` (0 to 1) of the flash operation under way is done: the time for a power cut
        in the middle of it. None while there is none.
        """
        return self._controller.reached_at(share)

    # -- power ------------------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        """False after a power cut."""
        return self.state is not State.OFF

    def power_cut(self, now: float) -> None:
        """The power goes: all is lost but the flash, and an operation under way stays torn."""
        self._handle(Event.POWER_CUT, now)

    def power_on(self, now: float) -> None:
        """The power comes back; the device passes through its bootloader (R19)."""
        self._handle(Event.POWER_ON, now)
        self._run_timer(now)

    # -- from the world to events -----------------------------------------------------------------

    def _take_message(self, message: Message, now: float) -> None:
        self._message = message
        # On other ids there is nothing for a bootloader, whatever the command.
        if message.can_id == self.target.request_id:
            self._take_row(messages.decode(message), now)
        else:
            self._handle(Event.QUERY, now)

    def _take_row(
        self, row: messages.Row | messages.Malformed | messages.Unknown, now: float
    ) -> None:
        if isinstance(row, messages.Packet):
            self._number, self._payload = row.number, row.payload
        elif isinstance(row, messages.UpdateCommand):
            self._offered_bytes = row.size_bytes
        elif isinstance(row, messages.Malformed):
            self._number = None
            self._report(f"malformed message {row.message.command:04X}: {row.problem}")
        self._handle(self._classify(row), now)

    def _take_damage(self, damage: Damage, now: float) -> None:
        is_own = damage.can_id == self.target.request_id
        if is_own and is_damaged_packet(damage) and self.state is State.TRANSFER:
            self._number = named_number(damage.data)
            self._handle(Event.PACKET_BAD, now)

    def _classify(self, row: messages.Row | messages.Malformed | messages.Unknown) -> Event:
        situation = Situation(self.target, self.profile, self.state, self._transfer)
        event = classify(row, situation)
        if event is Event.END_WHOLE and not self._accepts_image():
            return Event.END_WRONG
        return event

    def _accepts_image(self) -> bool:
        """False when the product's images carry a checksum and this one's is wrong (R7)."""
        if self.profile.image_checksum == "none":
            return True
        return checksum_fits(self.store.read(self._transfer.size_bytes))

    def _expire(self, now: float) -> None:
        if self.state in _WORKS_ON_FLASH and not self._controller.advance(now):
            self._due = self._controller.ends_at
        else:
            self._handle(self._elapsed(), now)

    def _elapsed(self) -> Event:
        """What the expired timer means."""
        if self.state in _WORKS_ON_FLASH:
            return Event.FLASH_DONE
        if self.state is State.ANNOUNCING:
            if self._announced < self.burst or not self._has_whole_application:
                return Event.ANNOUNCEMENT_DUE
            return Event.WINDOW_OVER
        if self.state is State.STARTING:
            restarts = self.profile.after_complete == "restarts"
            return Event.START_BY_RESTART_DUE if restarts else Event.START_DUE
        return _TIMER_EVENTS[self.state]

    def _handle(self, event: Event, now: float) -> None:
        before = self.state
        action, self.state = self.table[before][event]
        self._is_deaf = self.state in _DEAF
        self._runs_application = self.state is State.APPLICATION
        if before is State.APPLICATION and not self._runs_application:
            self.application.stop()
        detail = self._actions[action](now)
        if self.state is not before and not {self.state, before} <= _PER_PACKET:
            self._events.append(DeviceStateEntered(self.state.value, detail))

    @abstractmethod
    def _make_actions(self) -> Mapping[Action, Callable[[float], str]]:
        """What to do for each action of the table, told the time; each returns its few words."""


def _own_application(
    target: Target, profile: DeviceProfile, store: ApplicationStore
) -> Application:
    if target.node is Node.BMS:
        return BmsApplication(profile, memory_map(store.flash))
    return Application(target.node, DIALECTS[profile.dialect])
