"""Forgeries and mistakes, each refused with its code before a bus is opened; and honest releases
that only look odd.
"""

from __future__ import annotations

import base64
import io
import json
import os
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from flasher import jobs
from flasher.errors import ErrorCode, FlasherError
from flasher.protocol.spec import BMS, OBC, WMC
from flasher.release import container
from flasher.release.build import with_signatures
from flasher.release.container import LOG, NOTES, STATEMENT, TRUST, pack, unpack
from flasher.release.envelope import Envelope, json_bytes
from flasher.release.places import CHAIN_FILE, TRUST_FILE
from flasher.release.store import TrustStore
from flasher.release.transparency import ReleaseLog
from flasher.release.trust import Chain, Role, TrustedKey, new_chain
from flasher.settings.profile import load_profile
from tests.release.maker import (
    IMAGE,
    SAMPLES,
    Maker,
    chain_of,
    first_trust,
    key,
    opened,
    role,
    signed,
    trusted,
)

IMAGE_NAME = "images/bms.bin"


@dataclass
class Case:
    """A maker, whose trust file a computer has, and the folder of a USB stick."""

    maker: Maker
    folder: Path

    def installed(self) -> Case:
        TrustStore().install(self.maker.chain)
        return self

    def with_log(self) -> Case:
        """The trust file asks for a log, and the computer has seen one release in it."""
        trust = first_trust(
            keys=trusted("root a", "root b", "anna", "bert", "log"), log=role("log")
        )
        self.maker = Maker(chain_of(trust), ReleaseLog())
        TrustStore().install(self.maker.chain, replaces=True)
        assert self.code(self.maker.release(counter=1)) is None
        return self

    def code(self, raw: bytes, name: str = "bike.wfw") -> ErrorCode | None:
        """The code by which an upgrade with this file is refused; None if it would begin."""
        path = self.folder / name
        path.write_bytes(raw)
        return self.code_of(path)

    def code_of(self, path: Path) -> ErrorCode | None:
        try:
            jobs.prepare(path, load_profile(os.devnull, BMS)).checked()
        except FlasherError as error:
            refused = error
        else:
            return None
        assert refused.remedy, refused
        return refused.code


@pytest.fixture
def case(tmp_path: Path) -> Case:
    folder = tmp_path / "stick"
    folder.mkdir()
    return Case(Maker(), folder).installed()


def changed(raw: bytes, **members: bytes | None) -> bytes:
    """The container with other members, packed as flasher packs it; None leaves one out."""
    by_name = {"statement": STATEMENT, "trust": TRUST, "log": LOG, "image": IMAGE_NAME}
    found: dict[str, bytes | None] = {**unpack(raw, "x")}
    found |= {by_name.get(name, name): value for name, value in members.items()}
    return pack({name: value for name, value in found.items() if value is not None})


def with_statement(raw: bytes, change: Callable[[Any], None], signers: tuple[str, ...]) -> bytes:
    """The release with a changed statement; without `signers` with the signatures it had."""
    envelope = opened(raw).envelope
    statement = json.loads(envelope.payload)
    change(statement)
    forged = replace(envelope, payload=json_bytes(statement))
    if signers:
        forged = replace(forged, signatures={}).sign([key(name) for name in signers])
    return changed(raw, statement=json_bytes(forged.document()) + b"\n")


