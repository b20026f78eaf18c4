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

from flasher.protocol.frame import Frame
from tests.end_to_end.lawicel import Program

READY: Final = "plugged in"


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
    program = Program()
    sent: set[tuple[int, bytes]] = set()

    def to_computer() -> None:
        for message in bus:
            key = (message.arbitration_id, bytes(message.data))
            if key in sent:  # a multicast bus hears itself, an slcan adapter does not
                sent.discard(key)
            else:
                os.write(ours, program.line_of(Frame(*key)))

    threading.Thread(target=to_computer, daemon=True).start()
    sys.stdout.write(f"{READY}\n")
    sys.stdout.flush()
    while True:
        for answer, frame in program.take(os.read(ours, 4096)):
            os.write(ours, answer)
            if frame is not None:
                sent.add((frame.can_id, frame.data))
                bus.send(
                    can.Message(arbitration_id=frame.can_id, is_extended_id=False, data=frame.data)
                )


if __name__ == "__main__":
    main()
