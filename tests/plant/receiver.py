"""A receiver of runs for tests: an HTTP server that keeps what it takes by its key, and can fail in
the ways of the real ones.
"""

from __future__ import annotations

import json
import ssl
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from flasher.plant.transport import KEY_HEADER


class Act(StrEnum):
    """What the receiver does with a request."""

    TAKE = "take"
    FAIL = "fail"
    """Answers 503 and takes nothing."""
    TAKE_AND_FAIL = "take and fail"
    """Takes it, and answers 500."""
    HANG = "hang"
    """Takes nothing, and answers nothing."""
    TAKE_AND_HANG = "take and hang"
    """Takes it, and answers nothing."""
    DROP = "drop"
    """Ends the connection without an answer."""
    REFUSE = "refuse"
    """Answers 422."""
    BUSY = "busy"
    """Answers 429."""


@dataclass
class Receiver:
    """What arrived, and what to do next."""

    plan: Callable[[], Act] = lambda: Act.TAKE
    user: tuple[str, str] | None = None
    documents: dict[str, Any] = field(default_factory=dict)
    """What is in effect: the first document of each key."""
    requests: Counter[str] = field(default_factory=Counter)
    """Requests by key."""
    order: list[str] = field(default_factory=list)
    """Serial numbers of what was taken."""
    differing: list[str] = field(default_factory=list)
    """Keys whose documents were not the same each time."""
    authorization: str = ""
    url: str = ""
    over: threading.Event = field(default_factory=threading.Event)
    _mutex: threading.Lock = field(default_factory=threading.Lock)

    def take(self, key: str, document: Any) -> None:
        with self._mutex:
            if key not in self.documents:
                self.documents[key] = document
                self.order.append(document["run"]["run"]["serial"])
            elif self.documents[key] != document:
                self.differing.append(key)


@contextmanager
def receiving(receiver: Receiver, tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """Serve on a free port while the block runs."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            document, key = json.loads(body), self.headers[KEY_HEADER]
            assert document["key"] == key
            receiver.authorization = self.headers.get("Authorization", "")
            with receiver._mutex:
                receiver.requests[key] += 1
                act = receiver.plan()
            if act in (Act.TAKE, Act.TAKE_AND_FAIL, Act.TAKE_AND_HANG):
                receiver.take(key, document)
            if act in (Act.HANG, Act.TAKE_AND_HANG):
                receiver.over.wait(30.0)
            if act in (Act.HANG, Act.TAKE_AND_HANG, Act.DROP):
                self.close_connection = True
                return
            status, text = {
                Act.TAKE: (201, b""), Act.FAIL: (503, b"away"), Act.TAKE_AND_FAIL: (500, b""),
                Act.REFUSE: (422, b"no such part"), Act.BUSY: (429, b""),
            }[act]  # fmt: skip
            self.send_response(status)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def log_message(self, *_: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *_: object) -> None:
            """A client that died."""

    with Server(("127.0.0.1", 0), Handler) as server:
        if tls is not None:
            server.socket = tls.wrap_socket(server.socket, server_side=True)
        scheme = "http" if tls is None else "https"
        receiver.url = f"{scheme}://127.0.0.1:{server.server_port}/runs"
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield receiver
        finally:
            receiver.over.set()
            server.shutdown()
            thread.join()
