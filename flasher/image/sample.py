"""The mark of the firmware samples, which are no firmware and must not reach a real device.

`firmware_samples/make_samples.py` writes it into every sample, often enough that any part of one
that could pass for a program has it. A conversion to another format keeps the bytes, so it keeps
the mark.
"""

from __future__ import annotations

from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.i18n import text
from flasher.image.image import Image

MARK: Final = b"#flasher:sample#"
"""Sixteen bytes at a multiple of sixteen: a line of a hex or S-record file has them whole."""
_MARK_IN_RECORDS: Final = MARK.hex().encode("ascii")


def is_sample(image: Image) -> bool:
    """True when the bytes to be sent are, or hold, a firmware sample, also one whose file was read
    as a raw binary.
    """
    return MARK in image.data or _MARK_IN_RECORDS in image.data.lower()


def sample_error(image: Image, adapter: str) -> ImageError:
    """The error for a sample that was to be sent through a physical adapter. Nothing waives it."""
    return ImageError(
        text("{image} is a firmware sample: no device can run it.", image=image.source),
        where=text("{adapter}, a physical CAN controller or one of unknown kind", adapter=adapter),
        cause=text("a sample was named where the firmware of the device was meant"),
        remedy=text("Name the firmware of the device. Samples are for --mock and virtual buses."),
        code=ErrorCode.IMAGE_SAMPLE,
    )
