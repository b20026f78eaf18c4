"""An adapter that can be pulled out: `python -m tests.end_to_end.serial_adapter LINK GROUP PORT`.

A process that speaks slcan at a terminal of its own, to which LINK leads, and is a node of a UDP
multicast bus. Killed, it is an adapter that was pulled out: its serial port is gone.
"""

from __future__ import annotations

import os
import pty
import sys
import threading
import tty
from pathlib import Path
from typing import Final

import can

READY: Final = "plugged in"


def _line(message: can.Message) -> bytes:
    return f"t{message.arbitration_id:03X}{message.dlc}{message.data.hex().upper()}\r".encode()


def _message(line: bytes) -> can.Message | None:
    """What a line sends; None for one that sets something."""
    if not line.startswith(b"t"):
        return None
    size = int(line[4:5])
    return can.Message(
        arbitration_id=int(line[1:4], 16),
        is_extended_id=False,
        data=bytes.fromhex(line[5 : 5 + 2 * size].decode()),
    )


def main() -> None:
    """Serve until it is killed."""
    link, group, port = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    ours, theirs = pty.openpty()
    tty.setraw(theirs)  # held open: a port stays there when a program closes it
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(theirs))
    bus = can.Bus(
        interface="udp_multicast", channel=group, port=port, hop_limit=0, ignore_config=True
    )
    sent: set[tuple[int, bytes]] = set()

    def to_computer() -> None:
        for message in bus:
            key = (message.arbitration_id, bytes(message.data))
            if key in sent:  # a multicast bus hears itself, an slcan adapter does not
                sent.discard(key)
            else:
                os.write(ours, _line(message))

    threading.Thread(target=to_computer, daemon=True).start()
    sys.stdout.write(f"{READY}\n")
    sys.stdout.flush()
    held = b""
    while True:
        held += os.read(ours, 4096)
        *lines, held = held.split(b"\r")
        for message in map(_message, lines):
            if message is not None:
                sent.add((message.arbitration_id, bytes(message.data)))
                bus.send(message)


if __name__ == "__main__":
    main()
