"""``gaussian-swaying export --live-web``: what it writes, and what it says."""

import re

import pytest
from shared import refused

from gaussian_swaying.cli.export import main

SMALL = ["--scene.generator.init_args.spacing=0.05", "--solver.dx", "0.2", "--material.E=9e3"]


def test_a_page_from_the_name_of_a_configuration(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["--live-web", "flag", *SMALL]) == 0
    told = (
        r"2,344 Gaussians, \d+ material points\n"
        r"wrote flag\.html \(0\.\d MB\)\n"
    )
    assert re.fullmatch(told, capsys.readouterr().out)
    assert (tmp_path / "flag.html").read_text().startswith("<!doctype html>")
    fine = [SMALL[0], "--solver.dx=0.1", "--material.E=2e6"]
    assert main(["--live-web", "flag", "phone.html", "--target", "phone", *fine]) == 0
    told = capsys.readouterr().out
    assert re.match(r"Chose a grid of [\d.]+ m instead of 0\.1 m for a phone: \d+ points, real time expected\.\n", told)


def test_a_page_from_a_run(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text(
        "scene:\n  generator:\n    class_path: FlagScene\n    init_args: {spacing: 0.1}\nsolver: {dx: 0.3}\n"
    )
    assert main(["--live-web", str(run)]) == 0
    assert (run / "live.html").is_file()
    assert f"wrote {run / 'live.html'} (" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["flag", "page.txt"], "error: Expected the name of a page to end in .html, but got page.txt.\n"),
        ([], "error: Expected a SCENE, and perhaps a FILE that ends in .html, but got neither.\n"),
        (["sand"], "error: The page of --live-web cannot simulate `solver.formulation: updated`: set it to total.\n"),
        (["flag", "--config", "leaf"], "error: `SCENE` and `--config` both say what to show: leave out one of them"),
        (["a.yaml", "--config=b.yaml"], "error: `SCENE` and `--config` both say what to show: leave out one of them"),
        (["flag", "no/page.html"], "error: The folder no of the page does not exist: make it, or name another one.\n"),
        (["flog"], "flog does not exist"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    refused(main, ["--live-web", *arguments], capsys, sentence, folder=tmp_path)


def test_a_target_says_that_it_takes_the_points_of_the_grid(tmp_path, capsys):
    page = str(tmp_path / "page.html")
    assert main(["--live-web", "flag", page, "--target", "phone", *SMALL, "--scene.points", "gaussian"]) == 0
    assert " grid, with `scene.points: grid`, for a phone: " in capsys.readouterr().out
