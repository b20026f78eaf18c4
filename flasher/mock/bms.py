"""BMS application: answers queries and writes (chapter 3), reports faults, shuts down.

Formats and answers of messages come from the catalogue. Written data survive power cuts and
upgrades.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Final

from flasher.events import DeviceReported, DeviceWritten, ShutdownAnnounced, ShutdownEnded
from flasher.mock.application import (
    Application,
    ApplicationPort,
    due_again,
    due_until,
    ids_received_by,
)
from flasher.mock.battery import (
    DESIGN_CAPACITY_MAH,
    DESIGN_VOLTAGE_V,
    FULL_CAPACITY_MAH,
    STATE_OF_HEALTH_PERCENT,
    Battery,
)
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import MemoryMap
from flasher.protocol import contents
from flasher.protocol.catalogue import ITEMS, Item, answer_of, decode, encode
from flasher.protocol.contents import BatteryFault, CheckCode, PhysicalId, ProductionInformation
from flasher.protocol.fields import Content, WireText
from flasher.protocol.spec import (
    DIALECTS,
    MOTINOVA,
    VERSION_FIELD_SIZE,
    WELLING,
    Dialect,
    Mode,
    Node,
    can_id,
)
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message

SHUTDOWN_PERIOD_S: Final = 0.2
"""Interval of SHUTDOWN until all other nodes are ready."""
SHUTDOWN_DELAY_S: Final = 1.0
"""Time from the first SHUTDOWN to the opening of the discharge switch, whatever the answers."""
FAULT_PERIOD_S: Final = 0.2
"""Interval of fault messages while any fault is set (table 5)."""
IDLE_SHUTDOWN_S: Final = 30 * 60.0
"""The battery switches off when the bus was idle, and the pack current small, for this time (table
5)."""
IDLE_CURRENT_MA: Final = {WELLING: 50, MOTINOVA: 20}
"""Limit of a small pack current in mA, by dialect."""
CURRENT_PERIOD_S: Final = 1.0
"""Interval at which the pack current of an idle bus is checked."""
_FEEDBACK_IDS: Final = {
    can_id(node, Node.BMS): can_id(Node.BMS, node) for node in Node if node is not Node.BMS
}
"""CAN id of general feedback by the id of the write: it goes to the sender (2.2.1 (2))."""
_WRITE: Final = "write "
_CELL_MODEL: Final = "21700A"
_ID_FILLER: Final = b"\x01"
"""Filler of a short physical ID (R13)."""
_NO_STATE_OF_HEALTH: Final = 0
_NEWER_QUERIES: Final = frozenset(
    {(Node.OBC, contents.CellVoltages), (Node.HMI, contents.CellVoltages)}
)
"""Queries, by sender and content of the answer, that an older battery does not answer (document
revisions)."""


class ShutdownSequence:
    """Shutdown of the battery (table 5): sends SHUTDOWN, collects READY, switches off."""

    def __init__(self, dialect: Dialect, port: ApplicationPort, why: str, now: float) -> None:
        self._port = port
        self._announcement = _sent_item(contents.Shutdown, dialect)
        self._missing = {
            item.sender
            for item in ITEMS
            if item.content is contents.Ready and item.receiver is None and dialect in item.dialects
        }
        self._answered: set[Node] = set()
        self._off_at = now + SHUTDOWN_DELAY_S
        self.due_at = now
        port.emit(ShutdownAnnounced(why))

    def ready(self, node: Node) -> None:
        if node in self._missing:
            self._missing.remove(node)
            self._answered.add(node)
            if not self._missing:
                self.due_at = self._off_at

    def tick(self, now: float) -> None:
        """Repeat SHUTDOWN, or switch off."""
        if now >= self._off_at:
            self._port.emit(ShutdownEnded(_names(self._answered), _names(self._missing)))
            self._port.power_cut(now)
        elif self._missing and now >= self.due_at:
            if self._port.is_idle:
                self._port.send(encode(self._announcement, contents.Shutdown()))
            self.due_at = due_until(self.due_at, SHUTDOWN_PERIOD_S, self._off_at, now)


class BmsApplication(Application):
    """BMS application; `kept` contains the writable items by their names in the catalogue."""

    def __init__(self, profile: DeviceProfile, memory: MemoryMap) -> None:
        super().__init__(Node.BMS, DIALECTS[profile.dialect])
        self.profile = profile
        self.battery = Battery(profile.battery_use, profile.battery_seed)
        self.faults = BatteryFault(profile.faults)
        self.kept = _factory_settings(profile)
        self._memory = memory
        self._firmware = ""
        self._shutdown: ShutdownSequence | None = None
        self._fault_due_at = inf
        self._idle_since: float | None = None
        """Time since which the bus was idle and the current small; None before the first tick."""
        self._current_due_at = -inf
        self._faults_item = _sent_item(contents.Faults, self.dialect)
        self._feedback_item = _sent_item(contents.GeneralFeedback, self.dialect)
        self._readers: dict[type[Content], Callable[[float], Content]] = {
            contents.RunningInformation: self._running_information,
            contents.CellVoltages: lambda now: contents.CellVoltages(self.battery.at(now).cells_mv),
            contents.VersionInformation: self._version_information,
            contents.History: self._history,
            contents.Ready: lambda _now: contents.Ready(),
            contents.GeneralFeedback: lambda _now: contents.GeneralFeedback(),
        }

    # -- the machine's side -----------------------------------------------------------------------

    @property
    def received_ids(self) -> frozenset[int]:
        return ids_received_by(self.node, self.dialect)

    def start(self, firmware: str, now: float) -> None:
        self._firmware = firmware
        self._shutdown = None
        self._idle_since = None
        self._fault_due_at = now if self.faults else inf

    def stop(self) -> None:
        self._shutdown = None
        self._fault_due_at = inf

    def note_traffic(self, now: float) -> None:
        self._idle_since = now

    @property
    def due_at(self) -> float:
        shutdown_due_at = inf if self._shutdown is None else self._shutdown.due_at
        return min(self._fault_due_at, self._idle_due_at, shutdown_due_at)

    def tick(self, now: float) -> None:
        if self._fault_due_at <= now:
            if self.port.is_idle:
                self.port.send(encode(self._faults_item, contents.Faults(self.faults)))
            self._idle_since = now  # its own frames count as traffic
            self._fault_due_at = due_again(self._fault_due_at, FAULT_PERIOD_S, now)
        if self._idle_due_at <= now:
            self._check_current(now)
        if self._shutdown is not None:
            self._shutdown.tick(now)

    # -- faults and shutdown ----------------------------------------------------------------------

    def set_faults(self, faults: BatteryFault, now: float) -> None:
        self.faults = faults
        if not faults:
            self._fault_due_at = inf
        elif self._fault_due_at == inf:
            self._fault_due_at = now

    def hold_key(self, now: float) -> None:
        """Start the shutdown: the key was held for 3 s."""
        self._announce_shutdown("key held", now)

    def _announce_shutdown(self, why: str, now: float) -> None:
        if self._shutdown is None:
            self._shutdown = ShutdownSequence(self.dialect, self.port, why, now)
            self._shutdown.tick(now)

    @property
    def _idle_due_at(self) -> float:
        if self.profile.idle_shutdown == "off" or self._shutdown is not None:
            return inf
        # Without any frame, the time counts from the first tick.
        since = self._idle_since
        return -inf if since is None else min(self._current_due_at, since + IDLE_SHUTDOWN_S)

    def _check_current(self, now: float) -> None:
        self._current_due_at = now + CURRENT_PERIOD_S
        is_small = abs(self.battery.at(now).current_ma) < IDLE_CURRENT_MA[self.dialect]
        if self._idle_since is None or not is_small:
            self._idle_since = now
        elif now - self._idle_since >= IDLE_SHUTDOWN_S:
            self._announce_shutdown("bus idle", now)

    # -- messages ---------------------------------------------------------------------------------

    def take(self, message: Message, now: float) -> None:
        """Answer a query or a write; ignore other messages."""
        decoded = decode(message, self.dialect)
        if decoded is None:
            # A write outside the dialect is confirmed too, and changes nothing: every write is
            # followed by general feedback to its sender (2.2.1(2)).
            answer_id = _FEEDBACK_IDS.get(message.can_id)
            is_silent = self.profile.is_silent_to(message.can_id, message.command)
            if answer_id is not None and message.mode == Mode.WRITE and not is_silent:
                feedback = encode(self._feedback_item, contents.GeneralFeedback())
                self.port.send(feedback._replace(can_id=answer_id))
            return
        item, content = decoded.item, decoded.content
        if isinstance(content, contents.Ready):
            if self._shutdown is not None and content == contents.Ready():
                self._shutdown.ready(item.sender)
            return
        answer = answer_of(item)
        if answer is None or self.profile.is_silent_to(item.can_id, item.command):
            return
        is_newer = (item.sender, answer.content) in _NEWER_QUERIES
        if is_newer and self.profile.older_battery == "yes":
            return
        if isinstance(content, contents.Handshake) and content != contents.Handshake():
            return
        name = item.title.removeprefix(_WRITE)
        if item.mode is Mode.WRITE and name in self.kept:  # excludes a reset with another text
            before, self.kept[name] = self.kept[name], content
            self.port.emit(DeviceWritten(name, _shown(before), _shown(content)))
        reply = self._reply(answer, content, now)
        if reply is not None:
            self.port.send(encode(answer, reply))

    def _reply(self, answer: Item, content: Content, now: float) -> Content | None:
        if isinstance(content, contents.ReadMemory):
            return self._read_memory(content)
        kept = self.kept.get(answer.title)
        if kept is not None:
            return kept
        reader = self._readers.get(answer.content)
        return None if reader is None else reader(now)

    def _read_memory(self, wanted: contents.ReadMemory) -> Content | None:
        """Return the requested memory; None for addresses outside, or over 128 bytes (R5)."""
        found = None
        if 0 < wanted.end - wanted.start <= contents.MEMORY_PIECE_SIZE:
            found = self._memory.read(wanted.start, wanted.end)
        if found is None:
            where = f"0x{wanted.start:08X}..0x{wanted.end:08X}"
            self.port.emit(DeviceReported(f"memory {where} cannot be read"))
            return None
        padded = found.ljust(contents.MEMORY_PIECE_SIZE, b"\xff")
        return contents.Memory(wanted.start, wanted.end, padded)

    # -- measured values ---------------------------------------------------------------------------

    def _running_information(self, now: float) -> Content:
        reading = self.battery.at(now)
        is_older = self.profile.older_battery == "yes"
        return contents.RunningInformation(
            voltage_mv=reading.voltage_mv,
            mean_current_ma=reading.current_ma,
            remaining_capacity_mah=reading.remaining_mah,
            full_capacity_mah=FULL_CAPACITY_MAH,
            cell_temperature_c=reading.temperature_c,
            state_of_charge_percent=reading.state_of_charge_percent,
            status=reading.status,
            state_of_health_percent=_NO_STATE_OF_HEALTH if is_older else STATE_OF_HEALTH_PERCENT,
        )

    def _version_information(self, now: float) -> Content:
        model, serial_number = self.kept["model"], self.kept["serial number"]
        assert isinstance(model, contents.Model)  # noqa: S101  for the type checker
        assert isinstance(serial_number, contents.SerialNumber)  # noqa: S101
        return contents.VersionInformation(
            model.model,
            serial_number.serial_number,
            _version_text(self.profile.hardware_version),
            _version_text(self._firmware),
        )

    def _history(self, now: float) -> Content:
        """History of a battery whose protections never acted."""
        return contents.History(
            highest_cell_temperature_c=45,
            lowest_cell_temperature_c=-5,
            greatest_discharge_current_ma=25_000,
            greatest_charge_current_ma=4_000,
            cycles=12,
            latest_charge_interval_h=30,
            longest_charge_interval_h=400,
            charge_over_current_count=0,
            discharge_over_current_count=0,
            over_charge_count=0,
            over_discharge_count=0,
            short_circuit_count=0,
            charge_under_temperature_count=0,
            charge_over_temperature_count=0,
            discharge_under_temperature_count=0,
            discharge_over_temperature_count=0,
            running_time_min=60_000 + int(self.battery.at(now).elapsed_s // 60),
            state_of_health_percent=STATE_OF_HEALTH_PERCENT,
        )


def _factory_settings(profile: DeviceProfile) -> dict[str, Content]:
    """Initial items by the title of the message that reads or writes them."""
    design = contents.DesignInformation(
        DESIGN_CAPACITY_MAH, DESIGN_VOLTAGE_V, _text(_CELL_MODEL, 8)
    )
    identity = profile.serial_number.encode("ascii")[: PhysicalId.SIZE_BYTES]
    return {
        "model": contents.Model(_text(profile.model)),
        "serial number": contents.SerialNumber(_text(profile.serial_number)),
        "production information": ProductionInformation(
            _text("WELLING", 8), _text("WUXI", 8), WireText(b"20220512")
        ),
        "design information": design,
        "physical id": PhysicalId(identity.ljust(PhysicalId.SIZE_BYTES, _ID_FILLER)),
        "check code": CheckCode(bytes(CheckCode.SIZE_BYTES)),
        "user string 1": contents.UserString(_text("")),
        "user string 2": contents.UserString(_text("")),
        "user string 3": contents.UserString(_text("")),
    }


def _text(text: str, size_bytes: int = VERSION_FIELD_SIZE) -> WireText:
    return WireText(encode_text(text, size_bytes))


def _version_text(text: str) -> WireText:
    """Encode a version; one of full length has no terminator, a longer one is truncated (R20)."""
    if len(text) < VERSION_FIELD_SIZE:
        return _text(text)
    return WireText(text.encode("ascii")[:VERSION_FIELD_SIZE])


def _sent_item(content: type[Content], dialect: Dialect) -> Item:
    """Catalogue row of a message that the BMS sends without a query."""
    return next(
        item
        for item in ITEMS
        if item.sender is Node.BMS and item.content is content and dialect in item.dialects
    )


def _shown(content: Content) -> str:
    return ", ".join(value for _, value, _ in content.shown())


def _names(nodes: set[Node]) -> tuple[str, ...]:
    return tuple(node.name for node in sorted(nodes, key=lambda node: node.value))
