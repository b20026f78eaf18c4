"""Right bootloaders in C, written from the document alone (`right_c`), each with its own choices of
what the document leaves open: a generator that does not share the blindness of our device model.
`python -m tests.campaigns.right_devices --c` judges them.
"""

from __future__ import annotations

import hashlib
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

from flasher.conformance.dut.process import BootloaderProcess
from flasher.conformance.dut.subject import CompiledSubject
from flasher.conformance.profile import ConformanceProfile, Limits, Value
from tests.campaigns.right_c_in_process import CALLS, LoadedBootloader

_SOURCES: Final = Path(__file__).parent / "right_c"
_IN_PROCESS: Final = _SOURCES.with_name("right_c_in_process.c")
_DUT: Final = Path(__file__).parents[2] / "flasher" / "conformance" / "dut"
_LIMITS: Final = Limits()
_US: Final = 1_000_000
_PACKET_BYTES: Final = 128
_BURST_DEFAULT: Final = 4
_ON_BUS_US: Final = 12_000
"""The time of an answer on a loaded bus."""
_HEARD_AGAIN_US: Final = 50_000
"""The end of transfer can be answered again so long after complete."""
_CHEAPEST: Final = LoadedBootloader if sys.platform == "linux" else BootloaderProcess
"""Other linkers cannot wrap calls."""
_BARE: Final = ("has_power", "has_readback", "has_bus_off", "has_timed_cuts")
_NODES: Final = {"wmc": 1, "bms": 2, "obc": 3}

Choices = Mapping[str, int]
"""Macros of `choices.h`, all that are not the default among them."""


@dataclass(frozen=True)
class RightCDevice:
    """How to build one, and the profiles that it is judged by."""

    seed: int
    target: str
    choices: Choices
    boot_version: str
    is_bare: bool
    """On a bench without power control and readback."""

    @cached_property
    def profiles(self) -> dict[str, ConformanceProfile]:
        """One that states its choices, and the default one with its sizes."""
        sizes = _sizes(self.choices)
        fitting = sizes | _stated(self.choices)
        return {
            "fitting": ConformanceProfile(fitting, source=f"C device {self.seed}"),
            "default": ConformanceProfile(sizes, source="defaults"),
        }

    @contextmanager
    def subject(self, kind: type[BootloaderProcess] = _CHEAPEST) -> Iterator[CompiledSubject]:
        """It on its bench, loaded into this process or as users run theirs."""
        path = _build(self.choices, self.boot_version, is_library=kind is LoadedBootloader)
        with closing(kind(str(path))) as process:
            made = CompiledSubject(process, self.target)
            for ability in _BARE if self.is_bare else ():
                setattr(made, ability, False)
            yield made

    def __str__(self) -> str:
        bench = "bare bench" if self.is_bare else "full bench"
        macros = " ".join(f"{name}={value}" for name, value in self.choices.items())
        return f"{self.target}, {bench}, {self.boot_version}, {macros}"


def right_c_device(seed: int) -> RightCDevice:
    """The device of that seed."""
    chance = random.Random(f"right C/{seed}")
    target = chance.choice(("bms", "bms", "bms", "bms", "wmc", "obc"))
    choices: dict[str, int] = {"NODE": _NODES[target]}
    choices |= _flash(chance)
    choices |= _behaviour(chance, has_version_query=target == "bms")
    if choices["RESET_FEEDBACK"]:  # as to any write that is not of the upgrade
        choices["FEEDBACK"] = max(choices["FEEDBACK"], 1)
    choices |= _times(chance, choices)
    if choices["ACKS_FIRST"]:
        # It hears what follows its ACK only when it has written, and here no filter of its
        # controller keeps the frames of other nodes away.
        choices["RECEIVE_FRAMES"] = 4096
    can_leave = choices["PAUSE_US"] or choices["RESET_RESTARTS_TRANSFER"]
    is_bare = chance.random() < 0.3 and bool(can_leave or choices["UPDATE_RESTARTS"])
    version = f"V{chance.randrange(10)}.{chance.randrange(10)}.{chance.randrange(10)}"
    return RightCDevice(seed, target, choices, version, is_bare)


# -- choices ---------------------------------------------------------------------------------------


