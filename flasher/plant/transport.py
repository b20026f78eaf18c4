"""Sends a document to a receiver, by HTTP or MQTT 5, and returns the result.

What is known is not always what happened: without an answer the receiver may have the document or
not (`UNKNOWN`). It is sent again then, with the same key.
"""

from __future__ import annotations

import asyncio
import math
import ssl
from typing import Any, Final

import httpx2
from aiomqtt import Client, MqttError, ProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from flasher.errors import UsageError
from flasher.plant.deliveries import Answer, DeliveryState
from flasher.plant.receivers import Receiver, password_of
from flasher.protocol.text import printable

KEY_HEADER: Final = "Idempotency-Key"
"""Header of HTTP, and name of the user property of MQTT, with the key of a document."""
_LATER: Final = frozenset({408, 425, 429})
"""Refusals of HTTP that are not final."""
_BODY_SHOWN: Final = 200
_MEDIA_TYPE: Final = "application/json"
_TOO_LARGE: Final = 0x95
_PACKET_BYTES: Final = 1 + 4 + 2 + 2
"""A packet without topic, properties and payload: its header, and the lengths and number in it."""
_MQTT_FINAL: Final = frozenset({0x87, 0x90, _TOO_LARGE, 0x99})
"""Refusals of MQTT that are final: not authorized, topic name invalid, packet too large, payload
format invalid."""


class Transport:
    """Connects to one receiver. `send` raises nothing but CancelledError."""

    def __init__(self, receiver: Receiver) -> None:
        """Read password and certificates. Raises UsageError."""
        self.receiver = receiver
        self._password = password_of(receiver)
        self._tls = _tls_of(receiver) if receiver.is_secure else None

    async def send(self, key: str, document: bytes) -> Answer:
        """Send a document once."""
        raise NotImplementedError

    async def close(self) -> None:
        """End kept connections."""


def transport_to(receiver: Receiver) -> Transport:
    """Make the transport of a receiver. Raises UsageError."""
    return (MqttTransport if receiver.kind == "mqtt" else HttpTransport)(receiver)


def _tls_of(receiver: Receiver) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=receiver.ca_file or None)
    except OSError as error:  # SSLError too
        raise UsageError(
            f"The certificates of {receiver.name} cannot be read.",
            where=printable(receiver.ca_file),
            cause=printable(str(error)),
            remedy="Name a file with certificates in PEM format as ca_file.",
        ) from error


def _not_sent(error: BaseException) -> Answer:
    return Answer(DeliveryState.WAITING, f"no connection: {_words(error)}")


def _lost(error: BaseException) -> Answer:
    return Answer(DeliveryState.UNKNOWN, f"no answer: {_words(error)}")


def _words(error: BaseException) -> str:
    if isinstance(error, TimeoutError):
        return "the time limit"
    return printable(" ".join(str(error).split()))[:_BODY_SHOWN] or type(error).__name__


class HttpTransport(Transport):
    """Posts documents."""

    def __init__(self, receiver: Receiver) -> None:
        super().__init__(receiver)
        auth = (receiver.user, self._password or "") if receiver.user else None
        self._client = httpx2.AsyncClient(
            auth=auth,
            verify=self._tls or False,
            # The limit of the whole attempt is that of `send`.
            timeout=httpx2.Timeout(receiver.time_limit_s, connect=receiver.time_limit_s / 2),
            trust_env=False,  # a proxy of this user's shell is no part of the settings
            # An answer that is late or sent twice must not be taken for that of the next document.
            limits=httpx2.Limits(max_keepalive_connections=0),
        )

    async def close(self) -> None:
        await self._client.aclose()

    async def send(self, key: str, document: bytes) -> Answer:
        headers = {KEY_HEADER: key, "Content-Type": _MEDIA_TYPE}
        post = self._client.stream("POST", self.receiver.url, content=document, headers=headers)
        answer: Answer | None = None
        try:
            async with asyncio.timeout(self.receiver.time_limit_s), post as response:
                answer = _http_answer(response.status_code, "")
                if answer.state is not DeliveryState.CONFIRMED:
                    answer = _http_answer(response.status_code, await _begin_of(response))
        # InvalidURL: a host name that the client accepts less than `receivers` does.
        except (
            httpx2.InvalidURL, httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout,
        ) as error:  # fmt: skip
            return _not_sent(error)
        except (httpx2.HTTPError, httpx2.StreamError, TimeoutError, OSError) as error:
            return answer or _lost(error)
        return answer


