"""The command line of the converter."""

import importlib.util
from pathlib import Path

from gaussian_swaying.data.procedural import FlagScene
from gaussian_swaying.gaussians.ply import write_ply

ROOT = Path(__file__).parents[2]


def _main():
    specification = importlib.util.spec_from_file_location("export_tool", ROOT / "tools/export.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.main


def test_a_file_and_a_sentence(tmp_path, capsys):
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    target = tmp_path / "flag.splat"
    assert _main()([str(tmp_path / "flag.ply"), str(target)]) == 0
    assert target.stat().st_size == 96 * 32
    assert capsys.readouterr().out == f"wrote {target}\n"
    assert _main()([str(tmp_path / "none.ply"), str(target)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert "none.ply does not exist" in error
    assert error.count("\n") == 1
