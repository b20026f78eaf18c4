"""The station's file, and which adapter belongs to which socket."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from flasher.bus.detect import DetectedAdapter
from flasher.errors import BusError, UsageError
from flasher.station.adapters import detect, resolve
from flasher.station.config import (
    SOCKETS_MAX,
    MockUnits,
    SocketConfig,
    load_config,
    mock_config,
    power_command,
)
from tests.loops import each

USUAL = """\
name = "line-2"

[[socket]]
name = "A"
interface = "slcan"
serial_number = "A1"
bus = { ttyBaudrate = 115200 }
power = "relay 3 {on|off}"

[[socket]]
name = "B"
interface = "socketcan"
usb_path = "1-1.4"

[[socket]]
name = "C"
interface = "pcan"
channel = "PCAN_USBBUS1"

[[socket]]
name = "D"
mock = { bad = 0.1, slow = 0.2, dead = 0.05, seed = 7 }
"""
PLUGGED = (
    DetectedAdapter("slcan", "/dev/ttyACM3", {"serial_number": "B7", "usb_path": "1-1.1"}),
    DetectedAdapter("slcan", "/dev/ttyACM0", {"serial_number": "A1", "usb_path": "1-1.2"}),
    DetectedAdapter("socketcan", "can1", {"usb_path": "1-1.4"}),
    DetectedAdapter("kvaser", "0", {"serial": 77}),
    DetectedAdapter("kvaser", "1", {"serial": 77}),
)


def written(folder: Path, text: str) -> Path:
    path = folder / "cfg.toml"
    path.write_text(text, encoding="utf-8")
    return path


def socket(**values: object) -> SocketConfig:
    return SocketConfig.model_validate({"name": "X"} | values)


def test_a_station_file_is_read_with_places_beside_it(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, USUAL))
    assert config.name == "line-2"
    assert config.records == str(tmp_path / "records.sqlite")
    assert [each.name for each in config.socket] == list("ABCD")
    assert config.socket[3].mock == MockUnits(bad=0.1, slow=0.2, dead=0.05, seed=7)


def test_the_heads_are_kept_in_one_place_or_in_several(tmp_path: Path) -> None:
    url = "postgresql://flasher_heads@plant-db/heads"
    for reported, places in {
        '"share"': (str(tmp_path / "share"),),
        f'["/mnt/heads", "{url}"]': ("/mnt/heads", url),
    }.items():
        assert load_config(written(tmp_path, f"heads = {reported}\n{USUAL}")).heads == places
    for wrong in ('""', '["a", ""]', "7", "[7]"):
        with pytest.raises(UsageError, match="heads"):
            load_config(written(tmp_path, f"heads = {wrong}\n{USUAL}"))


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('name = "B"', 'name = "A"', "two sockets have the same name"),
        ('usb_path = "1-1.4"', "", "no channel, serial_number or usb_path"),
        ("[[socket]]\n", '[[socket]]\nserial = "1"\n', "Did you mean serial_number"),
        ("{on|off}", "on", "power needs exactly one"),
        ("relay 3 {on|off}", "{on|off} relay", "must begin with the program"),
        ("bad = 0.1", "bad = 0.9", "add up to more than 1"),
        ("mock = {", 'interface = "pcan"\nmock = {', "a mock socket has no adapter"),
        ("ttyBaudrate", "channel", "belongs beside bus"),
        ('name = "D"\nmock = {', 'name = "D"\nmocks = {', "Did you mean mock?"),
        (
            'name = "C"',
            'name = "E"\ninterface = "slcan"\nserial_number = "A1"\n[[socket]]\nname = "C"',
            "two sockets have the same serial_number",
        ),
        (
            'name = "C"',
            'name = "E"\ninterface = "pcan"\nchannel = "PCAN_USBBUS1"\n[[socket]]\nname = "C"',
            "two sockets have the same adapter",
        ),
        ("interface = ", 'serial_number = "x"\ninterface = ', "cannot be used|TOML"),
        ('name = "line-2"', 'name = "line-2"\nshifts = ["06:00Z"]', "without a time zone"),
        ('name = "line-2"', 'name = "line-2"\nshifts = ["06:00", "06:00"]', "the same start"),
    ],
)
def test_what_is_wrong_with_a_station_file_is_named(
    tmp_path: Path, old: str, new: str, why: str
) -> None:
    with pytest.raises(UsageError) as caught:
        load_config(written(tmp_path, USUAL.replace(old, new, 1)))
    reported = str(caught.value)
    assert any(each in reported for each in why.split("|")), reported


def test_adapters_are_found_by_what_they_are_not_by_their_order(tmp_path: Path) -> None:
    sockets = load_config(written(tmp_path, USUAL)).socket
    for order in (PLUGGED, PLUGGED[::-1]):
        found = resolve(sockets, order)
        assert found[0].bus == {
            "interface": "slcan",
            "channel": "/dev/ttyACM0",
            "ttyBaudrate": 115200,
        }
        assert found[1].bus == {"interface": "socketcan", "channel": "can1"}
        assert found[2].bus == {"interface": "pcan", "channel": "PCAN_USBBUS1"}
        assert found[3].bus is None


def test_an_adapter_that_is_not_plugged_in_is_named() -> None:
    with pytest.raises(BusError, match="Socket X: no slcan adapter with the serial number C3"):
        resolve([socket(interface="slcan", serial_number="C3")], PLUGGED)


@each(
    "sockets",
    [
        [
            socket(interface="slcan", serial_number="A1"),
            socket(name="Y", interface="slcan", channel="/dev/ttyACM0"),
        ],
        [
            socket(interface="slcan", serial_number="A1"),
            socket(name="Y", interface="slcan", usb_path="1-1.2"),
        ],
    ],
)
def test_two_ways_to_the_same_adapter_are_refused(sockets: Sequence[SocketConfig]) -> None:
    with pytest.raises(UsageError, match="Sockets X and Y have the same adapter"):
        resolve(sockets, PLUGGED)


def test_a_channel_of_several_has_to_be_named() -> None:
    with pytest.raises(UsageError, match="has 2 channels: 0, 1"):
        resolve([socket(interface="kvaser", serial_number="77")], PLUGGED)
    both = [
        socket(name=str(number), interface="kvaser", serial_number="77", channel=number)
        for number in (0, 1)
    ]
    assert [found.bus and found.bus["channel"] for found in resolve(both, PLUGGED)] == ["0", "1"]


def test_the_system_s_can_interfaces_are_found_with_their_usb_device(tmp_path: Path) -> None:
    device = tmp_path / "devices" / "usb1" / "1-1.4"
    (device / "1-1.4:1.0").mkdir(parents=True)
    (device / "serial").write_text("004500\n")
    (device / "idVendor").write_text("1d50\n")
    network = tmp_path / "net"
    for name, kind in (("can1", "280"), ("eth0", "1"), ("vcan0", "280")):
        (network / name).mkdir(parents=True)
        (network / name / "type").write_text(kind + "\n")
    (network / "can1" / "device").symlink_to(device / "1-1.4:1.0")
    found = detect([socket(interface="socketcan", serial_number="x")], network=network)
    assert found == (
        DetectedAdapter("socketcan", "can1", {"serial_number": "004500", "usb_path": "1-1.4"}),
        DetectedAdapter("socketcan", "vcan0"),
    )
    assert detect([socket(interface="socketcan", channel="can1")], network=network) == ()


def test_a_power_command_has_words_and_no_shell() -> None:
    assert power_command("relay 3 {on|off}", on=True) == ["relay", "3", "on"]
    assert power_command("relay '3; rm' --set={1|}", on=False) == ["relay", "3; rm", "--set="]
    for wrong in ("", "relay", "relay {on|off} {on|off}", "relay {on|off}{on|off}", "relay '{a|b"):
        with pytest.raises(ValueError, match=r"."):
            power_command(wrong, on=True)


def test_a_station_of_virtual_units_has_as_many_sockets_as_asked() -> None:
    config = mock_config(4, MockUnits(bad=0.2))
    assert [each.name for each in config.socket] == ["1", "2", "3", "4"]
    assert all(found.bus is None for found in resolve(config.socket, ()))
    for count in (0, SOCKETS_MAX + 1):
        with pytest.raises(UsageError, match="sockets"):
            mock_config(count, MockUnits())
