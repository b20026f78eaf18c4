"""Bike set: a TOML file that names an image for each device of a bike.

    [[target]]
    target = "wmc"
    image = "motor.hex"
    firmware_version = "V2r1r0_20230117"

    [[target]]
    target = "bms"
    image = "battery.hex"

A recipe of the station names its images by the same tables.
"""

from __future__ import annotations

import os
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from flasher.image.release import FirmwareText
from flasher.protocol.spec import TARGETS, Target, find_target
from flasher.settings.toml_reader import Reader, TomlTable


def _target_name(value: str) -> str:
    target = find_target(value)
    if target is None:
        raise ValueError(f"unknown target {value!a:.20}; targets are {', '.join(TARGETS)}")
    return target.name


class TargetTable(TomlTable):
    """Base of tables that name a target."""

    target: Annotated[str, AfterValidator(_target_name)]
    """Name of the device, for example "bms"."""

    @property
    def device(self) -> Target:
        return TARGETS[self.target]


class TargetImage(TargetTable):
    """A target and its image."""

    image: str = Field(min_length=1)
    """The image, or the release (`*.wfw`) with it, from the folder of this file."""
    manifest: str = ""
    """The release manifest of the image; empty: `IMAGE.toml` beside the image. A release contains
    its own."""
    base: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    """Address of the first byte of a raw binary."""


class BikeTarget(TargetImage):
    """A device of a bike, and its image."""

    firmware_version: FirmwareText | None = None
    """Version that belongs to those of the other devices; another one is refused."""


def check_named_once(targets: tuple[TargetTable, ...]) -> None:
    """Raise ValueError for a target with two images."""
    names = [each.target for each in targets]
    if len(set(names)) < len(names):
        raise ValueError("a target is named twice in [[target]]")


class BikeSet(TomlTable):
    """Images of a bike's devices. The order of the tables has no meaning."""

    notes: str = ""
    """Notes for people."""
    target: tuple[BikeTarget, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_targets(self) -> BikeSet:
        check_named_once(self.target)
        return self


def read_bike_set(path: str | os.PathLike[str]) -> BikeSet:
    """Read a bike set. Raises UsageError with all problems of the file."""
    remedy = 'Each device has a table [[target]] with target = "bms" and image = "FILE".'
    return Reader(BikeSet, "bike set", remedy=remedy).load(path)
