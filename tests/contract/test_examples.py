"""The examples run as they are, each to the check at its end."""

import ast
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*/*.py"))


def test_there_are_thirty_and_more_of_at_most_forty_lines_each_with_a_check_and_a_picture():
    assert len(EXAMPLES) >= 30
    docs = FOLDER.parent / "docs"
    gallery = (docs / "gallery.md").read_text(encoding="utf-8")
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 40, path.name
        assert any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(text))), path.name
        assert f"`{path.relative_to(FOLDER)}`" in gallery
        assert f"(pictures/examples/{path.stem}.webp)" in gallery
        assert (docs / f"pictures/examples/{path.stem}.webp").exists()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_to_its_check(path, tmp_path, monkeypatch):
    needed = {"sweep_to_dataset": "webdataset", "newton_cloth": "newton", "newton_mpm": "newton", "blender_mesh": "bpy"}
    if path.stem in needed:
        pytest.importorskip(needed[path.stem])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(path)])
    monkeypatch.syspath_prepend(str(path.parent))
    runpy.run_path(str(path), run_name="__main__")
