"""What --json prints is what docs/reference/schema.json says, for every command, also a failure."""

from __future__ import annotations

import json
import signal
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final, get_args, get_origin, get_type_hints

import pytest

from flasher import events
from flasher.cli.documents import to_json
from flasher.cli.main import COMMANDS
from flasher.cli.output import Output
from flasher.protocol.contents import UserString
from flasher.protocol.fields import WireText
from tests import schema_document
from tests.cli.conftest import SAMPLES, Flasher
from tests.schema import command_modules, event_classes

MOCK = ("-t", "bms", "--mock", "--mock-speed", "0")
OBC = SAMPLES / "obc.bin"
BOOTLOADER = "tests.peers.python_bootloader:PythonBootloader"


def hold(schema: Mapping[str, Any], name: str, instance: object) -> None:
    """Fails where the instance is not what the definition describes."""
    chosen = {"$defs": schema["$defs"], "$ref": f"#/$defs/{name}"}
    assert not schema_document.mismatches(instance, chosen)


def hold_output(schema: Mapping[str, Any], text: str, code: int) -> list[dict[str, Any]]:
    """Every line is described: the last as the command's document, the others by their event."""
    *lines, document = [json.loads(line) for line in text.splitlines()]
    for line in lines:
        hold(schema, f"line.{line['event']}", line)
    hold(schema, f"document.{document['command'] or 'none'}", document)
    assert document["exit_code"] == code
    assert document["ok"] == (code == 0)
    return lines


# -- the file --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_file_is_drawn_from_the_code() -> None:
    written = schema_document.SCHEMA.read_text(encoding="utf-8")
    drawn = schema_document.schema_document()
    assert json.loads(written) == json.loads(drawn), "draw it anew: python -m tests.schema_document"
    assert written == drawn, "draw it anew: python -m tests.schema_document"


@pytest.mark.slow
def test_it_is_a_json_schema(schema: dict[str, Any]) -> None:
    checker = schema_document.validator(schema)
    checker.check_schema(schema)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_every_command_describes_its_documents() -> None:
    for command, module in command_modules().items():
        assert getattr(module, "DOCUMENTS", ()), f"{command}: DOCUMENTS is missing"


def test_every_class_and_field_that_is_described_states_what_it_is(schema: dict[str, Any]) -> None:
    for name, definition in schema["$defs"].items():
        for form in definition.get("anyOf", [definition]):
            assert form["description"], name


def test_every_command_has_its_definition(schema: dict[str, Any]) -> None:
    names = {f"document.{command}" for command in (*COMMANDS, "none")}
    assert names <= schema["$defs"].keys()


# -- real output -----------------------------------------------------------------------------------


COMMAND_LINES: Final[tuple[tuple[str | Path, ...], ...]] = (
        ("image-info", SAMPLES / "wmc.hex"),
        ("image-info", SAMPLES / "wmc.hex", OBC),
        ("image", "info", OBC),
        ("image", "convert", SAMPLES / "wmc.hex", "-o", Path("wmc.s19")),
        ("image", "merge", SAMPLES / "wmc.hex", f"{OBC}@0x8010000", "-o", Path("both.hex")),
        ("acceptance", OBC, "-t", "obc", *MOCK[2:], "--yes", "--interrupt", "-o", Path("a.html")),
        ("help", "E402"),
        ("image-info", OBC),
        ("flash", OBC, "-t", "obc", "--dry-run"),
        ("flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0", "--events"),
        ("flash", "--bike", Path("bike.toml"), "--mock", "--mock-speed", "0", "--events"),
        ("simulate", "replay", "job packets=3 ; mock"),
        ("history",),
        ("info", *MOCK),
        ("info", "-t", "wmc", "--mock", "--mock-speed", "0"),
        ("scan", "--mock", "--mock-speed", "0"),
        ("verify", Path("nameless.bin"), "--level", "version", *MOCK),
        ("read", "history", *MOCK),
        ("read", "serial-number", *MOCK),
        ("read", "memory", "0x8008000", "0x8008020", *MOCK, "--events"),
        ("read", "--list"),
        ("write", "user-string-1", "RACK 7", "--yes", *MOCK),
        ("backup", "-o", Path("b.zip"), "--force", *MOCK),
        ("backup", "restore", Path("kept.zip"), "--force", "--yes", "--mock", "--mock-speed", "0"),
        ("write", "--list"),
        ("monitor", "--mock", "--mock-speed", "0", "--duration", "3", "--raw"),
        ("profile", "show", "-t", "bms"),
        ("profile", "check", Path("right.toml")),
        ("rescue", OBC, "-t", "obc", "--mock", "--mock-speed", "0", "--events"),
        ("adapters",),
        ("ui", "--mock", "--mock-speed", "0"),
        ("doctor", "--mock", "--listen", "0.1", "--mock-speed", "0"),
        ("doctor", *MOCK[2:], "--throughput"),
        ("manifest", "create", Path("image.bin"), "-t", "obc"),
        ("manifest", "check", Path("stated.bin"), "-t", "obc"),
        ("trust", "show"),
        ("plant", "init", "--database", "postgresql://x@h/plant", "--station", "line-2", "--print"),
        ("release", "build", Path("bike.wfw"), "--image", "obc=stated.bin", "--product", "X",
         "--counter", "1"),
        ("explain", Path("upgrade.log")),
        ("explain", Path("nothing.log")),
        ("bundle", Path("failed"), "-o", Path("help.zip")),
        ("export", "wireshark", "-o", Path("welling.lua")),
        ("export", "csv", Path("upgrade.log"), "-o", Path("upgrade.csv")),
        ("export", "trace", Path("upgrade.log"), "-o", Path("upgrade.pcapng")),
        ("mock", "-t", "bms", "-i", "virtual", "-c", "schema"),
        ("conformance", "serve", "-t", "bms", "--subject", BOOTLOADER, "-i", "virtual", "-c", "s"),
        ("conformance", "-t", "bms", "--mock", "--case", "RS-01", "--case", "EN-04"),
        ("conformance", "explore", "-t", "bms", "--mock", "--runs", "1", "--jobs", "1"),
        ("conformance", "--list"),
        ("conformance", "profile"),
        ("station", "check", SAMPLES / "station" / "recipe.toml"),
)  # fmt: skip


