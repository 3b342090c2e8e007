import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "changelog.d"


def test_each_file_reaches_the_changelog():
    pytest.importorskip("towncrier")
    command = [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "9.8.7"]
    draft = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert draft.startswith("## [9.8.7] - ")
    for path in FOLDER.glob("*.*.md"):
        assert path.read_text("utf-8").split("\n")[0] in draft, path.name
