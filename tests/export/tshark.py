"""tshark with the exported dissector, and what it says of a capture."""

from __future__ import annotations

import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from flasher.export.wireshark import dissector
from flasher.protocol.frame import Frame
from flasher.trace.pcapng import PcapngWriter
from flasher.trace.recorder import message_of

needs_tshark = pytest.mark.skipif(
    shutil.which("tshark") is None,
    reason="tshark is not installed (apt-get install tshark)",
)


@dataclass(frozen=True)
class Shown:
    """One field as tshark shows it."""

    name: str
    show: str
    value: str
    text: str


@dataclass(frozen=True)
class Item:
    """One message, or one stretch of damage, in the packet that completed it."""

    frame: int
    fields: tuple[Shown, ...]

    def all(self, name: str) -> list[str]:
        return [each.show for each in self.fields if each.name == f"welling.{name}"]

    def one(self, name: str) -> str:
        found = self.all(name)
        assert len(found) == 1, (name, found, self)
        return found[0]


def write_capture(path: Path, frames: Iterable[tuple[float, Frame]]) -> Path:
    """A .pcapng of these frames."""
    writer = PcapngWriter(path)
    for at, frame in frames:
        writer(message_of(frame, sent=False, at_s=at))
    writer.stop()
    return path


def run(*words: str | Path, folder: Path) -> str:
    """What tshark prints, with the dissector loaded and no user's settings."""
    script = folder / "welling.lua"
    if not script.exists():
        script.write_text(dissector("0"), encoding="utf-8")
    program = os.environ.get("FLASHER_TEST_TSHARK_PROGRAM", "tshark")
    ran = subprocess.run(
        [program, "-X", f"lua_script:{script}", *map(str, words)],
        env={"PATH": os.environ["PATH"], "HOME": str(folder), "LC_ALL": "C.UTF-8"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "Lua" not in ran.stderr, ran.stderr
    return ran.stdout


def items(capture: Path, folder: Path, *options: str) -> Iterator[Item]:
    """What the dissector finds, in the order of the capture."""
    printed = run("-r", capture, "-T", "pdml", "-Y", "welling.kind", *options, folder=folder)
    for packet in ET.fromstring(printed):  # noqa: S314  tshark wrote it
        number = next(
            field.get("show") for field in packet.iter("field") if field.get("name") == "num"
        )
        for proto in packet.iter("proto"):
            if proto.get("name") == "welling":
                fields = tuple(
                    Shown(
                        field.get("name", ""),
                        field.get("show", ""),
                        field.get("value", ""),
                        field.get("showname", ""),
                    )
                    for field in proto.iter("field")
                )
                if any(field.name == "welling.kind" for field in fields):
                    yield Item(int(number or 0), fields)
