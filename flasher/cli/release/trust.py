"""`flasher trust`: choose the keys that may sign releases, and whose releases are flashed here."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import click

from flasher.cli import values
from flasher.cli.documents import document_of
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import Decorator, argument, group, option, option_set
from flasher.cli.output import Output, counted
from flasher.cli.release.signing import (
    Passphrases,
    coming_date,
    key_option,
    open_keys,
    passphrase_options,
    today,
)
from flasher.cli.terminal import agrees, check_can_ask
from flasher.errors import ErrorCode, ExitCode, UsageError, did_you_mean
from flasher.files import read
from flasher.protocol.spec import TARGETS
from flasher.protocol.text import printable
from flasher.release import verify
from flasher.release.keys import (
    TOKEN,
    PublicKey,
    Scheme,
    generate,
    read_public_key,
    token_public_key,
)
from flasher.release.places import is_container
from flasher.release.store import TrustStore
from flasher.release.trust import (
    CHAIN_MAX_SIZE,
    ROLES,
    VALID_DAYS,
    Chain,
    Role,
    Trust,
    TrustedKey,
    new_chain,
    parse_chain,
    parse_trust,
)


@dataclass(frozen=True)
class KeyDocument:
    """Key pair that was made, or public key of a token."""

    key_id: str
    private_key: str | None
    """File of the private key; null for one in a token."""
    public_key: str


@dataclass(frozen=True)
class RoleDocument:
    """Role with its keys."""

    role: str
    threshold: int
    keys: list[str]


@dataclass(frozen=True)
class TrustDocument:
    """Newest version of a trust file."""

    file: str
    name: str
    version: int
    issued: str
    expires: str
    holders: dict[str, str]
    """Holder of each key, by its id."""
    roles: list[RoleDocument]
    minimum_counters: dict[str, dict[str, int]]
    missing: list[str]
    """Signatures that the newest version still lacks."""
    warnings: list[str]


@dataclass(frozen=True)
class NoTrustDocument:
    """This computer has no trust file."""

    installed: bool


DOCUMENTS: Final = (KeyDocument, TrustDocument, NoTrustDocument)

_EXAMPLES: Final = """\
examples:
  flasher trust key anna.key                            a key pair: anna.key and anna.key.pub
  flasher trust init trust.json --name 'Your works' --grant root=boss.key.pub \\
      --grant bms=anna.key.pub --key boss.key
  flasher trust install trust.json                      from now on only signed images are flashed
  flasher trust revoke trust.json KEY_ID --key boss.key
  flasher trust show

`trust.json` has all versions of a trust file with their signatures. Keep it with your sources; it
is no secret. Roles are root (signs the trust file), log (signs the log of releases), and the
targets.
"""
_EDIT_EXAMPLES: Final = """\
examples:
  flasher trust add trust.json --grant bms=bert.key.pub --key boss.key
  flasher trust add trust.json --grant root=second.key.pub --threshold root=2 --key boss.key
