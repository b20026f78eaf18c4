"""`flasher ui`: upgrade one bike in a browser, on the page of `flasher.web.bench`.

Its packages (the extra `web`) are imported only here.
"""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from flasher.cli import values
from flasher.cli.extras import need
from flasher.cli.framework import command, option
from flasher.cli.options import Bus, bus_options
from flasher.cli.output import Output
from flasher.errors import ExitCode

_EXAMPLES: Final = """\
examples:
  flasher ui --mock                                try it without hardware, with faults to choose
  flasher ui                                       offers the detected adapters
  flasher ui --images ~/firmware -i slcan -c /dev/ttyACM0

The page is for this computer alone. Its address works once, in the browser that opens it first;
more tabs of that show the same. Closing the page ends nothing; Ctrl-C here ends an upgrade at the
end of its message, and reports the state of the device. The guide is
docs/how-to/bench_page.md.
"""


@dataclass(frozen=True)
class ServingLine:
    """The page is being served."""

    event: Literal["serving"]
    address: str
    """URL of the page; works once, in the browser that opens it first."""


@dataclass(frozen=True)
class UiDocument:
    """The page was closed; its upgrades are in the history."""

    address: str


LINES: Final = (ServingLine,)
DOCUMENTS: Final = (UiDocument,)


@command(
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.BUS, ExitCode.TRANSFER, ExitCode.INTERRUPTED),
)
@option(
    "--images", metavar="DIR", type=values.FolderPath(), panel="page", brief=True,
    help="the folder whose images are offered (default: the one that was chosen on the page last, "
    "else this one)",
)  # fmt: skip
@option("--no-browser", is_flag=True, panel="page", brief=True, help="print the address only")
@option(
    "--port", type=values.port, default="0", metavar="N", panel="page",
    help="of this computer; 0 is any that is free",
)  # fmt: skip
@bus_options(mock="offer virtual bikes, each with a fault or none")
def ui(output: Output, bus: Bus, *, images: Path | None, no_browser: bool, port: int) -> int:
    """Upgrade a bike in a browser: adapter, bike, image, checks, upgrade, result."""
    need("The page", "web")
    from flasher.cli.upgrade.bench_page import serve  # noqa: PLC0415  an extra

    address = ""

    def opened(url: str) -> None:
        nonlocal address
        address = url
        output.result(url)
        output.line(ServingLine("serving", url))
        if not no_browser and not webbrowser.open(url):
            output.progress("no browser could be started: open the address in one")

    error = serve(output, bus, images, port=port, opened=opened)
    document = UiDocument(address)
    if error is not None:
        return output.failure(error, document)
    return output.document(document)
