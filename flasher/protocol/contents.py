"""Data of the application messages, one class each (chapter 3); their ids are in `catalogue`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from flasher.protocol.fields import (
    AddressField,
    Bits,
    BytesField,
    Content,
    DateField,
    FlagsField,
    NumberField,
    NumberListField,
    TextField,
    WireText,
    constant,
    field,
    number,
    reserved,
)

TEMPERATURE_OFFSET_C: Final = 40
CELLS: Final = 16
MEMORY_PIECE_SIZE: Final = 128
"""Maximum number of bytes that one memory read returns (0x4308)."""


def _temperature() -> Any:
    return number(1, "°C", offset=TEMPERATURE_OFFSET_C)


class BatteryStatus(Bits):
    """Status bits of the running information; 0 is also sent by a sleeping BMS (R21)."""

    CHARGER_CONNECTED = 0x01


class BatteryFault(Bits):
    """Fault flags of the BMS: warnings in the upper half, protections and defects in the lower
    (table 5). The document neither names nor reserves the other bits (R24).
    """

    SECOND_LEVEL_DISCHARGE_OVER_CURRENT_PROTECTION = 1 << 0
    CHARGE_OVER_CURRENT_PROTECTION = 1 << 1
    SHORT_CIRCUIT_PROTECTION = 1 << 2
    OVER_DISCHARGE_PROTECTION = 1 << 3
    OVER_CHARGE_PROTECTION = 1 << 4
    DISCHARGE_UNDER_TEMPERATURE_PROTECTION = 1 << 5
    DISCHARGE_OVER_TEMPERATURE_PROTECTION = 1 << 6
    CHARGE_UNDER_TEMPERATURE_PROTECTION = 1 << 7
    CHARGE_OVER_TEMPERATURE_PROTECTION = 1 << 8
    DISCHARGE_MOS_FAULT = 1 << 9
    CHARGE_MOS_FAULT = 1 << 10
    TEMPERATURE_SENSOR_FAULT = 1 << 11
    FIRST_LEVEL_OVER_CURRENT_WARNING = 1 << 12
    FIRST_LEVEL_OVER_CURRENT_PROTECTION = 1 << 13
    AFE_FAULT = 1 << 14
    MCU_FAULT = 1 << 15
    CHARGE_OVER_VOLTAGE_WARNING = 1 << 16
    DISCHARGE_UNDER_VOLTAGE_WARNING = 1 << 17
    CHARGE_OVER_CURRENT_WARNING = 1 << 18
    DISCHARGE_OVER_CURRENT_WARNING = 1 << 19
    CHARGE_OVER_TEMPERATURE_WARNING = 1 << 20
    CHARGE_UNDER_TEMPERATURE_WARNING = 1 << 21
    DISCHARGE_OVER_TEMPERATURE_WARNING = 1 << 22
    DISCHARGE_UNDER_TEMPERATURE_WARNING = 1 << 23
    MOS_OVER_TEMPERATURE_WARNING = 1 << 24

    @classmethod
    def unnamed(cls, bit: int) -> str:
        return f"bit {bit} (not in the document)"


@dataclass(frozen=True)
class Empty(Content):
    """A query without data."""


@dataclass(frozen=True)
class Handshake(Content):
    """Query whether a BMS is present."""

    text: bytes = constant(b"HANDSHAKE")


@dataclass(frozen=True)
class Ready(Content):
    """Agrees to a shutdown, or answers a handshake."""

    text: bytes = constant(b"READY")


@dataclass(frozen=True)
class Shutdown(Content):
    """Command of the BMS or WMC to prepare for switching off."""

    text: bytes = constant(b"SHUTDOWN")


@dataclass(frozen=True)
class Reset(Content):
    """Command to restart into the bootloader."""

    text: bytes = constant(b"RESET")


@dataclass(frozen=True)
class GeneralFeedback(Content):
    """Acknowledges a write."""

    text: bytes = constant(b"ACK")


@dataclass(frozen=True)
class RunningInformation(Content):
    """Battery voltage, current, capacity, temperature, charge, health. 4 reserved bytes (R1)."""

    voltage_mv: int = number(2, "mV")
    mean_current_ma: int = number(2, "mA", signed=True)
    """Discharge is negative."""
    remaining_capacity_mah: int = number(2, "mAh")
    full_capacity_mah: int = number(2, "mAh")
    cell_temperature_c: int = _temperature()
    state_of_charge_percent: int = number(1, "%")
    status: BatteryStatus = field(FlagsField(1, BatteryStatus, none="no flag (00)"))
    state_of_health_percent: int = number(1, "%")
    """0 may come from an older device that does not measure it (R22)."""
    reserved: bytes = reserved(4)


@dataclass(frozen=True)
class CellVoltages(Content):
    """Voltages of up to 16 cells; absent cells are 0."""

    cells_mv: tuple[int, ...] = field(NumberListField(CELLS, NumberField(2, "mV")))


@dataclass(frozen=True)
class Faults(Content):
    """Fault flags of the BMS, sent every 200 ms while any is set."""

    faults: BatteryFault = field(FlagsField(4, BatteryFault))


@dataclass(frozen=True)
class DesignInformation(Content):
    """Design capacity, design voltage and cell model of the battery."""

    design_capacity_mah: int = number(2, "mAh")
    design_voltage_v: int = number(1, "V")
    cell_model: WireText = field(TextField(8))
    reserved: bytes = reserved(5)


@dataclass(frozen=True)
class VersionInformation(Content):
    """Model, serial number, hardware version and firmware version of the battery."""

    model: WireText = field(TextField(16))
    serial_number: WireText = field(TextField(16))
    hardware_version: WireText = field(TextField(16))
    firmware_version: WireText = field(TextField(16))


@dataclass(frozen=True)
class PhysicalId(Content):
    """Physical ID of the BMS; a short one is padded with 01 (R13)."""

    physical_id: bytes = field(BytesField(12))


@dataclass(frozen=True)
class CheckCode(Content):
    """Check code of the BMS; its structure is not documented."""

    check_code: bytes = field(BytesField(12))


@dataclass(frozen=True)
class History(Content):
    """Extreme values and protection counts since production; both currents are unsigned."""

    highest_cell_temperature_c: int = _temperature()
    lowest_cell_temperature_c: int = _temperature()
    greatest_discharge_current_ma: int = number(2, "mA")
    greatest_charge_current_ma: int = number(2, "mA")
    cycles: int = number(2)
    latest_charge_interval_h: int = number(2, "h")
    longest_charge_interval_h: int = number(2, "h")
    charge_over_current_count: int = number(2)
    discharge_over_current_count: int = number(2)
    over_charge_count: int = number(2)
    over_discharge_count: int = number(2)
    short_circuit_count: int = number(2)
    charge_under_temperature_count: int = number(2)
    charge_over_temperature_count: int = number(2)
    discharge_under_temperature_count: int = number(2)
    discharge_over_temperature_count: int = number(2)
    running_time_min: int = number(4, "min")
    state_of_health_percent: int = number(1, "%")
    reserved: bytes = reserved(5)


@dataclass(frozen=True)
class ProductionInformation(Content):
    """Manufacturer, place and date of the battery's production."""

    manufacturer: WireText = field(TextField(8))
    place: WireText = field(TextField(8))
    date: WireText = field(DateField())
    reserved: bytes = reserved(8)


@dataclass(frozen=True)
class UserString(Content):
    """User string of the BMS: free text."""

    text: WireText = field(TextField(16))


@dataclass(frozen=True)
class Model(Content):
    """Sets the battery's model, as in the version information."""

    model: WireText = field(TextField(16))


@dataclass(frozen=True)
class SerialNumber(Content):
    """Sets the battery's serial number, as in the version information."""

    serial_number: WireText = field(TextField(16))


@dataclass(frozen=True)
class ReadMemory(Content):
    """Requests BMS memory from address `start` up to `end`, exclusive (R5)."""

    start: int = field(AddressField(4))
    end: int = field(AddressField(4))


@dataclass(frozen=True)
class Memory(Content):
    """BMS memory from `start` up to `end`; the remaining bytes are FF."""

    start: int = field(AddressField(4))
    end: int = field(AddressField(4))
    content: bytes = field(BytesField(MEMORY_PIECE_SIZE))