"""


@group(epilog=_EXAMPLES)
def trust() -> None:
    """Create and change trust files, and choose whose releases this computer takes."""


_file = argument("file", metavar="FILE", type=values.FilePath("json"), help="the trust file")
_expires = option(
    "--expires", type=coming_date, metavar="DATE", panel="trust file",
    help=f"last day for which releases may be stated (default: in {VALID_DAYS} days)",
)  # fmt: skip


def _role(name: str) -> str:
    if name in ROLES:
        return name
    if name in ("mc", "pbu"):
        return values.target(name).name
    hint = did_you_mean(name, ROLES)
    raise click.BadParameter(f"there is no role {name!a}. {hint}Roles are {', '.join(ROLES)}")


def _grant(text: str) -> tuple[str, str]:
    name, equals, path = text.partition("=")
    if not (equals and path):
        raise click.BadParameter(f"{text!a} is not ROLE=FILE")
    return _role(name), path


def _threshold(text: str) -> tuple[str, int]:
    name, equals, count = text.partition("=")
    if not equals:
        raise click.BadParameter(f"{text!a} is not ROLE=N")
    return _role(name), values.count(count)


@dataclass(frozen=True)
class _Grants:
    """Keys that are given to roles, and thresholds of roles."""

    grants: tuple[tuple[str, str], ...]
    thresholds: tuple[tuple[str, int], ...]

    def applied(self, trust: Trust) -> Trust:
        """Return the trust with these. Raises UsageError."""
        for name, path in self.grants:
            key = read_public_key(path)
            role = trust.role(name) or Role(keys=())
            keys = tuple(dict.fromkeys((*role.keys, key.id)))
            trust = replace(_with_key(trust, key, path)).with_role(name, replace(role, keys=keys))
        for name, threshold in self.thresholds:
            found = trust.role(name)
            if found is None:
                raise UsageError(
                    f"The role {name} has no keys.", remedy=f"Give it some: --grant {name}=FILE."
                )
            if threshold > len(found.keys):
                raise UsageError(
                    f"The role {name} would ask for {counted(threshold, 'signature')} and has "
                    f"{counted(len(found.keys), 'key')}.",
                    remedy=f"Give it more keys: --grant {name}=FILE, or a lower --threshold.",
                )
            trust = trust.with_role(name, replace(found, threshold=threshold))
        return trust


def _with_key(trust: Trust, key: PublicKey, path: str) -> Trust:
    holder = Path(path).name.removesuffix(".pub").removesuffix(".key")
    known = trust.keys.get(key.id)
    stated = known or TrustedKey(public=key.base64, holder=printable(holder))
    return replace(trust, keys={**trust.keys, key.id: stated})


def _grant_options(*, required: bool) -> Decorator:
    return option_set(
        "grants",
        _Grants,
        option(
            "--grant", "grants", type=_grant, multiple=True, required=required, brief=True,
            metavar="ROLE=FILE", panel="trust file",
            help=f"give a public key a role ({', '.join(ROLES)}); may be repeated",
        ),
        option(
            "--threshold", "thresholds", type=_threshold, multiple=True, metavar="ROLE=N",
            panel="trust file",
            help="number of different keys of the role that have to sign (default 1)",
        ),
    )  # fmt: skip


# -- keys -----------------------------------------------------------------------------------------


@trust.action(
    "key",
    epilog="""\
examples:
  flasher trust key anna.key
  flasher trust key anna.key --scheme p256 --passphrase-env PASSPHRASE
  flasher trust key release --token 'hsm:2?label=release'     writes release.pub
""",
)
@argument("file", metavar="FILE", type=values.FilePath("key"), help="the private key to write")
@option(
    "--scheme", type=click.Choice([each.value for each in Scheme]), default=Scheme.ED25519.value,
    panel="keys", help="kind of key",
)  # fmt: skip
@option(
    "--token", metavar="hsm:ID?label=LABEL", panel="keys",
    help="write the public key of this key in a token; PYKCS11LIB is its PKCS#11 library",
)  # fmt: skip
@passphrase_options
def key(
    output: Output, passphrases: Passphrases, *, file: str, scheme: str, token: str | None
) -> int:
    """Make a key pair: an encrypted private key, and the public key beside it, as FILE.pub."""
    private, public = Path(file), Path(f"{file}.pub")
    _check_absent(public)
    if token is not None:
        if not token.startswith(TOKEN):
            raise UsageError(
                f"{printable(token)} is no key in a token.", remedy="Write hsm:ID?label=LABEL."
            )
        made = token_public_key(token, passphrases.reader())
    else:
        _check_absent(private)
        encrypted, made = generate(Scheme(scheme), passphrases.new(file))
        write_whole(private, encrypted, "FILE", is_private=True)
        output.result(f"written: {printable(file)} (private: keep it, and a copy in another place)")
    write_whole(public, made.pem.encode("ascii"), "FILE")
    output.result(f"written: {printable(str(public))} (public)")
    output.result(f"key id:  {made.id}")
    return output.document(KeyDocument(made.id, None if token else file, str(public)))


def _check_absent(path: Path) -> None:
    """Raise UsageError for a file that exists: keys and trust files are not overwritten."""
    check_writable(path, "FILE")
    if path.exists():
        raise UsageError(
            f"{printable(str(path))} exists already.",
            remedy="Name another file: keys and trust files are never overwritten.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        )


# -- changes --------------------------------------------------------------------------------------


@trust.action(
    "init",
    epilog="""\
examples:
  flasher trust init trust.json --name 'Your works' --grant root=boss.key.pub \\
      --grant bms=anna.key.pub --key boss.key
  flasher trust init trust.json --name 'Your works' --grant root=a.pub --grant root=b.pub \\
      --threshold root=2 --grant bms=anna.pub --grant log=log.pub --key a.key --key b.key