async def _begin_of(response: httpx2.Response) -> str:
    body = b""
    async for part in response.aiter_raw():
        body += part
        if len(body) >= _BODY_SHOWN:
            break
    return printable(" ".join(body[:_BODY_SHOWN].decode("utf-8", "replace").split()))


def _http_answer(status: int, body: str) -> Answer:
    text = f"HTTP {status}{': ' if body else ''}{body}"
    if httpx2.codes.is_success(status):
        return Answer(DeliveryState.CONFIRMED, text)
    if httpx2.codes.is_client_error(status) and status not in _LATER:
        return Answer(DeliveryState.REFUSED, text)
    # After a fault of its own the receiver may have it, or a server before it does not know.
    is_fault = httpx2.codes.is_server_error(status)
    return Answer(DeliveryState.UNKNOWN if is_fault else DeliveryState.WAITING, text)


class _Publisher(Client):
    """A client of MQTT that keeps what the broker accepts and answers to a publication, and why it
    ends the connection: aiomqtt drops the first two, and waits on after the last.
    """

    packet_max_bytes: int | None = None
    """Largest packet that the broker accepts; None: it states no limit (MQTT 5, 3.2.2.3.6)."""

    reason: ReasonCode | None = None
    """Answer to the publication."""
    farewell: ReasonCode | None = None

    def _on_connect(
        self,
        client: Any,
        userdata: Any,
        flags: Any,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        self.packet_max_bytes = getattr(properties, "MaximumPacketSize", None)
        super()._on_connect(client, userdata, flags, reason_code, properties)

    def _on_publish(
        self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Properties
    ) -> None:
        self.reason = reason_code
        super()._on_publish(client, userdata, mid, reason_code, properties)

    def _on_disconnect(
        self,
        client: Any,
        userdata: Any,
        flags: Any,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        self.farewell = reason_code
        super()._on_disconnect(client, userdata, flags, reason_code, properties)
        if self._disconnected.done():
            self._disconnected.exception()  # asyncio reports one that is never asked for
        for publication in self._pending_publishes.values():
            publication.set()


class MqttTransport(Transport):
    """Publishes documents, each with a connection of its own."""

    async def send(self, key: str, document: bytes) -> Answer:
        receiver = self.receiver
        properties = Properties(PacketTypes.PUBLISH)
        properties.UserProperty = [(KEY_HEADER, key)]
        properties.ContentType = _MEDIA_TYPE
        properties.PayloadFormatIndicator = 1  # UTF-8
        client = _Publisher(
            receiver.host,
            receiver.port,
            username=receiver.user or None,
            password=self._password,
            identifier="",  # the broker gives one
            protocol=ProtocolVersion.V5,
            tls_context=self._tls,
            timeout=receiver.time_limit_s,
        )
        is_connected = False
        try:
            async with asyncio.timeout(receiver.time_limit_s), client:
                is_connected = True
                size = _PACKET_BYTES + len(receiver.topic.encode()) + len(properties.pack())
                # A broker that gets more ends the connection, and its reason is often not read.
                if size + len(document) > (client.packet_max_bytes or math.inf):
                    return _mqtt_answer(ReasonCode(PacketTypes.DISCONNECT, identifier=_TOO_LARGE))
                await client.publish(receiver.topic, document, qos=1, properties=properties)
        except (MqttError, TimeoutError, OSError) as error:
            if not is_connected:
                return _not_sent(error)
            if client.reason is None and client.farewell is None:
                return _lost(error)
        if client.reason is not None:
            return _mqtt_answer(client.reason)
        if client.farewell is not None and client.farewell.value in _MQTT_FINAL:
            return _mqtt_answer(client.farewell)
        return Answer(DeliveryState.UNKNOWN, f"no answer: {_reason(client.farewell)}")


def _reason(code: ReasonCode | None) -> str:
    return "the connection ended" if code is None else f"MQTT {code.value}: {str(code).lower()}"


def _mqtt_answer(reason: ReasonCode) -> Answer:
    text = _reason(reason)
    if reason.value == 0:
        return Answer(DeliveryState.CONFIRMED, text)
    state = DeliveryState.REFUSED if reason.value in _MQTT_FINAL else DeliveryState.WAITING
    return Answer(state, text)