def zipped(raw: bytes, **writing: Any) -> bytes:
    """The members of a release as another program packs them."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", **writing) as archive:
        for name, content in unpack(raw, "x").items():
            archive.writestr(name, content)
    return packed.getvalue()


# -- the container --------------------------------------------------------------------------------


def with_entry(raw: bytes, name: str, content: bytes = b"x", **entry: Any) -> bytes:
    """The container with one more entry."""
    packed = io.BytesIO(raw)
    with warnings.catch_warnings(), zipfile.ZipFile(packed, "a") as archive:
        warnings.simplefilter("ignore")  # of a name that is there
        info = zipfile.ZipInfo(name)
        for key_, value in entry.items():
            setattr(info, key_, value)
        archive.writestr(info, content)
    return packed.getvalue()


CONTAINERS: dict[str, Callable[[bytes], bytes]] = {
    "a zip bomb": lambda raw: with_entry(
        raw, NOTES, bytes(1 << 24), compress_type=zipfile.ZIP_DEFLATED
    ),
    "a path out of the folder": lambda raw: with_entry(raw, "../../.bashrc"),
    "a path out of the folder of images": lambda raw: with_entry(raw, "images/../../x"),
    "an absolute path": lambda raw: with_entry(raw, "/etc/passwd"),
    "a path of Windows": lambda raw: with_entry(raw, "images\\..\\x"),
    "two files of one name": lambda raw: with_entry(raw, IMAGE_NAME, IMAGE.read_bytes()),
    "an unknown file": lambda raw: with_entry(raw, "setup.exe"),
    "a link": lambda raw: with_entry(
        raw, "images/link", b"/etc/passwd", external_attr=0o120777 << 16
    ),
    "unsigned notes": lambda raw: changed(raw, **{NOTES: b"use --force"}),
    "an unsigned image": lambda raw: changed(raw, **{"images/other.hex": b":00"}),
    "too many files": lambda raw: changed(
        raw, **{f"images/{number}.hex": b"" for number in range(20)}
    ),
    "compressed by another program": lambda raw: zipped(raw, compression=zipfile.ZIP_DEFLATED),
    "packed by another program": zipped,
    "bytes after its end": lambda raw: raw + b"hidden",
    "bytes between its files": lambda raw: raw[:30] + b"\0" + raw[30:],
    "cut off": lambda raw: raw[:-100],
    "no statement": lambda raw: changed(raw, statement=None),
    "no image": lambda raw: changed(raw, image=None),
    "a statement that is no JSON": lambda raw: changed(raw, statement=b"{"),
    "a statement with an unknown key": lambda raw: with_statement(
        raw, lambda each: each.update(more=1), ("anna",)
    ),
    "a statement of another kind": lambda raw: with_statement(
        raw, lambda each: each.update(predicateType="https://slsa.dev/provenance/v1"), ("anna",)
    ),
    "an envelope of another kind": lambda raw: changed(
        raw,
        statement=json_bytes(
            replace(opened(raw).envelope, payload_type="text/plain").sign([key("anna")]).document()
        ),
    ),
    "no counter": lambda raw: with_statement(
        raw, lambda each: each["predicate"]["images"][0]["manifest"].pop("counter"), ("anna",)
    ),
    "two images for one target": lambda raw: with_statement(
        raw,
        lambda each: each["predicate"]["images"].append(each["predicate"]["images"][0]),
        ("anna",),
    ),
    "another target than its subjects": lambda raw: with_statement(
        raw, lambda each: each["predicate"]["images"][0]["manifest"].update(target="obc"), ("anna",)
    ),
    "two subjects of one name": lambda raw: with_statement(
        raw, lambda each: each["subject"].append(each["subject"][0]), ("anna",)
    ),
    "a day that is none": lambda raw: with_statement(
        raw, lambda each: each["predicate"].update(released="2026-02-30"), ("anna",)
    ),
    "two signatures of one key": lambda raw: changed(raw, statement=twice(raw)),
}  # fmt: skip


def twice(raw: bytes) -> bytes:
    document: Any = opened(raw).envelope.document()
    document["signatures"] *= 2
    return json_bytes(document)


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_container_of_another_form_is_refused_as_damaged(case: Case, name: str) -> None:
    assert case.code(CONTAINERS[name](case.maker.release())) is ErrorCode.RELEASE_DAMAGED


def test_a_compressed_file_is_refused_without_reading_it(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = CONTAINERS["a zip bomb"](case.maker.release())
    assert len(bomb) < 1 << 20
    sizes = []
    whole = zipfile.ZipFile.read

    def read(archive: zipfile.ZipFile, entry: Any, *more: Any) -> bytes:
        content = whole(archive, entry, *more)
        sizes.append(len(content))
        return content

    monkeypatch.setattr(zipfile.ZipFile, "read", read)
    assert case.code(bomb) is ErrorCode.RELEASE_DAMAGED
    assert max(sizes) < 1 << 20


# -- bytes and targets ----------------------------------------------------------------------------


def test_other_bytes_than_were_signed_are_refused(case: Case) -> None:
    image = IMAGE.read_bytes()
    assert (
        case.code(changed(case.maker.release(), image=image + b"\n")) is ErrorCode.RELEASE_DIFFERS
    )
    other = (SAMPLES / "obc.bin").read_bytes()
    assert case.code(changed(case.maker.release(), image=other)) is ErrorCode.RELEASE_DIFFERS


def test_a_release_for_another_target_is_refused(case: Case) -> None:
    maker = Maker(chain_of(first_trust(release={"obc": role("anna")})))
    TrustStore().install(maker.chain, replaces=True)
    raw = maker.release(images={OBC: SAMPLES / "obc.bin"})
    assert case.code(raw) is ErrorCode.NOT_FOR_DEVICE


def test_a_detached_release_is_of_the_image_that_it_lies_beside(case: Case) -> None:
    image = case.folder / "bms.bin"
    image.write_bytes(IMAGE.read_bytes())
    (case.folder / "bms.bin.wfw").write_bytes(case.maker.release(is_detached=True))
    assert case.code_of(image) is None
    assert case.code_of(case.folder / "bms.bin.wfw") is ErrorCode.RELEASE_DAMAGED
    image.write_bytes((SAMPLES / "obc.bin").read_bytes())
    assert case.code_of(image) is ErrorCode.RELEASE_DIFFERS


# -- signatures -----------------------------------------------------------------------------------


def forged_counter(raw: bytes) -> bytes:
    return with_statement(
        raw, lambda each: each["predicate"]["images"][0]["manifest"].update(counter=99), ()
    )


def forged_rule(raw: bytes) -> bytes:
    return with_statement(
        raw,
        lambda each: each["predicate"]["images"][0]["manifest"].update(hardware_versions=["*"]),
        (),
    )


def of_another_release(raw: bytes) -> bytes:
    other = opened(Maker().release(counter=2)).envelope
    return with_signatures(opened(raw), replace(opened(raw).envelope, signatures=other.signatures))


def under_another_id(raw: bytes) -> bytes:
    envelope = opened(signed(raw, ("a thief",))).envelope
    stolen = {key("anna").public.id: envelope.signatures[key("a thief").public.id]}
    return with_signatures(opened(raw), replace(envelope, signatures=stolen))


def of_the_bare_payload(raw: bytes) -> bytes:
    envelope = opened(raw).envelope
    bare = {key("anna").public.id: key("anna").sign(envelope.payload)}
    return with_signatures(opened(raw), replace(envelope, signatures=bare))


def unsigned(raw: bytes) -> bytes:
    return with_signatures(opened(raw), replace(opened(raw).envelope, signatures={}))


@pytest.mark.parametrize(
    "forge",
    [
        forged_counter,
        forged_rule,
        of_another_release,
        under_another_id,
        of_the_bare_payload,
        unsigned,
        lambda raw: signed(unsigned(raw), ("a thief",)),
        lambda raw: signed(unsigned(raw), ("root a",)),
    ],
)
def test_a_release_without_a_right_signature_is_refused(
    case: Case, forge: Callable[[bytes], bytes]
) -> None:
    assert case.code(forge(case.maker.release())) is ErrorCode.RELEASE_UNSIGNED


def test_one_of_two_signatures_is_not_enough_and_one_key_does_not_count_twice(case: Case) -> None:
    maker = Maker(chain_of(first_trust(release={"bms": role("anna", "bert", threshold=2)})))
    TrustStore().install(maker.chain, replaces=True)
    one = maker.release(signers=("anna",))
    assert case.code(one) is ErrorCode.RELEASE_UNSIGNED
    envelope = opened(one).envelope
    own = envelope.signatures[key("anna").public.id]
    for other in (key("bert").public.id, key("anna").public.id.upper(), "another id"):
        twice_ = replace(envelope, signatures={**envelope.signatures, other: own})
        assert case.code(with_signatures(opened(one), twice_)) is ErrorCode.RELEASE_UNSIGNED
    assert case.code(signed(one, ("bert",))) is None


def test_who_may_sign_for_one_target_may_not_for_another(case: Case) -> None:
    maker = Maker(chain_of(first_trust(release={"bms": role("bert"), "wmc": role("anna")})))
    TrustStore().install(maker.chain, replaces=True)
    assert case.code(maker.release(signers=("anna",))) is ErrorCode.RELEASE_UNSIGNED
    nobody = Maker(chain_of(first_trust(release={"wmc": role("anna")})))
    TrustStore().install(nobody.chain, replaces=True)
    assert case.code(nobody.release(signers=("anna",))) is ErrorCode.RELEASE_UNSIGNED


def test_a_revoked_key_is_refused_also_by_a_release_that_brings_the_revocation(case: Case) -> None:
    old = case.maker.release()
    case.maker.next_version(keys=trusted("root a", "root b", "bert"), release={"bms": role("bert")})
    assert case.code(case.maker.release(counter=2)) is ErrorCode.RELEASE_UNSIGNED
    assert case.code(old) is ErrorCode.RELEASE_UNSIGNED
    assert case.code(case.maker.release(counter=2, signers=("bert",))) is None


# -- dates and counters ---------------------------------------------------------------------------


def test_a_release_of_a_day_after_the_trust_file_expired_is_refused(case: Case) -> None:
    assert case.code(case.maker.release(released="2028-01-01")) is None
    assert case.code(case.maker.release(released="2028-01-02")) is ErrorCode.RELEASE_EXPIRED


def test_a_withdrawn_release_is_refused(case: Case) -> None:
    case.maker.next_version(minimum_counters={"bms": {"48V": 5}})
    assert case.code(case.maker.release(counter=4)) is ErrorCode.RELEASE_OLD
    assert case.code(case.maker.release(counter=5)) is None


# -- the trust file -------------------------------------------------------------------------------


def test_an_older_trust_file_in_the_place_of_the_newer_is_noticed(case: Case) -> None:
    folder = TrustStore().path.parent
    before = {name: (folder / name).read_bytes() for name in (TRUST_FILE, CHAIN_FILE)}
    case.maker.next_version(keys=trusted("root a", "root b", "bert"), release={"bms": role("bert")})
    raw = Maker(chain_of(first_trust())).release()
    assert case.code(case.maker.release(signers=("bert",))) is None
    for name, content in before.items():
        (folder / name).write_bytes(content)
    assert case.code(raw) is ErrorCode.TRUST_ROLLED_BACK


@pytest.mark.parametrize("name", [TRUST_FILE, CHAIN_FILE])
def test_a_trust_file_that_is_missing_or_was_changed_is_not_used(case: Case, name: str) -> None:
    path = TrustStore().path.with_name(name)
    whole = path.read_bytes()
    raw = case.maker.release()
    for forged in (whole.replace(b"Works", b"Forge"), whole[:-9], b"", b"\xff"):
        if forged != whole:
            path.write_bytes(forged)
            assert case.code(raw) is ErrorCode.TRUST_FILE, forged[:80]
    path.unlink()
    assert case.code(raw) is ErrorCode.TRUST_FILE
    image = case.folder / "plain.bin"
    image.write_bytes(IMAGE.read_bytes())
    assert case.code_of(image) is ErrorCode.TRUST_FILE


def thieves_version(maker: Maker, *signers: str) -> bytes:
    """A release with a trust file in which a thief gives himself the role."""
    thief = replace(
        maker,
        chain=maker.chain.extended(
            replace(
                maker.chain.newest,
                version=2,
                keys=trusted("root a", "root b", "a thief"),
                release={"bms": role("a thief")},
            )
        ).signed([key(name) for name in signers]),
    )
    return thief.release(signers=("a thief",))


@pytest.mark.parametrize("signers", [(), ("a thief",), ("root a",), ("anna", "bert")])
def test_a_new_trust_file_needs_enough_signatures_of_the_roots_before(
    case: Case, signers: tuple[str, ...]
) -> None:
    assert case.code(thieves_version(case.maker, *signers)) is ErrorCode.TRUST_FILE
    assert case.code(case.maker.release()) is None


def test_new_roots_cannot_appoint_themselves(case: Case) -> None:
    new = replace(
        case.maker.chain.newest,
        version=2,
        keys=trusted("thief a", "thief b"),
        root=role("thief a", "thief b", threshold=2),
        release={"bms": role("thief a")},
    )
    chain = case.maker.chain.extended(new).signed([key("thief a"), key("thief b")])
    assert case.code(Maker(chain).release(signers=("thief a",))) is ErrorCode.TRUST_FILE


def test_a_fork_of_the_trust_file_is_refused(case: Case) -> None:
    fork = Maker(case.maker.chain)
    case.maker.next_version(name="Works, the real ones")
    fork.next_version(name="Works, shown to some")
    assert case.code(case.maker.release()) is None
    assert case.code(fork.release()) is ErrorCode.TRUST_FILE


def test_another_makers_release_is_refused(case: Case) -> None:
    other = Maker(chain_of(first_trust(name="Others")))
    assert case.code(other.release()) is ErrorCode.TRUST_FILE


def test_a_chain_that_leaves_a_version_out_is_refused(case: Case) -> None:
    case.maker.next_version()
    case.maker.next_version()
    one, _, three = json.loads(case.maker.chain.to_bytes())["versions"]
    raw = changed(case.maker.release(), trust=json_bytes({"format": 1, "versions": [one, three]}))
    assert case.code(raw) is ErrorCode.RELEASE_DAMAGED


def two_ids() -> Chain:
    """A trust file in which Anna's key has two ids, and both count."""
    own = TrustedKey(public=key("anna").public.base64)
    trust = first_trust(
        keys={**trusted("root a", "root b", "anna"), "feedfeedfeedfeed": own},
        release={"bms": Role(keys=(key("anna").public.id, "feedfeedfeedfeed"), threshold=2)},
    )
    return new_chain(trust, "trust.json").signed([key("root a"), key("root b")])