""",
)
@_file
@option(
    "--name", required=True, metavar="NAME", panel="trust file", help="whose releases these are"
)
@_grant_options(required=True)
@_expires
@key_option("the root key that signs")
@passphrase_options
def init(
    output: Output,
    grants: _Grants,
    passphrases: Passphrases,
    *,
    file: str,
    name: str,
    expires: str | None,
    keys: tuple[str, ...],
) -> int:
    """Create a trust file, with its first version."""
    _check_absent(Path(file))
    first = Trust(
        name=printable(name),
        version=1,
        issued=today(),
        expires=expires or _in_two_years(),
        keys={},
        root=Role(keys=()),
    )
    made = grants.applied(first)
    if not made.root.keys:
        raise UsageError(
            "No key could sign the next version of this trust file.",
            remedy="Give a key the role root: --grant root=FILE.",
        )
    return _sign_and_write(output, new_chain(_checked(made, file), file), keys, passphrases)


@trust.action("add", epilog=_EDIT_EXAMPLES)
@_file
@_grant_options(required=False)
@_expires
@key_option("the root key that signs")
@passphrase_options
def add(
    output: Output,
    grants: _Grants,
    passphrases: Passphrases,
    *,
    file: str,
    expires: str | None,
    keys: tuple[str, ...],
) -> int:
    """Give keys roles, or roles other thresholds, in a new version of a trust file."""
    return _changed(output, file, grants.applied, expires, keys, passphrases)


@trust.action(
    "rotate",
    epilog="""\
examples:
  flasher trust rotate trust.json KEY_ID anna2.key.pub --key boss.key
""",
)
@_file
@argument("old", metavar="KEY_ID", help="id of the key to be replaced")
@argument("new", metavar="NEW", type=values.FilePath("pub"), help="the new public key")
@_expires
@key_option("the root key that signs")
@passphrase_options
def rotate(
    output: Output,
    passphrases: Passphrases,
    *,
    file: str,
    old: str,
    new: str,
    expires: str | None,
    keys: tuple[str, ...],
) -> int:
    """Replace a key by another one in all of its roles, in a new version of a trust file."""

    def change(trust: Trust) -> Trust:
        old_id = _key_id(trust, old)
        made = read_public_key(new)
        trust = _with_key(trust, made, new)
        for name in ROLES:
            role = trust.role(name)
            if role is not None and old_id in role.keys:
                ids = dict.fromkeys(made.id if each == old_id else each for each in role.keys)
                trust = trust.with_role(name, replace(role, keys=tuple(ids)))
        return _without_key(trust, old_id)

    return _changed(output, file, change, expires, keys, passphrases)


def _minimum(text: str) -> tuple[str, str, int]:
    place, equals, count = text.rpartition("=")
    target, colon, product = place.partition(":")
    if not (equals and colon and product):
        raise click.BadParameter(f"{text!a} is not TARGET:PRODUCT=N")
    return values.target(target).name, product, values.count(count)


@trust.action(
    "revoke",
    epilog="""\
examples:
  flasher trust revoke trust.json KEY_ID --key boss.key
  flasher trust revoke trust.json --minimum bms:48V=12 --key boss.key   withdraw releases below 12
