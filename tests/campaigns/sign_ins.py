"""Sign-ins at the same time, at a station that runs: `python -m tests.campaigns.sign_ins --count
1000 --seconds 30`.

A client on this computer tries PINs of a supervisor's badge, `--count` at once and again until the
time is over; one of each burst is right. Tells how many were checked, the peak memory of the
station, how long the pages of another client took meanwhile, and the longest gap in its stream of
the operator page. Returns 1 where more than five tries were checked in a minute, or the owner of
the badge could not sign in at the other address. The other client has the address of this computer
in its network: there has to be one.
"""

from __future__ import annotations

import argparse
import asyncio
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import urlencode

from flasher.station.pins import Pin, hash_of
from tests.campaigns.page_kills import RECIPE, free_port

_PIN: Final = "470815"
_BADGE: Final = "BADGE-0002"
_ATTACKER: Final = "127.0.0.1"
_CHECKED_MAX: Final = 5
_LOOK_EVERY_S: Final = 0.1
_BADGES: Final = """\
[[person]]
name = "Sue"
code = "{badge}"
role = "supervisor"
pin = "{pin}"
"""


@dataclass
class Answer:
    """`status`: 0 where the server has ended the connection."""

    status: int
    head: str = ""
    body: str = ""


@dataclass
class Client:
    """Somebody who calls the station by one of its addresses, with one session."""

    port: int
    address: str
    """Its own, and that of the station."""
    cookie: str = ""
    token: str = ""
    checked_s: list[float] = field(default_factory=list)

    async def ask(self, method: str, path: str, body: str = "") -> Answer:
        try:
            reader, writer = await asyncio.open_connection(
                self.address, self.port, local_addr=(self.address, 0)
            )
        except OSError:
            return Answer(0)
        lines = [f"{method} {path} HTTP/1.1", f"host: 127.0.0.1:{self.port}", "connection: close"]
        lines += [f"cookie: {self.cookie}"] if self.cookie else []
        if method == "POST":
            lines += [f"origin: http://127.0.0.1:{self.port}", f"content-length: {len(body)}"]
            lines += ["content-type: application/x-www-form-urlencoded"]
        try:
            writer.write("\r\n".join([*lines, "", body]).encode())
            head, _, text = (await reader.read()).decode().partition("\r\n\r\n")
        except OSError:
            return Answer(0)
        finally:
            writer.close()
        for cookie in re.findall(r"set-cookie: ([^;]+)", head):
            self.cookie = cookie
        return Answer(int(head.split()[1]) if head else 0, head, text)

    async def begin(self) -> None:
        """Get a session, for a page that is for supervisors."""
        await self.ask("GET", "/runs")
        page = await self.ask("GET", "/login")
        self.token = re.findall(r'name="token" value="(.*?)"', page.body)[0]

    async def sign_in(self, pin: str) -> int:
        fields = {"token": self.token, "badge": _BADGE, "pin": pin}
        answer = await self.ask("POST", "/login", urlencode(fields))
        # A wrong one, or a right one: it was compared.
        if answer.status in (403, 303):
            self.checked_s.append(time.perf_counter())
        return answer.status

    @property
    def most_in_a_minute(self) -> int:
        return max(
            (sum(at <= each < at + 60 for each in self.checked_s) for at in self.checked_s),
            default=0,
        )


