"""Damaged releases: bytes, lengths, members and values of good ones, changed by chance."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from flasher import jobs
from flasher.errors import FlasherError
from flasher.image.load import load
from flasher.protocol.spec import BMS
from flasher.release.container import STATEMENT, pack, unpack
from flasher.release.envelope import json_bytes
from flasher.release.store import TrustStore
from flasher.release.transparency import ReleaseLog
from flasher.settings.profile import load_profile
from tests.release.maker import IMAGE, Maker, chain_of, first_trust, key, opened, role, trusted

_ODD: list[Any] = [
    None,
    "",
    "x" * 70_000,
    -1,
    2**63,
    2**70,
    0.5,
    True,
    [],
    {},
    [[]],
    "\ud800",
    "==",
]


def good() -> bytes:
    """A release with everything, of a maker whom this computer trusts."""
    trust = first_trust(keys=trusted("root a", "root b", "anna", "bert", "log"), log=role("log"))
    maker = Maker(chain_of(trust), ReleaseLog())
    TrustStore().install(maker.chain, replaces=True)
    return maker.release(notes=b"Notes.", sbom=b"{}")


def mutated(whole: bytes, seed: int) -> bytes:
    """The release with a few changes, of its bytes or inside of its documents."""
    chance = random.Random(seed)
    if chance.random() < 0.5:
        return _bytes(whole, chance)
    members = unpack(whole, "x")
    if chance.random() < 0.3:
        members[STATEMENT] = _signed_statement(whole, chance)
        return pack(members)
    name = chance.choice(sorted(members))
    if name.endswith(".json") and chance.random() < 0.8:
        document = json.loads(members[name])
        for _ in range(chance.randint(1, 3)):
            _document(document, chance)
        members[name] = json_bytes(document)
    else:
        members[name] = _bytes(members[name], chance)
    if chance.random() < 0.2:
        members.pop(chance.choice(sorted(members)))
    return pack(members)


def _signed_statement(whole: bytes, chance: random.Random) -> bytes:
    """A damaged statement with a right signature."""
    envelope = opened(whole).envelope
    statement = json.loads(envelope.payload)
    for _ in range(chance.randint(1, 3)):
        _document(statement, chance)
    damaged = replace(envelope, payload=json_bytes(statement), signatures={})
    return json_bytes(damaged.sign([key("anna")]).document())


def _bytes(raw: bytes, chance: random.Random) -> bytes:
    changed = bytearray(raw)
    for _ in range(chance.randint(1, 8)):
        at = chance.randrange(len(changed) + 1)
        # The end of a zip has its directory: most of what can go wrong is there.
        at = max(0, len(changed) - chance.randrange(600)) if chance.random() < 0.5 else at
        match chance.randrange(4):
            case 0:
                changed[at : at + 1] = chance.randbytes(1)
            case 1:
                changed[at:at] = chance.randbytes(chance.randint(1, 40))
            case 2:
                del changed[at : at + chance.randint(1, 400)]
            case _:
                changed[at : at + 4] = chance.choice((b"\0\0\0\0", b"\xff\xff\xff\xff"))
    return bytes(changed)


def _document(document: Any, chance: random.Random) -> None:
    places = list(_places(document))
    if not places:
        return
    inside, place = chance.choice(places)
    match chance.randrange(3):
        case 0:
            inside[place] = chance.choice(_ODD)
        case 1:
            del inside[place]
        case _:
            inside[place] = [inside[place], inside[place]]


def _places(document: Any) -> Iterator[tuple[Any, Any]]:
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for place, value in list(items):
        yield document, place
        if isinstance(value, dict | list):
            yield from _places(value)


def verdict(raw: bytes, path: Path) -> str:
    """The code by which a release is refused, or "taken" with the bytes that were signed.

    Raises any other error than our own, and AssertionError for other bytes.
    """
    path.write_bytes(raw)
    try:
        job = jobs.prepare(path, load_profile(os.devnull, BMS)).checked()
    except FlasherError as error:
        return error.code
    assert job.plan.image.data == load(IMAGE).data
    return "taken"
