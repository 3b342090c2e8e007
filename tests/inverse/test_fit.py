"""Whole fits of a small flag: own data with noise, stopped and continued, and refused where hopeless."""

import json
import math
import shutil
import time
from dataclasses import replace

import pytest
import yaml
from shared import double, value_error
from small_films import TRUTH, changed

import gaussian_swaying.inverse.fit as module
from gaussian_swaying.cli.fit import main
from gaussian_swaying.inverse.fit import GRIDS, Problem, Say, run_fit
from gaussian_swaying.inverse.variants import HELD
from gaussian_swaying.inverse.videos import read_videos
from gaussian_swaying.simulation.simulation import Simulation

pytest.importorskip("cv2", reason="needs the extra [fit]")


class Said(Say):
    """Keeps the lines in a list."""

    def __init__(self, lines):
        super().__init__(False)
        self.lines = lines

    def __call__(self, line):
        self.lines.append(line)


SPEED, AZIMUTH = {"wind.speed": [2.0, 12.0]}, {"wind.azimuth": [-20.0, 100.0]}


def test_starts_that_are_far_off(fitted, tmp_path, capsys):
    """Three times the speed and 60 degrees off: other starts are tried as well, and the best goes on."""
    sought = {
        "wind.speed": {"range": [1.0, 20.0], "start": 15.0},
        "wind.azimuth": {"range": [-60.0, 140.0], "start": 97.0},
        "material.E": {"range": [2e3, 5e4], "start": 3e4},
    }
    result = fitted(sought, search=16, progress=True)
    assert result.values["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.01)
    assert result.values["wind.azimuth"] == pytest.approx(TRUTH["wind.azimuth"], abs=1.0)
    assert "] start to " in capsys.readouterr().err
    course = json.loads((tmp_path / "fit/fit.json").read_text())["course"]
    assert len(course["starts"]) > 1
    assert [len(place) for place in course["rivals"]] == [3] * len(course["rivals"])


def test_the_search_finds_the_stiffness_although_its_start_is_three_times_off(fit_of):
    """The start stays the first, and is not the best."""
    sought = {"wind.speed": {"range": [1.0, 20.0], "start": 15.0}, "material.E": {"range": [1e3, 1e5], "start": 3e4}}
    made = fit_of(sought, search=16)
    begin, best, *_ = (made.values(place) for place in made.search())
    assert begin == pytest.approx({"wind.speed": 15.0, "material.E": 3e4})
    assert best["material.E"] == pytest.approx(TRUTH["material.E"], rel=0.6)
    assert best["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.3)


def test_another_end_that_fits_as_well_is_a_rival(fit_of):
    """And one that is the same, or fits worse, is none."""
    made = fit_of(SPEED)
    here, near, far = [0.5], [0.51], [0.9]

    def others(*ended):
        made._brief = lambda places, evidence, times: [(cost, end) for end, cost in ended]
        return made.others(here, [far])

    assert others((here, 1.0), (far, 1.04)) == [made.values(far)]
    assert others((here, 1.0), (far, 1.09)) == []
    assert others((far, 1.0), (here, 1.01)) == [made.values(far)]
    assert others((far, 1.0), (near, 1.3)) == [made.values(far)]
    assert others((near, 1.0)) == []
    assert made.others(here, []) == []  # nothing else is tried


def test_rivals_are_told(fit_of):
    made = fit_of(SPEED, search=0, iterations=1, tracks=40)
    made.others = lambda place, rivals: [{"wind.speed": 9.0}]
    assert made.run({}, lambda: None).rivals == [{"wind.speed": 9.0}]


def test_a_drag_that_is_sought_with_the_speed_is_remarked_on(fit_of):
    drag = {"aero.C_D": [0.02, 0.5]}
    (note,) = fit_of(SPEED | drag).notes()
    assert note.startswith("wind.speed and aero.C_D move the object in nearly the same way")
    assert fit_of(drag).notes() == []
    (note,) = fit_of(drag, assumed=["mass", "camera"]).notes()
    assert "The camera was found from a frame in which the object may move already" in note


def test_some_tracks_are_held_out_and_judge_the_fit(fit_of):
    made = fit_of(SPEED)
    (first, _) = made.evidence()
    (all_of_it, _) = made.tracks
    held = all_of_it.seen[0] & ~first.seen[0]
    assert 0.1 <= held.sum() / all_of_it.seen[0].sum() <= 0.2
    assert (all_of_it.index[held] % HELD == 0).all()


def test_the_error_of_the_grid_is_in_the_standard_errors(own, simulation, fit_of):
    """None if the other grids show the same; if they show the flag in another wind, as far off as that wind."""
    made = fit_of(SPEED)
    evidence = made.evidence()
    place = double([made.plan.unknowns[0].share(5.0)])
    place = made.solved(place.tolist(), evidence, made.fitted, 24, True).place

    def model(other):
        made.grids = [other] * len(GRIDS)
        return float(made.grid_covariance(place, evidence))

    assert model(simulation) ** 0.5 < 5e-3
    denser = changed(own, material={"density": 27.0})
    share = math.log((27 / 25) ** 0.5) / math.log(6)  # the pressure of a faster wind for the mass
    assert model(denser) ** 0.5 == pytest.approx(math.sqrt(len(GRIDS)) * share, rel=0.6)


def test_a_fit_that_cannot_follow_has_failed(fitted, tmp_path):
    """The wind is sought on the wrong side only; the pictures alone would hardly tell."""
    result = fitted({"wind.azimuth": [-100.0, -60.0], "material.E": [2e3, 5e4]}, search=8)
    assert result.verdict == "failed"
    assert max(result.followed.values()) < 0.5
    data = json.loads((tmp_path / "fit/result.json").read_text())
    assert data["verdict"] == "failed"
    assert "of the motion of its tracks" in data["why"][0]
    assert data["motion_explained"] == result.followed


@pytest.mark.slow
def test_stopped_and_continued(fit_of, tmp_path):
    """A fit that is stopped after some iterations and continued ends where an undisturbed one does, bit for bit."""
    coarser = changed(tmp_path, solver={"dx": 0.125})

    def made():
        return fit_of(SPEED | AZIMUTH, search=8, iterations=2, tracks=40, further={"grids": [coarser] * len(GRIDS)})

    whole = made().run({}, lambda: None)

    class StopError(Exception):
        pass

    seen = []

    def keep():
        seen.append(json.loads(json.dumps(course)))
        if len(seen) in (1, 4, 7):
            raise StopError

    course, stops = {}, 0
    while True:
        try:
            result = made().run(course, keep)
            break
        except StopError:
            course, stops = seen[-1], stops + 1
    assert stops == 3
    assert result.place == whole.place
    assert [row["cost"] for row in result.history] == [row["cost"] for row in whole.history]


@pytest.mark.parametrize("where", ["search", "best_of", "others"])
def test_a_fit_that_is_stopped_says_how_it_goes_on_and_does(own, tmp_path, capsys, monkeypatch, where, brief):
    """Also in the search, before the first step, and at the end."""
    plan = {"base": str(own / "base.yaml"), "videos": str(own / "video"), "unknowns": {"wind.speed": [2.0, 12.0]}}
    small = {"search": 3, "iterations": 1, "tracks": 40, "until": 0.2}
    (tmp_path / "fit.yaml").write_text(yaml.safe_dump(plan | small))
    words = ["--config", str(tmp_path / "fit.yaml"), "--output", str(tmp_path / "fit"), "--device", "cpu"]

    def stopped(*given):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Problem, where, stopped)
        assert main(words) == 130
    told = capsys.readouterr().err
    assert "All steps that were done are kept. To continue:" in told
    assert told.rstrip().endswith("--resume")
    assert main([*words, "--resume"]) == 0
    again = capsys.readouterr()
    assert "wind.speed" in again.out
    assert ("] search: wind.speed" in again.err) == (where != "others")


def test_what_a_fit_takes_is_said_before_it_starts_and_then_what_is_left(fitted, capsys, brief):
    fitted(SPEED, search=4, iterations=1, tracks=40, progress=True)
    told = capsys.readouterr().err
    for words in ("simulations of 0.208 s: some ", "search:", "frame/s]"):
        assert words in told
    assert told.index("simulations of 0.208 s") < told.index("search:")
    assert "coarser grid" not in told


def test_the_time_of_a_fit_is_that_of_all_of_it(fitted, monkeypatch, brief):
    """By a clock on which films take 1000 s to prepare, and 1000 s to compare with the result."""
    late, now = [0.0], time.monotonic
    monkeypatch.setattr("gaussian_swaying.inverse.fit.time.monotonic", lambda: now() + late[0])

    def slow(name):
        known = getattr(module, name)

        def later(*given):
            late[0] += 1000.0
            return known(*given)

        monkeypatch.setattr(module, name, later)

    slow("prepared")
    slow("write_films")
    result = fitted(SPEED, search=0, iterations=1, tracks=40)
    assert result.seconds > 2000.0


def test_a_coarser_grid_is_proposed_where_a_fit_takes_long(fit_of, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.inverse.fit.LONG", 0.0)
    assert fit_of(SPEED).expected().endswith("less than half of it on a coarser grid (`known: {solver.dx: 0.13}`)")


def test_resume_needs_the_same_plan(plan_of, tmp_path, brief):
    plan = plan_of(SPEED, tracks=40, search=0, iterations=1)
    with value_error("nothing to resume"):
        run_fit(plan, tmp_path / "fit", resume=True, device="cpu", progress=False)
    first = run_fit(plan, tmp_path / "fit", device="cpu", progress=False)
    again = run_fit(plan, tmp_path / "fit", resume=True, device="cpu", progress=False)
    assert again.place == first.place
    with value_error("another `tracks`"):
        run_fit(replace(plan, tracks=50), tmp_path / "fit", resume=True, device="cpu", progress=False)


def test_an_earlier_fit_beside_what_is_needed_is_not_moved(own, plan_of, tmp_path):
    """Or the base would be gone, and the third time there is none."""
    shutil.copy(own / "base.yaml", tmp_path / "base.yaml")
    other = plan_of(SPEED, search=0, iterations=1, tracks=40)
    plan = replace(other, base=[str(tmp_path / "base.yaml")])
    run_fit(plan, tmp_path, device="cpu", progress=False)
    with value_error(r"base\.yaml is in it and is needed now: choose another with --output"):
        run_fit(plan, tmp_path, device="cpu", progress=False)
    assert (tmp_path / "base.yaml").exists()
    with value_error(r"base\.yaml is in it"):
        run_fit(other, tmp_path, device="cpu", progress=False, in_use=[tmp_path / "base.yaml"])


def test_another_grid_that_the_scene_refuses_is_left_out_and_said(simulation, monkeypatch):
    asked, said = [], []

    def on_grid(self, ratio):
        asked.append(ratio)
        if ratio < 1:
            raise ValueError("`solver.dx` is too small.")
        return simulation

    monkeypatch.setattr(Simulation, "on_grid", on_grid)
    assert module._other_grids(simulation, Said(said)) == [simulation]
    assert asked == list(GRIDS)
    assert said == [
        "cells 0.8 times as large, to know the error of the grid, are not possible: `solver.dx` is too small."
    ]


def test_cameras_begin_together(own, fit_of):
    """Unless nothing moves until then."""
    left, right = read_videos(own / "video")
    cut = replace(right, **{name: getattr(right, name)[5:] for name in ("times", "cameras", "images")})
    with value_error(r"camera right begin at 0\.208 s.*cut all videos to the same beginning"):
        fit_of(SPEED, videos=[left, cut])
    assert fit_of(SPEED | {"film.start": [0.25, 0.5]}, videos=[left, cut]).videos
    shift = tuple(time + 0.03 for time in right.times)  # by less than a frame
    assert fit_of(SPEED, videos=[left, replace(right, times=shift)]).videos


def test_what_cannot_be_told_apart_is_refused(fitted, tmp_path):
    """A membrane has E times thickness and density times thickness, and nothing that tells the three."""
    sought = {"material.E": [2e3, 5e4], "material.density": [5, 100], "material.thickness": [0.002, 0.05]}
    limit = 100.0  # the weakest direction is noise, a two hundredth of the strongest or less
    with value_error("cannot tell") as error:
        fitted(sought, search=0, limit=limit)
    for name in sought:
        assert f"`{name}`" in str(error.value)
    assert [path.name for path in (tmp_path / "fit").iterdir()] == ["before"]  # pictures, which may tell why
