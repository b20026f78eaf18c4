"""Complete messages of the upgrade with the document's checksum, byte for byte: the data of CR-04,
and how they are said and heard. They are written out, so that a mistake of this suite's own encoder
cannot hide.
"""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.host import UPDATES_MAX
from flasher.conformance.wire import (
    BOOT_VERSION,
    REPORT,
    RESET,
    RESET_TEXT,
    Kind,
    RawFrame,
    Received,
    build,
    split,
)

_LEFTOVER_S: Final = 0.03
"""A boot version so soon after an update command was sent before it (R2)."""

VECTORS: Final[dict[str, dict[str, str]]] = {
    "wmc": {
        "reset": "55aa1607420552455345545fa4a5abf0",
        "feedback": "55aa0c05550341434b7cecb1d9f0",
        "update": "55aa160da10b574d435f5550440f3201007b315327f0",
        "small_update": "55aa160da10b574d435f5550448000000092324155f0",
        "request": "55aa0c04c402000001ea2f13f0",
        "packet": (
            "55aa1687a385010100650238b4e652e44da7f2370d9e260e27136550a4a3a6d07f5c0c332f8b1224"
            "083fd22b902f8911e81818f8c99d5d5d9831957504d90e945de2e8f54ee781cc75f636d85099095a"
            "a300165a67036f9b540d6b8f0be21124179c3dd9f73817ce6e118d264aad6cb6dd210faf94acd3cf"
            "92c190237cb11f5d108cf25930263938b370a1b4db6380f0"
        ),
        "ack": "55aa0c04c202010032bc87eef0",
        "nak": "55aa0c04c3020100da18d1ebf0",
        "end": "55aa1603a401046636c0fbf0",
        "complete": "55aa0c04c5020000e94e7916f0",
    },
    "bms": {
        "reset": "55aa160742055245534554a41da484f0",
        "feedback": "55aa0c05550341434bb209fc46f0",
        "update": "55aa160da10b424d535f5550440f320100327275d1f0",
        "small_update": "55aa160da10b424d535f55504480000000db7167a3f0",
        "request": "55aa0c04c4020000337142f8f0",
        "packet": (
            "55aa1687a3850101006502b405420fb169779edfb5b9342405157f54b12eae62d11e887eb0766d18"
            "77f8c6eff26b5010af3177d161e79587a766ec30e4037458a9905cad87bd4c77e2983f27745ccb9a"
            "31052e944cf1b220eaa2c7fb1b7d3e3f73f414af6e0d935520dd4c2147738606f2bf7ec70209e0cd"
            "05ee5720edbcba3acce672084ab649fcbce49b57331025f0"
        ),
        "ack": "55aa0c04c20201000027ea05f0",
        "nak": "55aa0c04c3020100e883bc00f0",
        "end": "55aa1603a401042c3d8a98f0",
        "complete": "55aa0c04c5020000dbd514fdf0",
    },
    "obc": {
        "reset": "55aa160742055245534554f28aa461f0",
        "feedback": "55aa0c05550341434bf7aac733f0",
        "update": "55aa160da10b4f42435f5550440f320100838eea16f0",
        "small_update": "55aa160da10b4f42435f555044800000006a8df864f0",
        "request": "55aa0c04c4020000deb892ccf0",
        "packet": (
            "55aa1687a385010100650229825e79455971b21ae105aab2d6a3100b08880f0f422dbb36fb94b3cb"
            "6d424f813caaa5b348f4930b893bfe338f65aea5a969d270831572af40db4852eb74b74f3ac36288"
            "1215e31ed32cab3d56d55807afc6053558cef092a9317629b2ff5ae637052b3839659c78fdf91d0a"
            "aa627e00a3170ffb76dc37c1eaaac4992395494a839ef9f0"
        ),
        "ack": "55aa0c04c2020100edee3a31f0",
        "nak": "55aa0c04c3020100054a6c34f0",
        "end": "55aa1603a40104e98447d4f0",
        "complete": "55aa0c04c5020000361cc4c9f0",
    },
}
"""Target, then message, in hexadecimal: `update` for 78351 bytes, `small_update` for 128,
`packet` 1 of 613.
"""


class Exact:
    """Says and hears messages that are written out in `VECTORS`."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        texts = VECTORS[bench.encoder.target]
        self._written = {name: bytes.fromhex(text) for name, text in texts.items()}

    def frames(self, name: str) -> list[RawFrame]:
        """A written-out message."""
        return split(self._bench.encoder.to_device, self._written[name])

    def hear(self, name: str, within_s: float) -> None:
        """The next message is the written-out one; another ends the case."""
        self._judge(name, self._written[name], self._bench.next_message(within_s))

    def hear_first_nak(self, within_s: float) -> None:
        """The same for NAK 1. Whether there is a NAK, and with which number, is TX-01."""
        heard = self._bench.next_message(within_s)
        if (
            heard is None
            or heard.kind is Kind.ACK
            or (heard.kind is Kind.NAK and heard.number != 1)
        ):
            self._bench.info(f"NAK 1 was not to be had: {heard or 'no answer'}")
        else:
            self._judge("nak", self._written["nak"], heard)

    def enter(self, update: list[RawFrame]) -> None:
        """From the application to the request transfer that this update command gets."""
        bench, words, limit = self._bench, self._bench.encoder, self._bench.limit
        bench.forget()
        is_own = (words.reset_command, words.reset_data) != (RESET, RESET_TEXT)
        bench.send(words.reset() if is_own else self.frames("reset"))
        heard = bench.next_message(limit("first_version_s"))
        if heard is None or heard.kind is not Kind.BOOT_VERSION:  # one without feedback: RS-01
            self._judge("feedback", self._written["feedback"], heard)
            heard = bench.next_message(limit("first_version_s"))
        # The text in it is the product's own.
        text = heard.data[3:] if heard is not None else b""
        version = build(words.to_tool, REPORT, BOOT_VERSION, words.boot_name.encode() + text)
        self._judge("boot version", version, heard)
        for _ in range(UPDATES_MAX):
            sent = bench.send(update)
            heard = self._behind_leftovers(sent.left_at)
            if heard is None or heard.kind is not Kind.BOOT_VERSION:
                break
        self._judge("request", self._written["request"], heard)

    def _behind_leftovers(self, asked_at: float) -> Received | None:
        """What follows the update command; boot versions sent before it was heard do not (R2)."""
        heard: Received | None = None
        for _ in range(UPDATES_MAX):
            heard = self._bench.next_message(self._bench.limit("erase_s"))
            is_version = heard is not None and heard.kind is Kind.BOOT_VERSION
            if heard is None or not is_version or heard.at > asked_at + _LEFTOVER_S:
                break
        return heard

    def _judge(self, name: str, wanted: bytes, heard: Received | None) -> None:
        where = self._bench.encoder.to_tool
        got = "nothing" if heard is None else f"{heard.can_id:03X} {heard.raw.hex(' ').upper()}"
        ok = heard is not None and (heard.can_id, heard.raw) == (where, wanted)
        self._bench.require(ok, f"{name}: {where:03X} {wanted.hex(' ').upper()}", got)
