"""The mark of the samples: in all of them, in whatever they are converted to, nowhere else."""

from __future__ import annotations

import random
import runpy
from pathlib import Path

import bincopy
import pytest
from intelhex import IntelHex

from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.sample import MARK, is_sample
from tests.image.test_firmware_samples import SAMPLES, SCRIPT
from tests.loops import each

BAD = SAMPLES / "bad"
GOOD = [*SAMPLES.glob("*.[hbse]*[xn9f]"), *SAMPLES.glob("station/*.bin")]
SMALLEST_PART = 512
"""In bytes: less is no program with its vector table."""


def test_the_script_writes_the_mark_that_is_looked_for() -> None:
    assert runpy.run_path(str(SCRIPT))["MARK"] == MARK
    assert len(MARK) == 16


def test_every_sample_is_known_as_one() -> None:
    assert len(GOOD) == 7
    for path in GOOD:
        assert is_sample(load(path)), path


@each("path", GOOD)
def test_any_part_of_a_sample_is_known_as_one(path: Path) -> None:
    image = load(path)
    assert is_sample(Image.from_bytes(image.data[:64])), "a vector table has it"
    for segment in image.segments:
        first = segment.start - (image.base or 0)
        for start in range(first, first + segment.size_bytes - SMALLEST_PART, 52):
            part = image.data[start : start + SMALLEST_PART]
            assert is_sample(Image.from_bytes(part)), start


@each(
    "name, options",
    [
        ("text.bin", {}),
        ("zip.bin", {}),
        ("utf_16.bin", {}),
        ("gap.hex", {"fill_gaps_up_to": 0x4000}),
        ("gap.s19", {"fill_gaps_up_to": 0x4000}),
        ("gap.elf", {"fill_gaps_up_to": 0x4000}),
        ("outside_vector.hex", {"allow_outside_vector": True}),
        ("hex_inside.bin", {"format": "bin"}),
        ("check_sum.s19", {"format": "bin"}),
        ("not.elf", None),
    ],
)
def test_a_bad_file_that_can_be_forced_is_known_too(
    name: str, options: dict[str, object] | None
) -> None:
    if options is None:
        assert not any((BAD / name).read_bytes()), "zeros do no harm that a mark could prevent"
        return
    assert is_sample(load(BAD / name, **options))  # type: ignore[arg-type]


def test_a_conversion_keeps_the_mark(tmp_path: Path) -> None:
    def known(name: str, **options: str) -> bool:
        return is_sample(load(tmp_path / name, **options))  # type: ignore[arg-type]

    for sample in ("bms.hex", "wmc.hex"):
        hexed = IntelHex(str(SAMPLES / sample))
        hexed.tobinfile(str(tmp_path / "x.bin"))
        for width in (8, 16, 32):
            hexed.write_hex_file(str(tmp_path / "x.hex"), byte_count=width)
            assert known("x.hex")
        file = bincopy.BinFile(str(SAMPLES / sample))
        (tmp_path / "x.s19").write_text(file.as_srec())
        (tmp_path / "x.txt.hex").write_text(file.as_ihex())
        assert known("x.bin")
        assert known("x.s19")
        # A file of records that is forced to be sent as it is.
        for name in ("x.s19", "x.hex", "x.txt.hex"):
            assert known(name, format="bin")


@pytest.mark.parametrize("seed", range(3))
def test_other_images_do_not_have_it(seed: int) -> None:
    assert not is_sample(Image.from_bytes(random.Random(seed).randbytes(1 << 20)))
