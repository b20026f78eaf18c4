"""Model of a whole bicycle: BMS, WMC, OBC and, in the MOTINOVA dialect, HMI on one bus.

BMS, WMC and OBC can be upgraded. The battery supplies the others: when it switches off, they are
off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.mock.clients import ClientApplication
from flasher.mock.machine import Machine, Unit
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, TARGETS, WELLING, Dialect, Node, Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

_TARGETS: Final = {target.node: target for target in TARGETS.values()}
_DEFAULT_PROFILE: Final = DeviceProfile()


class System:
    """Engine (`flasher.protocol.engine`) of several nodes that also receive each other.

    `profile` and `has_application` apply to `device`, the node named by `target`; `profile` also to
    the BMS. Events are those of `device`. Attach it to a simulated bus, or drive it on a link:
    nodes send in turn.
    """

    def __init__(
        self,
        dialect: Dialect = WELLING,
        target: Target = BMS,
        *,
        profile: DeviceProfile = _DEFAULT_PROFILE,
        timings: Timings = DEFAULT_TIMINGS,
        has_application: bool = True,
    ) -> None:
        self.dialect = dialect
        own_profile = profile.speaking(dialect)
        plain_profile = _DEFAULT_PROFILE.speaking(dialect)
        self.members: dict[Node, Machine] = {}
        for node in dialect.nodes:
            if node is Node.CDL:
                continue
            is_target = node is target.node
            asks = ClientApplication(node, dialect, timings) if node is not Node.BMS else None
            if node in _TARGETS:
                self.members[node] = MockDevice(
                    _TARGETS[node],
                    bitrate_bps=dialect.bitrate_bps,
                    profile=own_profile if is_target or node is Node.BMS else plain_profile,
                    timings=timings,
                    has_application=has_application or not is_target,
                    application=asks,  # a BMS has its own application
                )
            elif asks is not None:
                self.members[node] = Unit(asks, bitrate_bps=dialect.bitrate_bps, timings=timings)
        device = self.members[target.node]
        if not isinstance(device, MockDevice):
            raise TypeError(f"{target.name} cannot be upgraded")
        self.device = device
        """Node to upgrade."""
        self._battery = self.members[Node.BMS]
        self._turns = list(self.members.values())
        self._sending: Machine | None = None

    # -- the bicycle ------------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        return self._battery.has_power

    def hold_key(self, now: float) -> None:
        """Hold the battery's key long enough to switch off."""
        self._battery.hold_key(now)

    def power_cut(self, now: float) -> None:
        for member in self._turns:
            if member.has_power:
                member.power_cut(now)

    def power_on(self, now: float) -> None:
        """Restore the power; nodes restart through their bootloaders (R19)."""
        for member in self._turns:
            if not member.has_power:
                member.power_on(now)

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        return all(member.done for member in self._turns)

    def receive(self, frame: Frame, now: float) -> None:
        """Process a frame of another node, or an echo of an own frame."""
        if frame.is_echo:
            return  # the members already received it
        for member in self._turns:
            member.receive(frame, now)

    def tick(self, now: float) -> None:
        for member in self._turns:
            member.tick(now)
        if not self._battery.has_power:
            self.power_cut(now)

    def deadline(self) -> float | None:
        wanted = [member.deadline() for member in self._turns]
        return min((moment for moment in wanted if moment is not None), default=None)

    def next_frame(self, now: float) -> Frame | None:
        if self._sending is not None:
            frame = self._sending.next_frame(now)
            if frame is not None:
                return frame
            self._sending = None
        for member in self._turns:
            frame = member.next_frame(now)
            if frame is not None:
                self._sending = member
                return frame
        return None

    def frame_sent(self, now: float) -> None:
        """Pass the accepted frame to the other nodes; the sender's next turn is after theirs."""
        sender, self._sending = self._sending, None
        frame = sender.next_frame(now) if sender is not None else None
        if sender is None or frame is None:
            return
        sender.frame_sent(now)
        self._turns.remove(sender)
        for member in self._turns:
            member.receive(frame, now)
        self._turns.append(sender)

    def cancel(self, now: float) -> None:
        for member in self._turns:
            member.cancel(now)

    def take_events(self) -> Sequence[object]:
        for member in self._turns:
            if member is not self.device:
                member.take_events()
        return self.device.take_events()
