"""Test cases, one module per group; importing this package registers them in `catalogue.CASES`.

How to write a case
-------------------

    @case(
        "TX-06", "wrong start byte",
        clause="Welling 5.2, table 8 (A385); R10",          # keys of `clauses.CLAUSES`
        stimulus="packets that begin with 00, 02 and FF",   # stimulus and expectation are
        expectation="not stored; packet 1 is accepted when it is correct",   # in the reports
        requires={DESTRUCTIVE},        # `Requirement`: without it the case is `unsupported`
        choices=("tx_01",),            # profile keys that decide
    )
    def wrong_start_byte(bench: Bench) -> None:
        image = bench.good_image
        bench.start_transfer(len(image))                 # from the application to request transfer
        for start in (0x00, 0x02, 0xFF):
            with bench.step(f"start byte {start:02X}"):  # names the checks inside
                bench.send(bench.encoder.packet(1, 10, packet_payload(image, 1), start=start))
                bench.check_packet_rejected(1)           # by the profile; the case goes on
        bench.finish(image)                              # all packets, end, application, readback

- The application of `bench.good_image` runs before every case. The runner restores it afterwards,
  so a case need not clean up. A case that may erase requires DESTRUCTIVE. Only complete good
  images; a transfer of `bench.filler(n)` stays unfinished.
- Never import from flasher.protocol, host, image or mock: use `bench.encoder` and
  `conformance.wire` to send and receive. `bench.tester.collects_application` adds the messages of
  the application to other nodes. Faults: `with bench.disturb(LineFault(...))` on the line;
  `power_cycle`, `subject.bus_off` and `subject.cut_in_operation` on the device, each with its
  requirement.
- `check` records and continues; `require` and `expect` end the case when they fail. Texts give the
  expected and the actual behaviour. Judge only what the catalogue states: read a choice (P) by
  `bench.choice("tx_01")` and a limit by `bench.limit("ack_s")`.
- Record a part that this bench cannot judge by `bench.unsupported(what, why)`; use `requires=` for
  the whole case.
- `send` returns when the last frame has left (`left_at`); a `Received` has `first_at` and `at`.
  `check_time` judges, `measure` only records. `wait`, `collect` and `wait_for` are bounded;
  `wait_for` and `expect` default to the profile's limit for that message.
- Take random values only from `bench.random`, so that the seed repeats them. Bound every loop.
- Put parameters into a table at the top of the module and add a new group to the imports below.
  Cases that software cannot run are listed in `catalogue.NOT_IMPLEMENTED` with the reason.
- Add a packet form that the profile decides about to `fr.forms`: its case, `init` and the walks of
  `explore` then send it.
"""

from __future__ import annotations

from flasher.conformance.cases import br as br
from flasher.conformance.cases import bu as bu
from flasher.conformance.cases import co as co
from flasher.conformance.cases import cr as cr
from flasher.conformance.cases import en as en
from flasher.conformance.cases import fr as fr
from flasher.conformance.cases import pw as pw
from flasher.conformance.cases import rs as rs
from flasher.conformance.cases import se as se
from flasher.conformance.cases import so as so
from flasher.conformance.cases import sp as sp
from flasher.conformance.cases import tm as tm
from flasher.conformance.cases import tx as tx
from flasher.conformance.cases import up as up
