"""The file of receivers: systems of the plant to which runs are handed over."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Final, Literal
from urllib.parse import SplitResult, unquote, urlsplit

from pydantic import Field, StringConstraints, field_validator, model_validator

from flasher.errors import UsageError
from flasher.files import check_secret, read
from flasher.protocol.text import printable
from flasher.settings.toml_reader import Reader, TomlTable

RECEIVERS_MAX: Final = 32
_SCHEMES: Final = {"http": 80, "https": 443, "mqtt": 1883, "mqtts": 8883}
"""Schemes with their ports."""
_SECURE: Final = ("https", "mqtts")
_PASSWORD_MAX_SIZE: Final = 4096
_TOPIC_MAX_BYTES: Final = 65_535
"""MQTT 5, 1.5.4."""
Name = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]


class Receiver(TomlTable):
    """A system of the plant."""

    name: Name
    """Name in the database, of lower-case letters, digits, - and _; it stays with the receiver."""
    url: str
    """http:// or https:// address to which runs are posted; or mqtt:// or mqtts://HOST[:PORT]/TOPIC
    to which they are published."""
    user: str = ""
    """User name."""
    password_file: str = ""
    """File with the password, which not every user of the computer may read."""
    ca_file: str = ""
    """File with the certificates (PEM) that vouch for the server; empty: those of the computer."""
    time_limit_s: float = Field(default=10.0, gt=0, le=60)
    """Time limit of an attempt, from connecting to the whole answer."""
    retry_max_s: int = Field(default=600, ge=1, le=86_400)
    """Longest pause between two attempts; the first is 2 s, and each one is twice the last."""
    at_once: int = Field(default=4, ge=1, le=64)
    """Runs of different units that are sent at the same time."""

    @field_validator("url")
    @classmethod
    def _check_url(cls, value: str) -> str:
        try:
            parts = urlsplit(value)
            host = (parts.hostname or "").encode("idna")  # UnicodeError is a ValueError
            has_host = bool(host) and b" " not in host and parts.port != 0
        except ValueError:
            has_host = False
        if not has_host or parts.scheme not in _SCHEMES or not value.isprintable():
            raise ValueError("give http://, https://, mqtt:// or mqtts:// with a host")
        if "@" in parts.netloc:
            raise ValueError("user and password do not belong in it: use user and password_file")
        if parts.fragment:
            raise ValueError("it has a fragment (#)")
        if parts.scheme.startswith("mqtt"):
            topic = unquote(parts.path.removeprefix("/"))
            if not topic or set(topic) & {"+", "#", "\0"} or topic.startswith("$") or parts.query:
                raise ValueError("after the host it has a topic without +, # and $")
            if len(topic.encode()) > _TOPIC_MAX_BYTES:
                raise ValueError(f"its topic has more than {_TOPIC_MAX_BYTES:,} bytes")
        return value

    @model_validator(mode="after")
    def _check_pairs(self) -> Receiver:
        if self.password_file and not self.user:
            raise ValueError("password_file needs user")
        if self.ca_file and self.address.scheme not in _SECURE:
            raise ValueError("ca_file needs https or mqtts")
        return self

    @cached_property
    def address(self) -> SplitResult:
        return urlsplit(self.url)

    @property
    def kind(self) -> Literal["http", "mqtt"]:
        return "mqtt" if self.address.scheme.startswith("mqtt") else "http"

    @property
    def is_secure(self) -> bool:
        """True with TLS."""
        return self.address.scheme in _SECURE

    @property
    def host(self) -> str:
        return str(self.address.hostname)

    @property
    def port(self) -> int:
        return self.address.port or _SCHEMES[self.address.scheme]

    @property
    def topic(self) -> str:
        """Topic of MQTT."""
        return unquote(self.address.path.removeprefix("/"))


class ReceiverFile(TomlTable):
    """The file of receivers. Relative paths start at its folder."""

    receiver: tuple[Receiver, ...] = Field(min_length=1, max_length=RECEIVERS_MAX)

    @field_validator("receiver", mode="before")
    @classmethod
    def _list(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _check_names(self) -> ReceiverFile:
        names = [each.name for each in self.receiver]
        if len(set(names)) < len(names):
            raise ValueError("two receivers have the same name")
        return self


RECEIVERS: Final = Reader(ReceiverFile, "file of receivers")


def load_receivers(path: Path) -> tuple[Receiver, ...]:
    """Read the file, with absolute paths in it. Raises UsageError."""
    folder = path.absolute().parent
    return tuple(
        each.model_copy(
            update={
                name: str(folder / getattr(each, name))
                for name in ("password_file", "ca_file")
                if getattr(each, name)
            }
        )
        for each in RECEIVERS.load(path).receiver
    )


def password_of(receiver: Receiver) -> str | None:
    """Read the password; None without one. Raises UsageError."""
    if not receiver.password_file:
        return None
    check_secret(receiver.password_file, f"the password of {receiver.name}")
    raw = read(receiver.password_file, _PASSWORD_MAX_SIZE, what="file with the password")
    try:
        password = raw.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError:
        password = ""
    if not password or not password.isprintable():
        raise UsageError(
            f"The file with the password of {receiver.name} is not one line of text.",
            where=printable(receiver.password_file),
            remedy="Write the password alone into it.",
        )
    return password
