"""Asks a system of the plant by HTTP whether a unit may be here.

    question = Question(config.question, recipe, station="line-2")
    answer = question.ask(order)      # blocks up to `time_limit_s`; never raises

The request states the unit, station, recipe and images. The reply is a JSON object such as
`{"answer": "no", "reason": "its test is missing"}`. Anything else (an error, a redirect, another
document, none in time) is no answer, and the rule of the station file for silence counts.
"""

from __future__ import annotations

import json
import socket
import ssl
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTP_PORT, HTTPS_PORT, HTTPConnection, HTTPException
from typing import Any, Final, Literal
from urllib.parse import urlencode, urlsplit

from pydantic import TypeAdapter

from flasher import __version__
from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.config import QuestionConfig
from flasher.station.recipe import Unchecked
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Answer, Order

REPLY_MAX_SIZE: Final = 64 * 1024
"""Bytes of a reply."""
_REASON_MAX: Final = 200
_HTTP_OK: Final = 200
_REDIRECTS: Final = range(300, 400)


@dataclass(frozen=True)
class _Reply:
    answer: Literal["yes", "no"]
    reason: str = ""


_REPLY: Final = TypeAdapter(_Reply)


class _NoAnswerError(Exception):
    """Why there is no answer."""


class Question:
    """The question of a station file. Raises UsageError if its certificates cannot be read."""

    def __init__(self, config: QuestionConfig, recipe: LoadedRecipe, station: str) -> None:
        self._config, self._recipe, self._station = config, recipe, station
        self.time_limit_s = config.time_limit_s
        self._address = urlsplit(config.url)
        self._tls = None if self._address.scheme == "http" else _tls(config.certificates)

    def ask(self, order: Order, recipe: LoadedRecipe | None = None) -> Answer:
        """Ask about the unit of an order; returns the answer, or the rule for none. `recipe`: that
        of its socket, if it is not the first one.
        """
        ends_at_s = time.perf_counter() + self.time_limit_s
        try:
            reply = self._reply(self._facts(order, recipe or self._recipe), ends_at_s)
        except (_NoAnswerError, OSError, HTTPException, ValueError) as error:
            late = isinstance(error, TimeoutError) or time.perf_counter() >= ends_at_s
            return self.silence("" if late else _words(error))
        reason = printable(reply.reason)[:_REASON_MAX].strip().rstrip(".")
        words = f"{reply.answer}: {reason}" if reason else reply.answer
        return Answer(reply.answer == "yes", words)

    def silence(self, why: str = "") -> Answer:
        """The rule for no answer. `why`: "" for none within the time limit."""
        why = why or f"none within {self.time_limit_s:g} s"
        return Answer(
            self._config.silence is Unchecked.ALLOW, f"no answer: {why}", is_answered=False
        )

    def _facts(self, order: Order, recipe: LoadedRecipe) -> dict[str, Any]:
        rule = recipe.recipe
        return {
            "serial": order.serial,
            "part": rule.part,
            "lot": order.lot,
            "station": self._station,
            "socket": order.socket,
            "operator": order.operator,
            "recipe": rule.name,
            "recipe_revision": rule.revision,
            "recipe_sha256": recipe.sha256,
            "targets": [
                {"target": each.name, "version": each.version, "image_sha256": each.image.sha256}
                for each in recipe.targets
            ],
            "is_virtual": order.is_virtual,
        }

    def _reply(self, facts: dict[str, Any], ends_at_s: float) -> _Reply:
        """Send the request, and read the reply. Raises _NoAnswerError, OSError, HTTPException,
        ValueError.
        """
        host = self._address.hostname or ""
        port = self._address.port or (HTTP_PORT if self._tls is None else HTTPS_PORT)
        connection = HTTPConnection(host, port)
        plain = socket.create_connection((host, port), timeout=_left_s(ends_at_s))
        made = plain
        try:
            if self._tls is not None:
                made = self._tls.wrap_socket(
                    plain, server_hostname=host, do_handshake_on_connect=False
                )
            # The time limit of a socket starts again with each byte: this one ends all of them.
            watch = threading.Timer(_left_s(ends_at_s), _shut, (made,))
            watch.daemon = True
            watch.start()
            try:
                if isinstance(made, ssl.SSLSocket):
                    made.do_handshake()
                connection.sock = made
                return self._exchange(connection, facts)
            finally:
                watch.cancel()
        finally:
            connection.close()
            made.close()

    def _exchange(self, connection: HTTPConnection, facts: dict[str, Any]) -> _Reply:
        address, method = self._address, self._config.method
        path, query, body = address.path or "/", address.query, None
        headers = {"Accept": "application/json", "User-Agent": f"flasher/{__version__}"}
        if method == "GET":
            named = {key: value for key, value in facts.items() if key != "targets"}
            for target in facts["targets"]:
                for key, value in target.items():
                    named.setdefault(key, []).append(value)
            query = "&".join(filter(None, (query, urlencode(named, doseq=True))))
        else:
            body = json.dumps(facts).encode("ascii")
            headers["Content-Type"] = "application/json"
        connection.request(method, f"{path}?{query}" if query else path, body, headers)
        response = connection.getresponse()
        if response.status in _REDIRECTS:
            where = printable(response.getheader("Location") or "nowhere")[:_REASON_MAX]
            raise _NoAnswerError(f"redirected to {where}, which is not followed")
        if response.status != _HTTP_OK:
            raise _NoAnswerError(f"HTTP status {response.status}")
        data = response.read(REPLY_MAX_SIZE + 1)
        if len(data) > REPLY_MAX_SIZE:
            raise _NoAnswerError(f"the reply has more than {REPLY_MAX_SIZE:,} bytes")
        if response.length:
            raise _NoAnswerError("the reply is not complete")
        try:
            reply = _REPLY.validate_json(data)
            json.loads(data, object_pairs_hook=_named_once)
        except ValueError as error:
            raise _NoAnswerError('the reply is not {"answer": "yes" or "no"}') from error
        return reply


def _named_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse an object with two values of one name, such as two answers."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name occurs twice")
    return found


def _tls(certificates: str) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=certificates or None)
    except OSError as error:
        raise UsageError(
            f"The certificates of the question cannot be read: {error.strerror or error}.",
            where=printable(certificates),
            remedy="Name a file with the certificate of the server's issuer (PEM).",
        ) from error


def _left_s(ends_at_s: float) -> float:
    return max(0.001, ends_at_s - time.perf_counter())


def _shut(made: socket.socket) -> None:
    with suppress(OSError):  # it is closed already
        made.shutdown(socket.SHUT_RDWR)


def _words(error: Exception) -> str:
    """Reason in a few words."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the server's certificate is not trusted ({error.verify_message})"
    words = (error.strerror if isinstance(error, OSError) else "") or str(error)
    return printable(" ".join((words or type(error).__name__).split()))[:_REASON_MAX]
