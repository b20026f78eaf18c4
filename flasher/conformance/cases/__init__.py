"""The cases, a file a group; importing this package registers them all in `catalogue.CASES`.

How to write a case
-------------------

    @case(
        "TX-06", "wrong start byte",
        clause="Welling 5.2, table 8 (A385); R10",       # of `conformance.clauses`
        stimulus="packets that begin with 00, 02 and FF",   # both texts stand in the reports
        expectation="not stored; packet 1 is accepted when it comes as it should",
        requires={DESTRUCTIVE},                          # `Requirement`; what is missing on a
        choices=("tx_01",),                              # bench makes the case `unsupported`
    )
    def wrong_start_byte(bench: Bench) -> None:
        image = bench.good_image
        bench.start_transfer(len(image))                 # from the application to request transfer
        for start in (0x00, 0x02, 0xFF):
            with bench.step(f"start byte {start:02X}"):  # names the checks inside
                bench.send(bench.encoder.packet(1, 10, packet_payload(image, 1), start=start))
                bench.check_packet_rejected(1)           # by the profile; the case goes on
        bench.finish(image)                              # all packets, end, application, readback

- Before a case the application of `bench.good_image` runs. After it the runner brings the device
  back to that, whatever state it was left in; a case need not tidy up. One that may erase says
  DESTRUCTIVE. Only good images are ever ended: a transfer of `bench.filler(n)` is left as it is.
- Never import from flasher.protocol, host, image or mock: use `bench.encoder` and
  `conformance.wire` to send and receive. `bench.tester.collects_application` adds the messages of
  the application to other nodes. Faults: `with bench.disturb(LineFault(...))` on the line;
  `power_cycle`, `subject.bus_off`, `subject.cut_in_operation` at the device, each with its
  requirement.
- `check` records and goes on, `require` and `expect` end the case; texts say what is expected and
  what was got. Judge what the catalogue says and no more: a choice (P) is read with
  `bench.choice("tx_01")`, a limit with `bench.limit("ack_s")`.
- A part that this bench cannot do: `bench.unsupported(what, why)`; the whole case: `requires=`.
- Times: `send` returns when the last frame had left (`left_at`), a `Received` has `first_at` and
  `at`; `check_time` judges, `measure` records. Waits are `wait`, `collect`, `wait_for`: all
  bounded, `wait_for` and `expect` by the profile's limit for that message where none is given.
- Chance comes from `bench.random` only, so that the seed repeats it. No loop without a bound.
- Parameters are a table at the top of the file. One file a group, added to the imports below; what
  software cannot do stands in `catalogue.NOT_IMPLEMENTED` with the reason.
- A form of a packet that the profile decides about is a row of `fr.forms`: its case, `init` and the
  walks of `explore` send it without further code.
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