""",
)
@_file
@argument(
    "key_ids", metavar="[KEY_ID]...", nargs=-1, required=False, help="ids of the keys to be revoked"
)
@option(
    "--minimum", "minimums", type=_minimum, multiple=True, metavar="TARGET:PRODUCT=N",
    panel="trust file", help="withdraw releases of a product with lower counters; may be repeated",
)  # fmt: skip
@_expires
@key_option("the root key that signs")
@passphrase_options
def revoke(
    output: Output,
    passphrases: Passphrases,
    *,
    file: str,
    key_ids: tuple[str, ...],
    minimums: tuple[tuple[str, str, int], ...],
    expires: str | None,
    keys: tuple[str, ...],
) -> int:
    """Take all roles from keys, or withdraw old releases, in a new version of a trust file."""
    if not (key_ids or minimums):
        raise UsageError("Nothing is to be revoked.", remedy="Name a KEY_ID, or --minimum.")

    def change(trust: Trust) -> Trust:
        for each in key_ids:
            trust = _without_key(trust, _key_id(trust, each))
        counters = {target: dict(each) for target, each in trust.minimum_counters.items()}
        for target, product, minimum in minimums:
            of_target = counters.setdefault(target, {})  # type: ignore[arg-type]
            of_target[product] = max(minimum, of_target.get(product, 0))
        return replace(trust, minimum_counters=counters)

    return _changed(output, file, change, expires, keys, passphrases)


def _key_id(trust: Trust, given: str) -> str:
    """Return the id of a key by its id, its beginning, or its holder. Raises UsageError."""
    found = [
        each
        for each, key in trust.keys.items()
        if given == key.holder or (len(given) >= 4 and each.startswith(given))
    ]
    if len(found) == 1:
        return found[0]
    known = ", ".join(map(trust.shown, trust.keys))
    count = "More than one key" if found else "No key"
    raise UsageError(
        f"{count} of the trust file is {printable(given)}.",
        where=f"it has {known}",
        remedy="Name the id of a key.",
    )


def _without_key(trust: Trust, key_id: str) -> Trust:
    """Return the trust without a key. Raises UsageError if a role lacks keys then."""
    for name in ROLES:
        role = trust.role(name)
        if role is None or key_id not in role.keys:
            continue
        left = tuple(each for each in role.keys if each != key_id)
        if len(left) < role.threshold:
            raise UsageError(
                f"Without {trust.shown(key_id)} the role {name} has {counted(len(left), 'key')}, "
                f"and asks for {counted(role.threshold, 'signature')}.",
                remedy="Give the role another key first (`flasher trust add`), or replace this "
                "one: `flasher trust rotate`.",
            )
        trust = trust.with_role(name, replace(role, keys=left))
    return replace(trust, keys={each: key for each, key in trust.keys.items() if each != key_id})


def _changed(
    output: Output,
    file: str,
    change: Callable[[Trust], Trust],
    expires: str | None,
    keys: tuple[str, ...],
    passphrases: Passphrases,
) -> int:
    """Add a version to a trust file."""
    check_writable(Path(file), "FILE", keys)
    chain = _read_chain(file).check()
    newest = chain.newest
    changed = change(newest)
    if changed == newest and expires is None:
        raise UsageError(
            f"That changes nothing in version {newest.version} of the trust file.",
            remedy="`flasher trust show FILE` shows it.",
        )
    made = replace(
        changed,
        version=newest.version + 1,
        issued=max(today(), newest.issued),
        expires=expires or max(_in_two_years(), newest.expires),
    )
    return _sign_and_write(output, chain.extended(_checked(made, file)), keys, passphrases)


def _checked(trust: Trust, file: str) -> Trust:
    """Check a version as it will be read. Raises UsageError."""
    return parse_trust(trust.to_toml(), file)


def _sign_and_write(
    output: Output, chain: Chain, keys: tuple[str, ...], passphrases: Passphrases
) -> int:
    opened = open_keys(keys, passphrases)
    *_, earlier = [chain.newest, *chain.versions[:-1]]
    useful = {*chain.newest.root.keys, *earlier.root.keys}
    for each in opened:
        if each.public.id not in useful:
            raise UsageError(
                f"The key {each.public.id} is no root key of this trust file.",
                remedy="Sign it with a key of the role root.",
                code=ErrorCode.SIGNING_KEY,
            )
    chain = chain.signed(opened)
    write_whole(Path(chain.source), chain.to_bytes(), "FILE")
    output.result(f"written: {printable(chain.source)}")
    return _show(output, chain)


@trust.action(
    "sign",
    epilog="""\
examples:
  flasher trust sign trust.json --key second.key
""",
)
@_file
@key_option("the root key that signs")
@passphrase_options
def sign(output: Output, passphrases: Passphrases, *, file: str, keys: tuple[str, ...]) -> int:
    """Add signatures to the newest version of a trust file, as the second of several people."""
    check_writable(Path(file), "FILE", keys)
    return _sign_and_write(output, _read_chain(file), keys, passphrases)


# -- this computer --------------------------------------------------------------------------------


@trust.action(
    "install",
    epilog="""\
examples:
  flasher trust install trust.json
  flasher trust install bike.wfw                 the trust file inside of a release
  flasher trust install own.json --replace       your own keys, or those of another maker
