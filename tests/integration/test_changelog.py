"""Changes wait in changelog.d, in files that towncrier finds and CHANGELOG.md can take."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "changelog.d"
KINDS = ("added", "changed", "deprecated", "removed", "fixed")


def faults(name, text):
    """Sentences on what is wrong with a file of the folder; none if it is well named and written."""
    found = []
    if not re.fullmatch(rf"(\d+|\+[a-z0-9-]+)\.({'|'.join(KINDS)})(\.\d+)?\.md", name):
        found.append("is not named like 123.added.md or +canopy.fixed.md")
    if not text.strip().endswith((".", ")")) or "\n\n" in text.strip() or text.lstrip().startswith(("-", "#")):
        found.append("is not one paragraph of whole sentences")
    if missing := [link for link in re.findall(r"\]\((?!https?://)([^)#]+)", text) if not (ROOT / link).exists()]:
        found.append(f"links to {missing[0]}, which does not exist")
    return found


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [
        ("12.added.md", "A canopy slows the wind ([docs/wind.md](docs/wind.md)).", 0),
        ("12.added.1.md", "Another one of the same issue.", 0),
        ("+a-canopy.fixed.md", "A canopy no longer stops the wind.\n", 0),
        ("canopy.added.md", "A canopy slows the wind.", 1),
        ("12.feature.md", "A canopy slows the wind.", 1),
        ("12.added.rst", "A canopy slows the wind.", 1),
        ("12.added.md", "", 1),
        ("12.added.md", "- A canopy slows the wind.", 1),
        ("12.added.md", "A canopy.\n\nIt slows the wind.", 1),
        ("12.added.md", "A canopy ([page](docs/no_such_page.md)).", 1),
        ("canopy.md", "canopy", 2),
    ],
)
def test_a_file_that_cannot_be_taken_is_found(name, text, count):
    assert len(faults(name, text)) == count


def test_files_are_well_named_and_written():
    files = [path for path in FOLDER.iterdir() if path.name != "README.md"]
    assert {path.name: found for path in files if (found := faults(path.name, path.read_text("utf-8")))} == {}


def test_kinds_are_those_of_towncrier():
    project = pytest.importorskip("tomllib", reason="needs Python 3.11").loads(
        (ROOT / "pyproject.toml").read_text("utf-8")
    )
    towncrier = project["tool"]["towncrier"]
    assert tuple(kind["directory"] for kind in towncrier["type"]) == KINDS
    assert ROOT / towncrier["directory"] == FOLDER
    assert "<!-- towncrier release notes start -->\n" in (ROOT / towncrier["filename"]).read_text("utf-8")


def test_each_file_reaches_the_changelog():
    pytest.importorskip("towncrier")
    command = [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "9.8.7"]
    draft = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert draft.startswith("## [9.8.7] - ")
    for path in FOLDER.glob("*.*.md"):
        assert path.read_text("utf-8").split("\n")[0] in draft, path.name
