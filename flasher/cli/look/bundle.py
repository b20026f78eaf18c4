"""`flasher bundle`: pack what explains a failure into one file to send to whoever helps."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.cli import values
from flasher.cli.adapters import detect_adapters, slcan_ports
from flasher.cli.files import check_new, check_not_read, write_whole
from flasher.cli.framework import argument, command, option
from flasher.cli.look.adapters import adapters_document
from flasher.cli.look.explain import find_source
from flasher.cli.output import Output, byte_count
from flasher.documents import as_json
from flasher.errors import ExitCode, UsageError
from flasher.files import read
from flasher.history import FlashHistory
from flasher.protocol.text import printable

_FLASHES_PACKED: Final = 20
"""Maximum number of upgrades of the history in the file."""
_ADDED_MAX: Final = 64 * 1024 * 1024
_OUTPUT: Final = "--output"
_ABOUT: Final = "README.txt"
_PRIVATE: Final = (
    "It has what an upgrade sent of its image, and names serial numbers of devices and files of "
    "this computer: send it only to whom you trust with these."
)
_EXAMPLES: Final = """\
examples:
  flasher bundle --last                            the latest failure, as flasher-....zip here
  flasher bundle --last --add flasher.log -o help.zip
  flasher bundle ~/.local/state/flasher/bundles/flasher-bms-20260105-101500

Passwords are not in a bundle, and this user's home folder is written as ~. The frames of an upgrade
are, with the bytes of its image, and so are serial numbers and file names. Nothing is sent.
"""


@dataclass(frozen=True)
class PackedFile:
    """File inside the packed one."""

    name: str
    size_bytes: int
    contents: str


@dataclass(frozen=True)
class PackedBundleDocument:
    """Result of `bundle`."""

    bundle: str
    """Folder of the bundle."""
    file: str
    files: list[PackedFile]


DOCUMENTS: Final = (PackedBundleDocument,)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.INTERRUPTED,))
@argument(
    "folder", required=False, type=values.FolderPath(), help="the folder of a bundle",
)  # fmt: skip
@option("--last", is_flag=True, brief=True, help="the bundle of the latest failed command")
@option(
    "--add", "added", metavar="FILE", multiple=True, type=values.FilePath(gives=Path), brief=True,
    help="one more file, such as the log of --log-file; may be repeated",
)  # fmt: skip
@option(
    "-o", _OUTPUT, "file", metavar="FILE", type=values.FilePath("zip", gives=Path), brief=True,
    help="(default: the bundle's name with .zip, in the working folder)",
)  # fmt: skip
@option("--force", is_flag=True, help="overwrite an older file")
def bundle(
    output: Output,
    *,
    folder: Path | None,
    last: bool,
    added: tuple[Path, ...],
    file: Path | None,
    force: bool,
) -> int:
    """Pack the bundle of a failed command into one file to send to whoever helps: the frames, the
    transcript, the circumstances, the story as a page, the latest upgrades from this computer, its
    adapters and versions.
    """
    source = find_source(folder, last=last)
    if not source.is_dir():
        raise UsageError(
            f"{printable(str(source))} is not the folder of a bundle.",
            remedy="Name the folder that the failed command has printed, or write --last.",
        )
    path = file or Path(f"{source.name}.zip")
    check_new(path, _OUTPUT, force=force)
    check_not_read(path, _OUTPUT, added)
    packed = [*_of_bundle(source), _history(), _computer(), *map(_of_user, added)]
    names = [name for name, *_ in packed]
    doubled = next((name for name in names if names.count(name) > 1), None)
    if doubled is not None:
        raise UsageError(
            f"Two files named {printable(Path(doubled).name)} are to be added.",
            remedy="Give one of them another name.",
        )
    listed = [PackedFile(name, len(data), what) for name, data, what in packed]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_ABOUT, _about(listed))
        for name, data, _ in packed:
            archive.writestr(name, data)
    write_whole(path, buffer.getvalue(), _OUTPUT, is_private=True)
    output.result(f"{printable(str(path))}, {byte_count(len(buffer.getvalue()))}, contains")
    output.table(((printable(each.name), each.contents) for each in listed), indent=2)
    output.result(_PRIVATE)
    return output.document(PackedBundleDocument(str(source), str(path), listed))


Packed = tuple[str, bytes, str]
"""Name, bytes and description of a file."""


def _of_bundle(source: Path) -> Iterator[Packed]:
    from flasher.report.explain_page import render  # noqa: PLC0415  loads jinja2
    from flasher.trace.bundle import OLDER_TRACE, REPORT, TRACE, TRANSCRIPT  # noqa: PLC0415
    from flasher.trace.source import explain_path  # noqa: PLC0415  loads python-can

    contents = {
        TRACE: "the last frames, for flasher explain, Wireshark and others",
        OLDER_TRACE: "the last frames, for flasher explain and can-utils",
        TRANSCRIPT: "the same frames, decoded",
        REPORT: "command line, error, plan, adapter and versions",
    }
    yield "story.html", _private(render(explain_path(source)).encode()), "verdict and diagrams"
    for name, what in contents.items():
        if (source / name).is_file():
            data = read(source / name, _ADDED_MAX)
            yield name, _private(data) if name == REPORT else data, what


def _history() -> Packed:
    flashes = FlashHistory().flashes()[0][-_FLASHES_PACKED:]
    text = json.dumps([as_json(each) for each in flashes], indent=2)
    what = f"the latest {len(flashes)} upgrades from this computer"
    return "history.json", _private(text.encode()), what


def _computer() -> Packed:
    from flasher.trace.bundle import versions  # noqa: PLC0415  loads python-can

    adapters = as_json(adapters_document(detect_adapters(), slcan_ports()))
    document = {"versions": versions(), **adapters}
    return "computer.json", json.dumps(document, indent=2).encode(), "adapters and versions now"


def _of_user(path: Path) -> Packed:
    return f"added/{path.name}", _private(read(path, _ADDED_MAX)), "added by --add"


def _private(data: bytes) -> bytes:
    """Replace the home folder, whose name is often the user's, in a text."""
    home = Path.home()
    is_text = b"\0" not in data
    has_name = home != Path(home.anchor)
    return data.replace(str(home).encode(), b"~") if is_text and has_name else data


def _about(files: list[PackedFile]) -> str:
    lines = ["flasher: what explains a failure. Begin with story.html.", "", _PRIVATE, ""]
    lines += [f"{each.name}: {each.contents}" for each in files]
    lines += ["", "`flasher explain FOLDER` reads the folder into which this file is extracted."]
    return "\n".join([*lines, ""])