""",
)
@argument(
    "file", metavar="FILE", type=values.FilePath("json", "wfw"),
    help="a trust file, or a release with one",
)  # fmt: skip
@option(
    "--replace", "replaces", is_flag=True, panel="trust file",
    help="instead of the trust file that is here, which this one does not succeed",
)  # fmt: skip
@option("-y", "--yes", is_flag=True, panel="trust file", brief=True, help="do not ask")
def install(output: Output, *, file: str, replaces: bool, yes: bool) -> int:
    """Take over a trust file: from now on this computer flashes only what its keys have signed."""
    chain = _any_chain(file).check()
    store = TrustStore()
    if replaces or store.load() is None:
        output.progress(f"the keys of {printable(chain.newest.name)}:")
        for line in _role_lines(chain.newest):
            output.progress(f"  {line}")
        if not yes:
            check_can_ask(
                "Trusting these keys needs a confirmation",
                "Compare their ids with those that the maker gave you, then add --yes.",
            )
        if not yes and not agrees("Trust these keys?", interrupted="nothing was changed"):
            output.progress("nothing was changed")
            return output.document(NoTrustDocument(installed=False), exit_code=ExitCode.INTERRUPTED)
    known = store.install(chain, replaces=replaces)
    output.result(f"installed: {printable(str(store.path))}, version {known.trust.version}")
    return _show(output, known.chain)


@trust.action(
    "show",
    epilog="""\
examples:
  flasher trust show                 of this computer
  flasher trust show trust.json
  flasher trust show bike.wfw --json
""",
)
@argument(
    "file", metavar="[FILE]", type=values.FilePath("json", "wfw"), required=False,
    help="a trust file, or a release with one (default: that of this computer)",
)  # fmt: skip
def show(output: Output, *, file: str | None) -> int:
    """Show a trust file: that of this computer, or one that is named."""
    if file is not None:
        return _show(output, _any_chain(file))
    known = TrustStore().load()
    if known is None:
        output.result("no trust file on this computer: signatures are not checked")
        return output.document(NoTrustDocument(installed=False))
    warnings = verify.warnings_of(known, datetime.datetime.now(datetime.UTC).date())
    return _show(output, known.chain, warnings)


def _in_two_years() -> str:
    day = datetime.date.fromisoformat(today()) + datetime.timedelta(days=VALID_DAYS)
    return day.isoformat()


def _read_chain(file: str) -> Chain:
    return parse_chain(read(file, CHAIN_MAX_SIZE, what="trust file"), file)


def _any_chain(file: str) -> Chain:
    """Read a trust file, or the one inside of a release. Raises UsageError and ImageError."""
    if not is_container(file):
        return _read_chain(file)
    chain = verify.open_package(file).chain
    if chain is None:
        raise UsageError(
            f"The release {printable(file)} has no trust file inside.",
            remedy="Take the maker's trust file.",
        )
    return chain


def _show(output: Output, chain: Chain, warnings: list[str] | None = None) -> int:
    newest, missing = chain.newest, chain.missing()
    rows = [
        ("trust file:", f"{printable(newest.name)}, version {newest.version}"),
        ("issued:", f"{newest.issued}, for releases until {newest.expires}"),
    ]
    output.table(rows, indent=2)
    for line in _role_lines(newest):
        output.result(f"  {line}")
    for target, products in sorted(newest.minimum_counters.items()):
        for product, minimum in sorted(products.items()):
            node = TARGETS[target].node.name
            output.result(f"  withdrawn: {node} {json.dumps(product)} below counter {minimum}")
    for each in missing:
        output.error_line(f"unfinished: {each}: `flasher trust sign` adds signatures")
    for each in warnings or ():
        output.error_line(f"warning: {each}")
    return output.document(
        document_of(
            TrustDocument,
            newest,
            file=chain.source,
            holders={key_id: key.holder for key_id, key in newest.keys.items()},
            roles=[
                RoleDocument(name, role.threshold, list(role.keys))
                for name in ROLES
                if (role := newest.role(name)) is not None
            ],
            minimum_counters={
                target: dict(each) for target, each in newest.minimum_counters.items()
            },
            missing=list(map(str, missing)),
            warnings=list(map(str, warnings or ())),
        )
    )


def _role_lines(trust: Trust) -> list[str]:
    return [
        f"{name}: {role.threshold} of {', '.join(map(trust.shown, role.keys))}"
        for name in ROLES
        if (role := trust.role(name)) is not None
    ]
