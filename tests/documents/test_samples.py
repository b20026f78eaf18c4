"""No document leads a firmware sample to a real device: where an adapter is named, YOUR_IMAGE.hex
is flashed.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.documents.blocks import ROOT, pages

ADAPTER = re.compile(
    r"(?<![\w/])s?l?can\d|PCAN_USBBUS|/dev/tty(?:ACM|USB)|\bCOM\d|CAN_CHANNEL="
    r"|(?:-i |interface ?= ?[\"'])(?:pcan|slcan|gs_usb|kvaser|vector|ixxat|canalystii)"
)
"""An adapter on a real bus, as a command or a program names it."""
SAMPLE = re.compile(r"firmware_samples|(?<![\w./-])(?:bms|wmc|obc)\.(?:hex|bin|s19|elf)\b")
FLASHES = re.compile(
    r"\bflasher (?:flash|rescue|ui|station run|conformance)\b|\.(?:flash|rescue)\("
)
VIRTUAL = re.compile(r"--mock|mock=True|--dry-run|-i virtual|udp_multicast|-c v(?:x?can)\d|--help")
_FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
_SOURCES = [
    *(ROOT / "flasher").rglob("*.py"),
    ROOT / "pytest_flasher.py",
    *(ROOT / "examples").rglob("*.py"),
]
_SETTINGS = [
    path
    for folder in ("flasher", "examples", "docs")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".toml", ".html", ".sh", ".c", ".h", ".rst") and path.is_file()
]


@pytest.fixture(scope="module")
def texts() -> list[tuple[str, str]]:
    return list(_texts())


def _texts() -> Iterator[tuple[str, str]]:
    """Every passage that somebody may follow, with the place where it is."""
    for page in [*pages(), ROOT / "flasher" / "error_codes.md"]:
        for block in _FENCE.findall(page.read_text(encoding="utf-8")):
            yield str(page.relative_to(ROOT)), block
    for source in _SOURCES:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield f"{source.relative_to(ROOT)}:{node.lineno}", node.value
    for path in _SETTINGS:
        yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")


def faults(text: str) -> list[str]:
    """What in a passage would lead a sample to a device."""
    adapter, sample = ADAPTER.search(text), SAMPLE.search(text)
    found = [f"{sample[0]} beside {adapter[0]}"] if adapter and sample else []
    found += [
        f"not marked as virtual:  {line.strip()}"
        for line in text.replace("\\\n", " ").splitlines()
        if FLASHES.search(line) and SAMPLE.search(line) and not VIRTUAL.search(line)
    ]
    return found


@pytest.mark.slow
def test_no_passage_leads_a_sample_to_an_adapter(texts: list[tuple[str, str]]) -> None:
    found = {place: wrong for place, text in texts if (wrong := faults(text))}
    assert found == {}


@pytest.mark.parametrize(
    "text",
    [
        "flasher flash firmware_samples/bms.hex -t bms -i socketcan -c can0",
        "export CAN_INTERFACE=socketcan CAN_CHANNEL=can0\nflasher info -t bms --image bms.hex",
        "flasher rescue wmc.s19 -t wmc -i slcan -c COM3",
        "flasher flash firmware_samples/bms.hex -t bms --verify memory",
        'flasher.flash("obc.bin", "obc", interface="pcan", channel="PCAN_USBBUS1")',
        "battery.flash('bms.hex')",
    ],
)
def test_a_passage_that_does_is_found(text: str) -> None:
    assert faults(text)


@pytest.mark.parametrize(
    "text",
    [
        "flasher flash YOUR_IMAGE.hex -t bms -i socketcan -c can0",
        "flasher flash firmware_samples/bms.hex -t bms -i socketcan -c vcan0",
        "flasher flash firmware_samples/bms.hex -t bms --mock",
        "flasher image-info firmware_samples/bms.hex",
    ],
)
def test_others_are_let_through(text: str) -> None:
    assert not faults(text)


@pytest.mark.slow
def test_every_page_and_every_help_text_is_looked_at(texts: list[tuple[str, str]]) -> None:
    seen = {place.partition(":")[0] for place, _ in texts}
    assert {"README.md", "docs/index.md", "flasher/cli/main.py", "docs/tutorials/bike.md"} <= seen
    assert Path("flasher/__init__.py").as_posix() in seen