def _flash(chance: random.Random) -> dict[str, int]:
    sector = chance.choice((256, 256, 512, 512, 1024, 2048))
    sectors = chance.randint(-(-4096 // sector), 10240 // sector)
    if chance.random() < 0.05:
        sectors = 33 * 1024 // sector  # more than 255 packets
    write = chance.choice([size for size in (1, 2, 4, 8, 16, 32, 64, 256) if size <= sector])
    # The last sector need not be whole.
    area = sectors * sector - chance.choice((0, 0, write, sector - write)) % sector
    whole = -(-area // max(_PACKET_BYTES, write)) * max(_PACKET_BYTES, write)
    pages = [
        size
        for size in (_PACKET_BYTES, _PACKET_BYTES, 256, 512, sector, 4 * sector, whole)
        if size % write == 0 and size % _PACKET_BYTES == 0
    ]
    banks = chance.choice((1, 1, 1, 2, 3))
    return {
        "SECTOR_BYTES": sector,
        "WRITE_BYTES": write,
        "APPLICATION_BYTES": area,
        "LARGEST_BYTES": chance.choice((area, area, chance.randint(2 * area // 3, area))),
        "RECEIVE_FRAMES": chance.choice((64, 64, 256)),
        "BANKS": banks,
        "RECORD_FIRST": chance.randrange(2),
        "ERASE": chance.randrange(3),
        "RECORD_DROPPED_LATE": chance.randrange(2),
        "PAGE_BYTES": chance.choice(pages),
        "ACKS_FIRST": chance.randrange(2),
        "LAST_AT_END": chance.randrange(2),
        "UNIT_BY_UNIT": chance.randrange(2) if write >= 8 else 0,
        "SKIPS_BLANK": chance.randrange(2) if write >= 8 else 0,
        "VERIFIES": chance.randrange(2),
        "RETRIES": chance.randrange(3),
        "COPIES_BEFORE_COMPLETE": chance.randrange(2),
        "KEEPS_SECOND": chance.randrange(2),
        "IMAGE_CHECKSUM": chance.choice((0, 0, 1)),
    }


def _behaviour(chance: random.Random, *, has_version_query: bool) -> dict[str, int]:
    yes_or_no = (
        "LISTENS",
        "HEARS_BEFORE",
        "DEAF_ANSWERS",
        "HEARS_LATE",
        "RESET_RESTARTS",
        "RESTART_BY_RESET",
        "JUNK_LOSES",
        "RESCANS",
        "SHORT_FRAMES_REJECTED",
        "PADDING_IGNORED",
        "UPDATE_NAK",
        "ERASE_IN_PASSES",
        "ERASING_HEARS",
        "ERASES_AGAIN",
        "UPDATE_RESTARTS",
        "DAMAGED_ANY",
        "LOST_FRAME_NAKS",
        "BEYOND_ASKS_LAST",
        "REPEATED_NAKS_NEXT",
        "FILLER_CHECKED",
        "RESET_RESTARTS_TRANSFER",
        "WRITE_ERROR_NAKS",
        "EARLY_END_FAILS",
        "DAMAGED_END_NAKS",
        "END_ANSWERS_AGAIN",
        "COMPLETE_RESTARTS",
    )
    picked = {name: chance.randrange(2) for name in yes_or_no}
    wrong = chance.randrange(3)
    return picked | {
        "BURST": chance.choice((4, 4, 4, 4, 1, 2, 6)),
        "BURST_HEARS": chance.randrange(3),
        "FEEDBACK": chance.randrange(3),
        # Elsewhere only this confirmation shows that an application runs.
        "RESET_FEEDBACK": chance.randrange(2) if has_version_query else 0,
        "BEFORE_FIRST": chance.randrange(3),
        "WRONG_PACKET": wrong,
        "DAMAGED_PACKET": chance.choice((wrong, wrong, chance.randrange(3))),
        "OLDER_PACKET": chance.randrange(4),
        "PAUSE_COUNTS": chance.randrange(3),
        "END_NAK": chance.randrange(3),
    }


def _times(chance: random.Random, choices: Choices) -> dict[str, int]:
    """Times from 0 to the limits of the default profile, many of them at their limit."""

    def drawn(limit_s: float, used_us: int = 0) -> int:
        left_us = max(round(limit_s * _US) - used_us - _ON_BUS_US, 0)
        return round(chance.choice((0.0, 0.0, chance.random(), 1.0)) * left_us)

    made = dict(choices)
    sector, page = choices["SECTOR_BYTES"], choices["PAGE_BYTES"]
    sectors = -(-choices["APPLICATION_BYTES"] // sector)
    # One call that writes: a page, and the sectors that it begins.
    written_us = drawn(_LIMITS.ack_s)
    erased = (-(-page // sector) + 2) * (choices["ERASE"] == 2)
    units = page // choices["WRITE_BYTES"] + 3
    all_units = sectors * sector // choices["WRITE_BYTES"]
    share = chance.random() if erased else 0.0
    made["ERASE_US"] = (
        round(written_us * share / erased) if erased else drawn(_LIMITS.erase_s) // (sectors + 2)
    )
    made["WRITE_US"] = round(written_us * (1 - share) / units)
    installs_us = 0
    if choices["BANKS"] > 1:  # within the time of a start, and once more after a power cut
        ways = 1 if choices["BANKS"] == 2 else 3
        erases, writes = ways * sectors + 4, ways * (all_units + sectors) + 4
        made["ERASE_US"] = min(made["ERASE_US"], round(0.3 * _US / erases))
        made["WRITE_US"] = min(made["WRITE_US"], round(0.3 * _US / writes))
        installs_us = 2 * (erases * made["ERASE_US"] + writes * made["WRITE_US"])
    page_us = erased * made["ERASE_US"] + units * made["WRITE_US"]
    made["SPACING_US"] = chance.choice((42_000, 50_000, 50_000, 58_000))
    made["WINDOW_US"] = chance.choice((52_500, 200_000, 995_000))
    made["START_US"] = drawn(_LIMITS.start_s, installs_us)
    if choices["HEARS_LATE"]:  # the window has an end, and what comes after it a length
        made["WINDOW_US"] = min(made["WINDOW_US"], 200_000)
        made["START_US"] = max(100_000, min(made["START_US"], 995_000 - made["WINDOW_US"]))
    burst_us = choices["BURST"] * made["SPACING_US"] + made["WINDOW_US"]
    # From a refused image, through a restart.
    made["REFUSED_US"] = drawn(_LIMITS.refused_s, installs_us + 30_000)
    first_s = _LIMITS.refused_s - made["REFUSED_US"] / _US
    made["FIRST_US"] = drawn(first_s, installs_us + 30_000)
    if choices["COMPLETE_RESTARTS"]:
        left_us = round(_LIMITS.start_s * _US) - burst_us - installs_us - made["FIRST_US"] - 60_000
        made["START_US"] = min(made["START_US"], max(left_us // 2, 0))
    made["GAP_US"] = chance.choice((0, 0, 0, 300_000, 900_000))
    made["FRAME_GAP_US"] = chance.choice((101_000, 120_000, 180_000))
    # From an update command in the burst, which it may process after the window (R12).
    waits_us = burst_us if choices["BURST_HEARS"] == 2 else 0
    made["REQUEST_US"] = drawn(_LIMITS.erase_s, page_us + waits_us)
    made["ACK_US"] = drawn(_LIMITS.ack_s, page_us)
    made["NAK_US"] = drawn(_LIMITS.ack_s, page_us)
    made["END_NAK_US"] = drawn(_LIMITS.complete_s, 2 * page_us)
    made["COMPLETE_US"] = drawn(_LIMITS.complete_s, 2 * page_us + installs_us)
    made["PAUSE_US"] = chance.choice((0, 2_500_000, 4_990_000, 9_000_000))
    if not made["PAUSE_US"] and not choices["BEFORE_FIRST"]:
        # It would wait for a packet for ever when its request is lost.
        made["BEFORE_FIRST"] = 1
    return made


# -- the profiles ----------------------------------------------------------------------------------


def _sizes(choices: Choices) -> dict[str, Value]:
    sizes: dict[str, Value] = {
        "device.application_bytes": choices["APPLICATION_BYTES"],
        "device.largest_image_bytes": choices["LARGEST_BYTES"],
    }
    if choices["BURST"] != _BURST_DEFAULT:
        sizes["device.versions"] = choices["BURST"]
    if choices["PAGE_BYTES"] > _PACKET_BYTES or choices["ACKS_FIRST"] or choices["LAST_AT_END"]:
        sizes["device.buffer_bytes"] = choices["PAGE_BYTES"]
    if 0 < choices["PAUSE_US"] < _LIMITS.pause_s * _US:
        sizes["limits.pause_s"] = choices["PAUSE_US"] / _US
    return sizes


def _stated(choices: Choices) -> dict[str, Value]:
    """What a profile says of these choices."""
    has = choices.__getitem__
    wrong = ("silence", "nak_expected", "nak_received")
    stated: dict[str, Value] = {
        "fr_01": "rejected" if has("SHORT_FRAMES_REJECTED") else "accepted",
        "fr_02": "lost" if has("JUNK_LOSES") else "found",
        "fr_04": "rescanned" if has("RESCANS") and not has("JUNK_LOSES") else "dropped",
        "fr_07": "ignored" if has("PADDING_IGNORED") else "rejected",
        "fr_10": "either" if has("FEEDBACK") or has("RESET_FEEDBACK") else "silence",
        "rs_02": "restarts" if has("RESET_RESTARTS") else "ignored",
        "rs_03": "listens" if has("LISTENS") else "announces",
        "rs_03_old": "kept" if has("BANKS") > 1 else "erased",
        "up_02": "nak" if has("UPDATE_NAK") else "silence",
        "up_04": "accepted" if has("HEARS_LATE") else "rejected",
        "up_04_burst": "accepted" if has("BURST_HEARS") else "rejected",
        "up_05": "either",
        "up_08": "starts_over" if has("UPDATE_RESTARTS") else "rejected",
        "tx_01": "either",
        "tx_01_lost_frame": "nak" if has("LOST_FRAME_NAKS") else "silence",
        "tx_02": "nak_next" if has("REPEATED_NAKS_NEXT") else "ack",
        "tx_03": ("silence", "ack", "nak", "nak")[has("OLDER_PACKET")],
        "tx_08": "rejected" if has("FILLER_CHECKED") else "ignored",
        "tx_12": "announces" if has("PAUSE_US") else "waits",
        "tx_13": "restarts" if has("RESET_RESTARTS_TRANSFER") else "ignored",
        "en_02": "same_answer" if has("END_ANSWERS_AGAIN") else "silence",
        "en_03": "restarts" if has("COMPLETE_RESTARTS") else "starts",
        "en_04": "crc32" if has("IMAGE_CHECKSUM") else "none",
        "limits.version_spacing_s": has("SPACING_US") / _US,
        "limits.window_s": has("WINDOW_US") / _US,
        "limits.inter_frame_s": (has("FRAME_GAP_US") - 1000) / _US,
    }
    if has("PAUSE_US"):
        stated["limits.pause_s"] = has("PAUSE_US") / _US
    if has("BANKS") == 1 and has("ERASE") == 2 and has("RECORD_DROPPED_LATE"):
        stated["rs_03_old"] = "either"
    if not has("ERASING_HEARS") and not has("BEFORE_FIRST"):
        stated["up_05"] = "once"
    # It reads a frame a pass: after the erase of a sector the rest of a message may come too late.
    is_quick = not has("ERASE_IN_PASSES") or has("ERASE_US") < has("FRAME_GAP_US")
    if has("ERASING_HEARS") and has("BEFORE_FIRST") and is_quick:
        stated["up_05"] = "each"
    if min(has("START_US"), has("REFUSED_US")) < _HEARD_AGAIN_US:
        stated["en_02"] = "either"
    if has("WRONG_PACKET") == has("DAMAGED_PACKET"):
        stated["tx_01"] = wrong[has("WRONG_PACKET")]
    return stated


# -- building --------------------------------------------------------------------------------------


def _build(choices: Choices, boot_version: str, *, is_library: bool) -> Path:
    """The program or library of these choices; one that exists is taken."""
    macros = [f"-D{name}={value}" for name, value in choices.items()]
    macros.append(f'-DBOOT_VERSION="{boot_version}"')
    sources = [*sorted(_SOURCES.glob("*.c")), _DUT / "flasher_dut_process.c"]
    command = ["cc", "-std=c11", "-O0", "-Wall", "-Wextra", f"-I{_DUT}", *macros]
    if is_library:
        sources.append(_IN_PROCESS)
        wrapped = ",".join(f"--wrap={name}" for name in CALLS)
        command += ["-shared", "-fPIC", "-Dmain=bootloader_main", f"-Wl,-z,now,{wrapped}"]
    contents = b"".join(path.read_bytes() for path in sorted(_SOURCES.iterdir()) + sources)
    name = hashlib.sha256(repr(command).encode() + contents).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / "right_c"
    folder.mkdir(exist_ok=True)
    program = folder / f"{name}{'.so' if is_library else ''}"
    if not program.exists():
        made = program.with_suffix(f".{os.getpid()}")
        command += [*map(str, sources), "-o", str(made)]
        subprocess.run(command, check=True, capture_output=True)
        made.replace(program)
    return program
