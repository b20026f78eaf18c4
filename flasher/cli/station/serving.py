"""Who may see the pages: what the options say, made into a server."""

from __future__ import annotations

import hmac
import os
import secrets
import socket
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

from starlette.routing import BaseRoute

from flasher.cli.station.commands import Address, PagesOptions
from flasher.errors import ErrorCode, UsageError
from flasher.files import read
from flasher.station.people import Person, role_of
from flasher.station.records.keys import Keeping
from flasher.web.guard import Badges, application
from flasher.web.pages import Pages
from flasher.web.server import LOOPBACK, Server, Tls

PASSWORD_MIN: Final = 8
_PASSWORD_FILE_MAX_SIZE: Final = 4096
"""In bytes."""
_ANY: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104  compared, not bound
_SECRET_MAX_SIZE: Final = 200


@contextmanager
def served(
    options: PagesOptions,
    address: Address,
    routes: Collection[BaseRoute],
    *,
    pages: Pages,
    keeping: Keeping | None,
    people: Sequence[Person] = (),
    is_supervised: Callable[[str], bool],
) -> Iterator[str]:
    """Serve pages while the block runs; gives their address. `keeping`: where the secret of the
    sessions is kept; None: they end with the server. `people`: those with a badge, of whom
    supervisors alone see the pages that `is_supervised` tells by their path; without people
    everybody sees them. Raises UsageError.
    """
    password, tls = _password(options), _tls(options)
    _check_open(options, address, has_password=bool(password or people), has_tls=tls is not None)
    badges = None
    if people:
        is_far = address.host not in LOOPBACK
        badges = Badges(
            # A badge alone is no more than paper: it does not stand for a password.
            partial(role_of, people, needs_pin=is_far or bool(password)),
            is_supervised,
            are_for_all=is_far and not password,
        )
    secret = secrets.token_urlsafe(32) if keeping is None else kept_secret(keeping)
    # Who signed in goes on after a restart, unless the password or a badge is another one now.
    known = repr((password, [(each.code, each.role.value, each.pin) for each in people]))
    app = application(
        routes,
        pages=pages,
        hosts=_hosts(address),
        secret=secret,
        signed=hmac.digest(secret.encode(), known.encode(), "sha256").hex(),
        now=time.monotonic,
        password=password,
        badges=badges,
        is_tls=tls is not None,
    )
    with Server(app, address.host, address.port, tls) as server:
        yield server.url


def _hosts(address: Address) -> set[str]:
    """Names by which a browser may call this server."""
    hosts = {address.host, *LOOPBACK, "[::1]"}
    if address.host not in LOOPBACK:
        hosts |= {socket.gethostname(), socket.getfqdn(), f"[{address.host}]"}
    if address.host in _ANY:
        hosts |= {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
    return hosts


def _check_open(
    options: PagesOptions, address: Address, *, has_password: bool, has_tls: bool
) -> None:
    """Raises UsageError for pages that other computers could reach without TLS or password."""
    if address.host in LOOPBACK:
        return
    if not (has_tls or options.web_insecure):
        raise UsageError(
            f"Other computers could reach the pages on {address.host}, and read along.",
            remedy="Give --web-certificate and --web-key; --web-insecure does without.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    if not has_password:
        raise UsageError(
            f"Other computers could reach the pages on {address.host}, without a password.",
            remedy="Give --web-password FILE, or a badge table (--badges).",
            code=ErrorCode.PAGES_NOT_SERVED,
        )


def _tls(options: PagesOptions) -> Tls | None:
    certificate, key = options.web_certificate, options.web_key
    if (certificate is None) != (key is None):
        raise UsageError(
            "--web-certificate and --web-key belong together.",
            remedy="Give both.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    return None if certificate is None or key is None else Tls(certificate, key)


def _password(options: PagesOptions) -> str:
    path = options.web_password
    if path is None:
        return ""
    data = read(path, _PASSWORD_FILE_MAX_SIZE, what="file of the password")
    text = data.decode("utf-8", "replace").partition("\n")[0].strip()
    if len(text) < PASSWORD_MIN:
        raise UsageError(
            f"The password of the pages has less than {PASSWORD_MIN} characters.",
            where="--web-password",
            remedy="Write a longer one into the first line of the file.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    return text


def kept_secret(keeping: Keeping) -> str:
    """What signs the sessions of the pages, for this user alone; made where there is none."""
    path: Path = keeping.keys_folder / "pages.secret"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(handle, "w", encoding="ascii") as file:
                file.write(secrets.token_urlsafe(32))
        except OSError:
            path.unlink()  # an empty one would be found at every start from now on
            raise
    except FileExistsError:
        pass
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror or error}.",
            remedy="Give another place with --keys.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        ) from error
    found = read(path, _SECRET_MAX_SIZE, what="secret of the pages").decode("ascii", "replace")
    return found or secrets.token_urlsafe(32)