def test_a_trust_file_with_one_key_under_two_ids_is_refused_when_it_is_read(case: Case) -> None:
    envelope = two_ids().envelopes[0]
    trust = changed(case.maker.release(), trust=two_ids().to_bytes())
    assert case.code(trust) is ErrorCode.RELEASE_DAMAGED
    folder = TrustStore().path.parent
    (folder / TRUST_FILE).write_bytes(envelope.payload)
    (folder / CHAIN_FILE).write_bytes(two_ids().to_bytes())
    assert case.code(case.maker.release()) is ErrorCode.TRUST_FILE


def test_a_point_in_its_short_form_is_no_second_key() -> None:
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415

    from flasher.release.keys import PublicKey  # noqa: PLC0415

    der = key("anna", p256=True).public.der
    point: Any = serialization.load_der_public_key(der)
    short = point.public_bytes(
        serialization.Encoding.X962, serialization.PublicFormat.CompressedPoint
    )
    # SubjectPublicKeyInfo of the same point, compressed.
    forged = bytes.fromhex("3039301306072a8648ce3d020106082a8648ce3d030107032200") + short
    with pytest.raises(ValueError, match="usual form"):
        PublicKey.from_base64(base64.b64encode(forged).decode())


# -- the log --------------------------------------------------------------------------------------