class Watch:
    """Somebody who has signed in, and looks at the page of the line."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.took_s: list[float] = []
        self.longest_gap_s = 0.0
        self.refused = 0
        self.is_followed = asyncio.Event()

    async def pages(self) -> None:
        while True:
            begun = time.perf_counter()
            answer = await self._client.ask("GET", "/line")
            self.refused += answer.status != 200
            self.took_s.append(time.perf_counter() - begun)
            await asyncio.sleep(_LOOK_EVERY_S)

    async def stream(self) -> None:
        client = self._client
        reader, writer = await asyncio.open_connection(client.address, client.port)
        head = f"host: 127.0.0.1:{client.port}\r\ncookie: {client.cookie}\r\n\r\n"
        writer.write(f"GET /line/events HTTP/1.1\r\n{head}".encode())
        last: float | None = None
        while line := await reader.readline():
            if line.startswith(b"data:"):
                now = time.perf_counter()
                self.longest_gap_s = max(self.longest_gap_s, now - (now if last is None else last))
                last = now
                self.is_followed.set()
        raise ConnectionError("the stream has ended")


def _start(folder: Path, port: int) -> subprocess.Popen[bytes]:
    badges = folder / "badges.toml"
    badges.write_text(_BADGES.format(badge=_BADGE, pin=hash_of(Pin(_PIN))), "utf-8")
    return subprocess.Popen(
        [
            sys.executable, "-m", "flasher", "station", "run", "--recipe", str(RECIPE),
            "--mock-sockets", "2", "--web", f"0.0.0.0:{port}", "--web-insecure",
            "--badges", str(badges),
            "--database", str(folder / "records.sqlite"), "--keys", str(folder / "keys"),
        ],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip


def _mib(pid: int, what: str) -> float:
    found = re.search(rf"{what}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


async def _until_there(client: Client) -> None:
    while (await client.ask("GET", "/login")).status != 200:
        await asyncio.sleep(0.2)
    await client.begin()


async def _attack(client: Client, count: int, seconds: float) -> Counter[int]:
    """Tries, `count` at once, until the time is over."""
    statuses: Counter[int] = Counter()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pins = (_PIN if number == count // 2 else f"{number:06}" for number in range(count))
        statuses.update(await asyncio.gather(*map(client.sign_in, pins)))
    return statuses


def _own_address() -> str:
    """Of this computer in its network. No packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("198.51.100.1", 9))
        address: str = out.getsockname()[0]
        return address


async def _measure(options: argparse.Namespace, pid: int, port: int) -> int:
    own = _own_address()
    screen, owner, attacker = Client(port, own), Client(port, own), Client(port, _ATTACKER)
    await _until_there(screen)
    for client in (owner, attacker):
        await client.begin()
    assert await screen.sign_in(_PIN) == 303
    quiet, busy = Watch(screen), Watch(screen)
    for watch in (quiet, busy):
        looking = [asyncio.create_task(each) for each in (watch.pages(), watch.stream())]
        await asyncio.wait_for(watch.is_followed.wait(), 10)
        if watch is quiet:
            before_mib = _mib(pid, "VmHWM")
            await asyncio.sleep(options.quiet)
        else:
            attack = asyncio.create_task(_attack(attacker, options.count, options.seconds))
            await asyncio.sleep(options.seconds / 2)
            begun = time.perf_counter()
            while (let_in := await owner.sign_in(_PIN)) == 503:  # busy: as a person does
                await asyncio.sleep(1.0)
            owner_s = time.perf_counter() - begun
            statuses = await attack
        for task in looking:
            assert not task.done(), task.exception()
            task.cancel()
    most = attacker.most_in_a_minute
    words = {0: "connection ended", 303: "let in", 403: "wrong", 429: "too many", 503: "busy"}
    reported = defaultdict(int, {words.get(code, str(code)): n for code, n in statuses.items()})
    sys.stdout.write(
        f"{statuses.total()} tries in {options.seconds:g} s, {options.count} at once:"
        f" {', '.join(f'{n} {what}' for what, n in sorted(reported.items()))}\n"
        f"checked: {len(attacker.checked_s)}; at most {most} in a minute\n"
        f"the owner at another address: {let_in}, after {owner_s:.1f} s\n"
        f"peak memory of the station: {_mib(pid, 'VmHWM'):.0f} MiB, {before_mib:.0f} before\n"
    )
    for name, watch in (("quiet", quiet), ("meanwhile", busy)):
        took_ms = sorted(1000 * each for each in watch.took_s)
        sys.stdout.write(
            f"{name}: {len(took_ms)} pages, median {took_ms[len(took_ms) // 2]:.0f} ms, longest"
            f" {took_ms[-1]:.0f} ms, {watch.refused} refused; longest gap in the stream"
            f" {watch.longest_gap_s:.2f} s\n"
        )
    return 0 if most <= _CHECKED_MAX and let_in == 303 and not busy.refused else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=1000, help="at once")
    parser.add_argument("--seconds", type=float, default=65.0)
    parser.add_argument("--quiet", type=float, default=5.0, help="seconds before, to compare")
    options = parser.parse_args()
    port = free_port()
    with tempfile.TemporaryDirectory() as name:
        station = _start(Path(name), port)
        try:
            return asyncio.run(_measure(options, station.pid, port))
        finally:
            station.terminate()
            station.wait()


if __name__ == "__main__":
    sys.exit(main())
