"""``gaussian-swaying fit``: the one sentence it answers bad input with."""

import sys

import pytest
import yaml
from shared import refused

from gaussian_swaying.cli import shipped
from gaussian_swaying.cli.fit import main
from gaussian_swaying.inverse.plan import read_plan


def _file(path, **fields):
    start = {"base": "flag", "videos": str(path.parent / "video"), "unknowns": {"wind.speed": {"range": [1, 9]}}}
    path.write_text(yaml.safe_dump(start | fields))
    return str(path)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"base": "flga"}, "'flga' (did you mean flag?)"),
        ({"unknowns": {}}, "`unknowns`"),
        ({"unknowns": {"wind.speed": [1]}}, "`unknowns.wind.speed` to be {range: [low, high]}"),
        ({"unknowns": {"wind.sped": [1, 2]}}, "`wind.sped` cannot be sought"),
        ({"unknowns": {"wind.speed": {"range": [1, 2], "start": 3}}}, "`unknowns.wind.speed.start` within its range"),
        ({"known": {"material.EE": 3}}, "material.E"),
        ({"assumed": ["weight"]}, "'weight'"),
        ({"stages": ["tracks"]}, "`fit.stages` is gone"),
        ({"search": -1}, "`search`"),
        ({"steps": 3}, "unknown field `steps`"),
        ({}, "video does not exist"),
    ],
)
def test_bad_input(fields, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = _file(tmp_path / "fit.yaml", **fields)
    refused(main, ["--config", file], capsys, words, folder=tmp_path)


def test_without_opencv(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cv2", None)
    refused(main, ["--config", _file(tmp_path / "fit.yaml")], capsys, "pip install 'gaussian-swaying[fit]'")


def test_the_shipped_fit_is_a_plan():
    assert "printed_flag" in shipped.names("fit")
    file = shipped.with_shipped(["--config", "printed_flag"], "fit")[1]
    plan = read_plan(file, lambda name: shipped.with_shipped(["--config", name], "sim")[1])
    assert plan.unknowns[0].name == "wind.speed"


def test_paths_are_relative_to_the_file_that_names_them(tmp_path, monkeypatch):
    """Those of the base, of the videos and of what is known, from any working directory."""
    (tmp_path / "case/video").mkdir(parents=True)
    for name in ("base.yaml", "my.ply"):
        (tmp_path / "case" / name).write_text("frames: 3\n")
    file = _file(tmp_path / "case/fit.yaml", base="base.yaml", videos="video", known={"scene.ply": "my.ply"})
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    plan = read_plan(file)
    assert (*plan.base, *plan.videos, plan.known["scene.ply"]) == tuple(
        str(tmp_path / "case" / name) for name in ("base.yaml", "video", "my.ply")
    )
    missing = read_plan(_file(tmp_path / "case/fit.yaml", base="base.yaml", videos="film"))
    assert missing.videos == [str(tmp_path / "case/film")]
