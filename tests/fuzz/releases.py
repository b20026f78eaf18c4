"""Harness of signed releases."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flasher.errors import ImageError
from flasher.image.image import Image
from flasher.protocol.spec import BMS
from flasher.release import container, verify
from flasher.release.build import build
from flasher.release.statement import Part
from flasher.release.transparency import ReleaseLog
from flasher.settings.manifest import release_of
from tests.fuzz.harness import Harness
from tests.release.maker import Maker, key, signed


def take_release(data: bytes) -> None:
    members = container.unpack(data, "fuzz.wfw")
    assert container.pack(members) == data
    package = verify.parse_package(members, "fuzz.wfw")
    for target in package.targets:
        image, release = verify.image_of(package, target)
        assert (image.sha256, release.target) == (release.sha256, target)


def _releases() -> Iterator[bytes]:
    content = bytes(range(64))
    image = Image.from_bytes(content)
    release = release_of(image, BMS, product="48V", counter=1)
    part = {BMS: Part("bms.bin", content, image, release)}
    raw, _ = build(part, released="2026-02-01")
    yield raw
    yield signed(raw, ("anna",))
    raw, _ = build(
        part,
        released="2026-02-01",
        notes=b"Notes.",
        chain=Maker().chain,
        log=ReleaseLog(),
        log_keys=[key("log")],
    )
    yield raw


HARNESSES: Final = {
    "release": Harness(
        take_release,
        _releases,
        "flasher.release.container.pack",
        (ImageError,),
        max_size=8192,
        words=lambda: (container.STATEMENT, container.TRUST, container.LOG, "PK\x03\x04"),
    )
}
