"""What the documentation says of the code is true."""

from __future__ import annotations

import re

from flasher.cli.main import COMMANDS
from flasher.errors import ExitCode
from tests import diagram

README = diagram.README.read_text(encoding="utf-8")


def test_the_state_diagrams_are_those_of_the_tables() -> None:
    drawn = "draw them anew: python -m tests.diagram"
    assert diagram.STATES.read_text(encoding="utf-8") == diagram.states_document(), drawn
    assert "stateDiagram-v2" in README
    assert diagram.readme_document(README) == README, drawn


def test_the_readme_lists_every_exit_code() -> None:
    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)}
    assert listed == {int(code) for code in ExitCode}


def test_the_readme_names_every_command() -> None:
    for command in COMMANDS:
        assert f"flasher {command}" in README


def test_the_readme_opens_with_two_commands() -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert "flash firmware_samples/" in blocks[0]
    assert "--mock" in blocks[0]
    assert "pytest" in blocks[1]