def _press_ctrl_c(_address: str) -> bool:
    signal.raise_signal(signal.SIGINT)
    return True


@pytest.fixture
def files(flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: Any) -> None:
    """The files that some of the command lines name, in the working directory; a mock that sees
    one event of each kind and ends; no browser, and Ctrl-C in its place.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", _press_ctrl_c)
    named = {str(word) for word in request.getfixturevalue("words")}
    with zipfile.ZipFile("kept.zip", "w") as kept:
        items = {"check-code": {"check_code": "00112233445566778899AABB"}}
        inside = {"format": 1, "info": {"target": "bms", "items": items}}
        kept.writestr("backup.json", json.dumps(inside))
    Path("bike.toml").write_text(f"[[target]]\ntarget = 'obc'\nimage = '{OBC}'\n", "utf-8")
    Path("right.toml").write_text("attempts = 5\n", "utf-8")
    Path("nothing.log").write_text("(1.0) can0 123#616263\n", "utf-8")
    Path("nameless.bin").write_bytes(bytes(300))
    Path("failed").mkdir()
    Path("failed/trace.log").write_text("(1.0) can0 123#616263\n", "utf-8")
    for name in ("image.bin", "stated.bin"):
        Path(name).write_bytes(OBC.read_bytes())
    if "stated.bin" in named:
        assert flasher("manifest", "create", "stated.bin", "-t", "obc").code == 0
    if "upgrade.log" in named:
        words = ("flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0")
        assert flasher(*words, "--trace-file", "upgrade.log").code == 0

    def drive(*_: object, on_event: Callable[[object], None], **_more: object) -> None:
        for event in (*map(make, event_classes()), events.PacketStored(1, 9)):
            on_event(event)

    monkeypatch.setattr("flasher.cli.bench.serving.drive", drive)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    COMMAND_LINES,
    ids=lambda words: " ".join(map(str, words)).replace(str(SAMPLES), ""),
)
@pytest.mark.usefixtures("files")
def test_what_commands_print_is_as_described(
    flasher: Flasher, schema: dict[str, Any], words: tuple[str | Path, ...]
) -> None:
    run = flasher(*words, "--json")
    assert run.code == 0
    lines = hold_output(schema, run.out, 0)
    always = {"monitor", "mock", "ui", "serve"}.intersection(map(str, words))
    assert bool(lines) == ("--events" in words or bool(always))


def test_every_command_is_among_them() -> None:
    assert {words[0] for words in COMMAND_LINES} == COMMANDS.keys()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ((), 2),
        (("--nonsense",), 2),
        (("flash",), 2),
        (("scan", "--events", "--nonsense"), 2),
        (("image-info", SAMPLES / "bad" / "no_end.hex"), 3),
        (("flash", SAMPLES / "bad" / "no_end.hex", "-t", "bms"), 3),
        (("info", "-t", "bms", "-i", "socketcan", "-c", "no-such-interface"), 4),
        (("write", "user-string-1", "x"), 2),
        (("profile", "check", "no-such-file.toml"), 2),
        (("monitor", "no-such-file.asc"), 2),
    ],
    ids=lambda given: (
        " ".join(map(str, given)).replace(str(SAMPLES), "")
        if isinstance(given, tuple)
        else str(given)
    ),
)
def test_failures_are_as_described(
    flasher: Flasher, schema: dict[str, Any], words: tuple[str | Path, ...], code: int
) -> None:
    run = flasher("--json", *words)
    if words:
        assert run.code == code
        assert hold_output(schema, run.out, code) == []
        assert run.document["error"]["what"]


def test_a_trace_with_everything_in_it_is_as_described(
    flasher: Flasher, schema: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "bus.log"
    path.write_text(
        "(1.0) can0 123#616263\n(1.1) can0 12345678#00\n(1.2) can0 725#55AA0C\n", "utf-8"
    )
    lines = hold_output(schema, flasher("monitor", path, "--json", "--raw").out, 0)
    assert {line["kind"] for line in lines} >= {"frame", "foreign", "damaged"}


def test_a_refused_write_states_that_nothing_was_written(
    flasher: Flasher, schema: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.terminal.can_ask", lambda: True)
    monkeypatch.setattr("flasher.cli.look.write.agrees", lambda _question, **_: False)
    run = flasher("write", "user-string-1", "x", *MOCK, "--json")
    hold_output(schema, run.out, 130)
    assert run.document["written"] is False


def test_a_bug_is_a_document_too(
    flasher: Flasher, schema: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> int:
        raise RuntimeError("boom")

    monkeypatch.setattr("flasher.cli.upgrade.image_info.vector_table", fail)
    hold_output(schema, flasher("image-info", OBC, "--json").out, 1)


@pytest.mark.parametrize(
    "wrong",
    [
        {"exit_code": 17},
        {"schema": 1},
        {"command": "scan"},
        {"surplus": 1},
        {"plan": {}},
    ],
)
def test_the_schema_refuses_what_is_not_printed(
    flasher: Flasher, schema: dict[str, Any], wrong: dict[str, Any]
) -> None:
    document = flasher("image-info", OBC, "--json").document
    hold(schema, "document.image-info", document)
    with pytest.raises(AssertionError):
        hold(schema, "document.image-info", {**document, **wrong})


# -- events ----------------------------------------------------------------------------------------


def sample(hint: Any) -> Any:
    """Some value of the type that a field of an event has."""
    if isinstance(hint, type) and issubclass(hint, Enum):
        return list(hint)[-1]
    if get_origin(hint) is tuple:
        return (sample(get_args(hint)[0]),) * 2
    if type(None) in get_args(hint):
        return sample(get_args(hint)[0])
    if is_dataclass(hint):
        return make(hint)
    if hint is object:
        return UserString(WireText(b"a\x1b"))
    return {int: 7, float: 0.5, bool: True, str: "text", bytes: b"\x00\xff"}[hint]


def make(event: Any) -> Any:
    """An event of a class."""
    return event(**{name: sample(hint) for name, hint in get_type_hints(event).items()})


@pytest.mark.parametrize("event", event_classes(), ids=lambda event: event.__name__)
def test_every_event_is_as_described(
    schema: dict[str, Any], event: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    output = Output(json_wanted=True)
    output.event(make(event))
    assert capsys.readouterr().out == "", "events are printed only when they are asked for"
    output.events_wanted = True
    output.event(make(event))
    line = json.loads(capsys.readouterr().out)
    hold(schema, f"line.{event.__name__}", line)
    assert line.keys() == {"schema", "event", *get_type_hints(event)}


def test_an_event_as_json_has_names_for_choices_and_hexadecimal_for_bytes() -> None:
    assert to_json(events.PhaseEntered(events.Phase.TRANSFER, 2)) == {
        "event": "PhaseEntered",
        "phase": "transfer",
        "attempt": 2,
    }
    damaged = to_json(events.BytesDamaged(0x725, "cut short", b"\x55\xaa"))
    assert (damaged["data"], damaged["can_id"]) == ("55aa", 0x725)
    assert to_json(events.ShutdownEnded(("WMC",), ()))["ready"] == ["WMC"]


def test_events_need_json(flasher: Flasher) -> None:
    run = flasher("scan", "--mock", "--events")
    assert run.code == 2
    assert "--events needs --json" in run.err