def test_a_release_has_to_be_in_the_log(case: Case) -> None:
    case.with_log()
    log = case.maker.log
    assert log is not None
    unlisted = replace(case.maker, log=None).release(counter=2)
    assert case.code(unlisted) is ErrorCode.RELEASE_LOG
    assert case.code(changed(unlisted, log=log.to_bytes())) is ErrorCode.RELEASE_LOG


def test_a_log_with_another_key_or_another_history_is_refused(case: Case) -> None:
    case.with_log()
    forged = replace(case.maker, log_signers=("a thief",)).release(counter=2)
    assert case.code(forged) is ErrorCode.RELEASE_LOG
    fork = replace(case.maker, log=ReleaseLog()).release(counter=3)
    assert case.code(fork) is ErrorCode.RELEASE_LOG
    assert case.code(case.maker.release(counter=4)) is None


def test_a_checkpoint_of_other_entries_is_refused(case: Case) -> None:
    case.with_log()
    raw = case.maker.release(counter=2)
    log = opened(raw).log
    assert log is not None
    shorter = replace(log, entries=log.entries[1:])
    assert case.code(changed(raw, log=shorter.to_bytes())) is ErrorCode.RELEASE_DAMAGED


# -- honest and odd -------------------------------------------------------------------------------


def test_a_name_alone_proves_nothing(case: Case) -> None:
    raw = case.maker.release()
    for name in ("bike", "bike.hex", "bike of Grün & Söhne (2).WFW", "bike.zip"):
        assert case.code(raw, name) is None


