"""Firmware samples: the mark that keeps them from real devices.

`firmware_samples/make_samples.py` repeats the mark so often that any usable part of a sample
contains it. It survives conversion to another file format.
"""

from __future__ import annotations

from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.i18n import text
from flasher.image.image import Image

MARK: Final = b"#flasher:sample#"
"""Sixteen bytes, at multiples of sixteen: one line of a HEX or S-record file contains a whole
mark."""
_MARK_IN_RECORDS: Final = MARK.hex().encode("ascii")


def is_sample(image: Image) -> bool:
    """True if the image contains the mark of a firmware sample, also as undecoded hex records."""
    return MARK in image.data or _MARK_IN_RECORDS in image.data.lower()


def sample_error(image: Image, adapter: str) -> ImageError:
    """Create the error for a sample on a physical adapter. It cannot be waived."""
    return ImageError(
        text("{image} is a firmware sample: no device can run it.", image=image.source),
        where=text("{adapter}, a physical CAN controller or one of unknown kind", adapter=adapter),
        cause=text("a sample was named where the firmware of the device was meant"),
        remedy=text("Name the firmware of the device. Samples are for --mock and virtual buses."),
        code=ErrorCode.IMAGE_SAMPLE,
    )
