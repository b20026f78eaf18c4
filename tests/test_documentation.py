"""What the documentation says of the code is true."""

from __future__ import annotations

import re
from pathlib import Path

from flasher.errors import ExitCode
from tests import diagram

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_state_diagrams_are_those_of_the_tables() -> None:
    drawn = "draw them anew: python -m tests.diagram"
    assert diagram.STATES.read_text(encoding="utf-8") == diagram.states_document(), drawn
    upgrade = diagram.UPGRADE.read_text(encoding="utf-8")
    assert "stateDiagram-v2" in upgrade
    assert diagram.upgrade_document(upgrade) == upgrade, drawn


def test_the_reference_lists_every_exit_code() -> None:
    page = (ROOT / "docs" / "reference" / "exit_codes.md").read_text(encoding="utf-8")
    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}
    assert listed == {int(code) for code in ExitCode}


def test_the_readme_is_read_in_three_minutes() -> None:
    assert len(README.encode()) <= 5 * 1024


def test_the_readme_opens_with_two_commands() -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert "flash firmware_samples/" in blocks[0]
    assert "--mock" in blocks[0]
    assert "pytest" in blocks[1]


def test_every_link_of_the_documentation_leads_somewhere() -> None:
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            name, _, anchor = link.partition("#")
            if "://" in name:
                continue
            target = (page.parent / name) if name else page
            assert target.exists(), f"{page}: {link}"
            if anchor and target.suffix == ".md":
                titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
                assert anchor in {_anchor(title) for title in titles}, f"{page}: {link}"


def _anchor(title: str) -> str:
    """As GitHub makes it of a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