def test_a_link_and_a_file_that_is_read_only_are_taken(case: Case) -> None:
    path = case.folder / "bike.wfw"
    path.write_bytes(case.maker.release())
    path.chmod(0o444)
    link = case.folder / "link.wfw"
    link.symlink_to(path)
    assert case.code_of(link) is None


def test_more_signatures_than_asked_for_and_those_of_strangers_do_no_harm(case: Case) -> None:
    assert case.code(case.maker.release(signers=("anna", "bert"))) is None
    assert case.code(case.maker.release(signers=("a customer", "anna", "an inspector"))) is None


def test_keys_of_both_kinds_sign_together(case: Case) -> None:
    p256 = key("anna", p256=True)
    trust = first_trust(
        keys={
            **trusted("root a", "root b", "bert"),
            p256.public.id: TrustedKey(public=p256.public.base64),
        },
        release={"bms": Role(keys=(p256.public.id, key("bert").public.id), threshold=2)},
    )
    maker = Maker(chain_of(trust))
    TrustStore().install(maker.chain, replaces=True)
    raw = maker.release(signers=("bert",))
    package = opened(raw)
    assert case.code(raw) is ErrorCode.RELEASE_UNSIGNED
    assert case.code(with_signatures(package, package.envelope.sign([p256]))) is None


