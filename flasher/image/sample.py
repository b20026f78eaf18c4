"""Mark of the firmware samples, which are not firmware and must not reach a real device.

`firmware_samples/make_samples.py` writes it into every sample, so often that any plausible part of
one contains it. Converting the file to another format keeps the mark.
"""

from __future__ import annotations

from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.i18n import text
from flasher.image.image import Image

MARK: Final = b"#flasher:sample#"
"""Sixteen bytes at a multiple of sixteen, so that one line of a hex or S-record file contains all
of it."""
_MARK_IN_RECORDS: Final = MARK.hex().encode("ascii")


def is_sample(image: Image) -> bool:
    """True if the image contains a firmware sample, even as an unparsed record file."""
    return MARK in image.data or _MARK_IN_RECORDS in image.data.lower()


def sample_error(image: Image, adapter: str) -> ImageError:
    """Create the error for sending a sample through a physical adapter. It cannot be waived."""
    return ImageError(
        text("{image} is a firmware sample: no device can run it.", image=image.source),
        where=text("{adapter}, a physical CAN controller or one of unknown kind", adapter=adapter),
        cause=text("a sample was named where the firmware of the device was meant"),
        remedy=text("Name the firmware of the device. Samples are for --mock and virtual buses."),
        code=ErrorCode.IMAGE_SAMPLE,
    )
