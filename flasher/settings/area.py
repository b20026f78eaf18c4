"""Application area: address range of an application, which the documents do not give."""

from __future__ import annotations

from dataclasses import dataclass

from flasher.host.query import check_range
from flasher.i18n import text
from flasher.image.image import Image
from flasher.protocol.text import printable
from flasher.settings.profile import Profile


@dataclass(frozen=True)
class Area:
    """Address range; `end` is exclusive."""

    start: int
    end: int
    source: str
    """Origin of the range, for messages."""

    @property
    def size_bytes(self) -> int:
        return self.end - self.start


def area_of_image(image: Image) -> Area | None:
    """Address range of an image; None for a raw binary. Raises UsageError for an invalid range."""
    if image.base is None:
        return None
    end = image.base + image.size_bytes
    check_range(image.base, end)
    return Area(image.base, end, text("the image {name}", name=printable(image.source)))


def area_of_profile(profile: Profile) -> Area | None:
    """Application area of a profile; None if not set. Raises UsageError for an invalid range."""
    area = profile.application_area
    if area is None:
        return None
    check_range(area.start, area.end)
    return Area(area.start, area.end, text("application_area of the profile"))