def test_a_stick_with_an_older_trust_file_is_taken_if_its_key_still_counts(case: Case) -> None:
    old = case.maker.release()
    case.maker.next_version(release={"bms": role("anna", "bert")}, name="Works GmbH")
    TrustStore().install(case.maker.chain)
    assert case.code(old) is None
    known = TrustStore().load()
    assert known is not None
    assert known.trust.version == 2


def test_a_release_needs_no_trust_file_and_no_log_inside(case: Case) -> None:
    assert case.code(case.maker.release(has_trust=False)) is None


def test_a_log_that_no_one_asks_for_does_no_harm_and_is_not_remembered(case: Case) -> None:
    for _ in range(2):
        maker = replace(case.maker, log=ReleaseLog(), log_signers=("a stranger",))
        assert case.code(maker.release()) is None
    known = TrustStore().load()
    assert known is not None
    assert known.seen.log == ()


def test_an_image_of_a_set_is_chosen_by_the_target(case: Case) -> None:
    everybody = {name: role("anna") for name in ("bms", "wmc", "obc")}
    maker = Maker(chain_of(first_trust(release=everybody)))
    TrustStore().install(maker.chain, replaces=True)
    raw = maker.release(
        images={BMS: IMAGE, WMC: SAMPLES / "wmc.hex", OBC: SAMPLES / "obc.bin"},
        notes=b"For all.",
        sbom=b"{}",
    )
    assert case.code(raw) is None
    path = case.folder / "bike.wfw"
    for target in (BMS, WMC, OBC):
        job = jobs.prepare(path, load_profile(os.devnull, target)).checked()
        assert job.plan.image.named_targets in (frozenset(), frozenset({target}))


def test_the_system_has_a_trust_file_and_the_user_a_newer_one(case: Case, tmp_path: Path) -> None:
    user = TrustStore().path.parent
    system = tmp_path / "system" / "flasher"
    user.rename(system)
    assert case.code(case.maker.release()) is None
    case.maker.next_version()
    assert case.code(case.maker.release()) is None
    assert (user / TRUST_FILE).exists()
    assert case.code(case.maker.release()) is None
    forged = chain_of(first_trust(name="The user's own"))
    TrustStore([user]).install(forged, replaces=True)
    assert case.code(case.maker.release()) is ErrorCode.TRUST_FILE


def test_the_same_release_is_taken_again_and_again(case: Case) -> None:
    raw = case.maker.release()
    assert [case.code(raw) for _ in range(3)] == [None, None, None]


def test_a_computer_that_cannot_store_what_it_saw_is_warned(case: Case, tmp_path: Path) -> None:
    raw = case.maker.release()
    data = tmp_path / "data" / "flasher" / "trust"
    for path in data.glob("*"):
        path.unlink()
    data.rmdir()
    data.write_text("in the way")
    path = case.folder / "bike.wfw"
    path.write_bytes(raw)
    job = jobs.prepare(path, load_profile(os.devnull, BMS))
    provenance = job.checked().identity.provenance
    assert provenance is not None
    assert provenance.problem is None
    assert "will not be noticed" in provenance.warnings[0]


def test_the_envelope_is_that_of_the_library() -> None:
    dsse: Any = pytest.importorskip("securesystemslib.dsse")
    envelope = Envelope(b"payload", "text/plain").sign([key("anna")])
    theirs = dsse.Envelope.from_dict(json.loads(json_bytes(envelope.document())))
    assert theirs.pae() == envelope.signed_bytes
    assert {each.signature for each in theirs.signatures.values()} == {
        envelope.signatures[key("anna").public.id].hex()
    }


def test_a_container_is_the_same_for_the_same_members() -> None:
    members = {"release.json": b"{}", "images/b.hex": b"b", "images/a.hex": b"a"}
    assert pack(members) == pack(dict(reversed(members.items())))
    assert unpack(pack(members), "x") == members
    assert container.is_member_name("images/a.hex")
