"""Echo detection: frames that an adapter returns after sending them.

A link marks an echo as `Frame.is_echo`, so that no other code has to detect it. Its delay proves
nothing, because this computer may have stalled. An echo is detected by the back end's flag if that
identifies this handle, else by content and order. Echoes may be missing, slightly out of order, or
doubled (a network with two paths).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from enum import Enum
from typing import Final

from flasher.protocol.frame import Frame

ECHO_FRAMES: Final = 1024
"""Maximum number of sent frames without echo: 57 packets; the host sends one at a time."""
REORDER_FRAMES: Final = 64
"""Maximum number of later echoes before an echo: three packets and a half."""
DOUBLE_LIMIT_S: Final = 0.1
"""Maximum difference of the time stamps of an echo and its second copy."""


class Sender(Enum):
    """Possible senders of a frame that python-can flags as transmitted (`is_rx` False)."""

    THIS_HANDLE = "this handle"
    THIS_COMPUTER = "any program on this computer"
    UNKNOWN = "not documented, or the flag is never set"


FLAGGED_SENDER: Final[Mapping[str, Sender]] = {
    "cantact": Sender.THIS_HANDLE,  # the frame's loopback flag; the USB device has one user
    "gs_usb": Sender.THIS_HANDLE,  # the frame's echo id; the USB device has one user
    "virtual": Sender.THIS_HANDLE,  # compares the queues
    "socketcan": Sender.THIS_COMPUTER,  # MSG_DONTROUTE; MSG_CONFIRM would be this socket
    "etas": Sender.UNKNOWN,  # self-reception of a controller that programs may share
    "kvaser": Sender.UNKNOWN,  # acknowledgement of another local handle's frame
    "neovi": Sender.UNKNOWN,  # sent by the device, whichever program asked for it
    "nixnet": Sender.UNKNOWN,  # sent by the interface, whichever session asked for it
    "pcan": Sender.UNKNOWN,  # several programs may share a channel
    "vector": Sender.UNKNOWN,  # several programs may share a channel
}
"""Interfaces of python-can 4.6 that set the flag."""


class Echoes:
    """Remembers the frames sent through a link, and marks their echoes.

    `gives_own` is False if the handle never receives its own frames (a SocketCAN socket by
    default): an apparent echo then has another sender.
    """

    def __init__(self, flagged: Sender = Sender.UNKNOWN, *, gives_own: bool = True) -> None:
        self.ids: set[int] = set()
        """CAN ids of sent frames."""
        self._flagged = flagged
        self._gives_own = gives_own
        self._expected: deque[Frame] = deque(maxlen=ECHO_FRAMES)
        """Sent frames whose echo has not arrived yet, oldest first."""
        self._unreturned: deque[Frame] = deque(maxlen=ECHO_FRAMES)
        """Sent frames whose echo this handle does not receive."""
        self._echoed: dict[Frame, float] = {}
        """Time stamps of the latest echoes."""

    def sent(self, frame: Frame) -> None:
        """Record a frame passed to the adapter."""
        (self._expected if self._gives_own else self._unreturned).append(frame)
        self.ids.add(frame[0])

    def reopened(self) -> None:
        """Expect echoes of the previous handle's frames: the driver may still send them."""
        self._expected.extend(self._unreturned)
        self._unreturned.clear()

    def mark(self, frame: Frame, stamp_s: float, *, is_rx: bool) -> Frame:
        """Return a received frame, marked if it is an echo or a second copy of one.

        `stamp_s` is its time stamp in seconds on the adapter's clock, `is_rx` the back end's flag.
        """
        if frame[0] not in self.ids:
            return frame
        if self._flagged is Sender.THIS_HANDLE:
            return frame if is_rx else frame.as_echo()
        if is_rx and self._flagged is Sender.THIS_COMPUTER:
            return frame
        echoed_s = self._echoed.get(frame)
        if echoed_s is not None and abs(stamp_s - echoed_s) <= DOUBLE_LIMIT_S:
            return frame.as_echo()
        expected = self._expected
        for index, own in enumerate(expected):
            if own == frame:
                del expected[index]
                for _ in range(index - REORDER_FRAMES):
                    expected.popleft()  # its echo was lost
                self._echoed.pop(frame, None)
                self._echoed[frame] = stamp_s
                if len(self._echoed) > REORDER_FRAMES:
                    del self._echoed[next(iter(self._echoed))]
                return frame.as_echo()
        return frame
