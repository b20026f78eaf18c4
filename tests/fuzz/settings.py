"""Harnesses of settings and documents: manifest, profiles, the report of the suite."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Final

from flasher.conformance import diff
from flasher.conformance import profile as conformance_profile
from flasher.conformance.results import CaseVerdict
from flasher.errors import ImageError, UsageError
from flasher.protocol.spec import TARGETS
from flasher.settings import manifest
from flasher.settings import profile as target_profile
from flasher.settings.toml_reader import Key
from tests.fuzz.harness import Harness, own_words, written
from tests.hostile import good
from tests.hostile.files import SAMPLES


def toml_words(keys: Iterable[Key]) -> list[str]:
    """Keys, tables and choices of a file."""
    words = {"[", "]", "[[", "]]", " = ", "'", '"', "true", "0x", "{ ", " }", "inf", "1979-05-27"}
    for key in keys:
        table, _, name = key.path.rpartition(".")
        words |= {f"{name} = ", f"[{table}]\n", f'"{key.default}"', *map(repr, key.choices)}
    return sorted(words)


# -- manifest --------------------------------------------------------------------------------------


def take_manifest(data: bytes) -> None:
    path = written(data, ".hex.toml")
    release = manifest.read_release(path)
    written(manifest.to_toml(release).encode(), ".hex.toml")
    with own_words():
        assert manifest.read_release(path) == release


def _manifests() -> Iterator[bytes]:
    yield (SAMPLES / "station" / "bms.bin.toml").read_bytes()
    assert manifest.__doc__ is not None
    text = manifest.__doc__.partition("`firmware.hex.toml`:")[2].rpartition("\n\n")[0]
    yield text.replace("5084b23b...", "5084b23b" * 8).replace("    ", "").encode()


# -- profiles --------------------------------------------------------------------------------------


def take_target_profile(data: bytes) -> None:
    path = written(data, ".toml")
    assert set(target_profile.check_profile(path)) <= set(TARGETS.values())


def _target_profiles() -> Iterator[bytes]:
    yield good.TARGET_PROFILE
    yield (
        b"[bms]\nimage_limit_bytes = 0x10000\n"
        b"application_area = { start = 0x08002000, size_bytes = 0x10000 }\n"
    )


def take_conformance_profile(data: bytes) -> None:
    path = written(data, ".toml")
    profile = conformance_profile.load_profile(path)
    written(profile.to_toml().encode(), ".toml")
    with own_words():
        assert conformance_profile.load_profile(path) == profile


def _conformance_profiles() -> Iterator[bytes]:
    yield good.CONFORMANCE_PROFILE
    yield conformance_profile.ConformanceProfile({"tx_02": "nak_next"}).to_toml()[:2000].encode()


# -- report ----------------------------------------------------------------------------------------


def take_report(data: bytes) -> None:
    report = diff.read_report(written(data, ".json"))
    assert not diff.compare(report, report).is_worse


def _reports() -> Iterator[bytes]:
    report = good.conformance_report()
    yield report
    yield json.dumps({"report": json.loads(report)}).encode()


def _report_words() -> list[str]:
    names = [f'"{name}": ' for name in json.loads(good.conformance_report())]
    return [*names, *(f'"{verdict.value}"' for verdict in CaseVerdict), "{", "}", "[", "]", "null"]


_BELOW: Final = "flasher.settings.toml_reader.to_json"

HARNESSES: Final = {
    "manifest": Harness(
        take_manifest,
        _manifests,
        _BELOW,
        (ImageError,),
        words=lambda: toml_words(manifest.reader().keys.values()),
    ),
    "target-profile": Harness(
        take_target_profile,
        _target_profiles,
        _BELOW,
        (UsageError,),
        words=lambda: toml_words(target_profile.reader().keys.values()),
    ),
    "conformance-profile": Harness(
        take_conformance_profile,
        _conformance_profiles,
        _BELOW,
        (UsageError,),
        words=lambda: toml_words(conformance_profile.profile_keys().values()),
    ),
    "conformance-report": Harness(
        take_report,
        _reports,
        "flasher.conformance.diff.adapter",
        (UsageError,),
        words=_report_words,
    ),
}
