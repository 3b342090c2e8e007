"""A film that is still at first or begins in motion: the time at which the motion starts is one more unknown."""

import json
from dataclasses import replace

import pytest
import torch
from shared import double, longest, peak
from small_films import TRUTH

from gaussian_swaying.inverse.fit import Problem
from gaussian_swaying.inverse.plan import FILM_START
from gaussian_swaying.inverse.registration import first_look
from gaussian_swaying.inverse.tracks import track
from gaussian_swaying.inverse.variants import compare, states_of
from gaussian_swaying.inverse.videos import read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")

STILL, CUT = 4, 3  # frames
SPEED, AZIMUTH = {"wind.speed": [2.0, 12.0]}, {"wind.azimuth": [-60.0, 150.0]}


def _later(own, folder, frames):
    """The video of the flag so many frames later, at rest until then; below 0, without its first frames."""
    found = []
    for frame in json.loads((own / "video/transforms.json").read_text())["frames"]:
        frame["file_path"] = str(own / "video" / frame["file_path"])
        first = 0 if frame["time"] == 0 else frames + round(24 * frame["time"])
        found += [frame | {"time": k / 24} for k in range(first, frames + round(24 * frame["time"]) + 1) if k >= 0]
    (folder / "transforms.json").write_text(json.dumps({"frames": found}))
    return folder


@pytest.fixture
def late(own, tmp_path_factory):
    return _later(own, tmp_path_factory.mktemp("late"), STILL)


@pytest.fixture
def cut(own, tmp_path_factory):
    return _later(own, tmp_path_factory.mktemp("cut"), -CUT)


def test_the_start_of_the_motion_is_found(late, fitted, tmp_path):
    result = fitted(SPEED | {"material.E": [2e3, 5e4], FILM_START: [0.0, 0.4]}, late, search=16)
    assert result.values[FILM_START] == pytest.approx(STILL / 24, abs=0.004)
    assert result.values["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.02)
    assert result.values["material.E"] == pytest.approx(TRUTH["material.E"], rel=0.02)
    assert not result.notes
    assert FILM_START in (tmp_path / "fit/scene.yaml").read_text()


def test_a_start_that_is_missing_is_said(late, fit_of):
    """And only there: the video that starts at once has no such note."""
    (note,) = fit_of(SPEED, late).notes()
    assert note.startswith("Nothing moves in the first 0.17 s of the film")
    assert "film.start: {range: [0, 0.4]}" in note
    assert fit_of(SPEED).notes() == fit_of(SPEED | {FILM_START: [0.0, 0.4]}, late).notes() == []


def test_variants_that_start_at_other_times(simulation):
    """Each is at rest until then, and moves as one that started at once."""
    times = [k / 24 for k in range(5)]
    early, late, between = zip(
        *states_of(simulation, [{}, {FILM_START: 2 / 24}, {FILM_START: 0.5 / 24}], times), strict=True
    )
    assert torch.equal(late[2].position, early[0].position)
    assert not torch.equal(between[1].position, early[0].position)
    moved = longest(early[4].position - early[0].position)
    assert longest(late[4].position - early[2].position) < 6e-3 * moved
    assert [float(state.time) for state in between] == pytest.approx([0, 0.5 / 24, 1.5 / 24, 2.5 / 24, 3.5 / 24])


def test_a_film_that_begins_in_motion(cut, fitted, tmp_path):
    """The wind has blown for some frames; how long is found with the rest, and the note says that it is needed."""
    result = fitted(SPEED | {"material.E": [2e3, 5e4], FILM_START: [-0.4, 0.2]}, cut, search=16, until=0.3)
    assert result.values[FILM_START] == pytest.approx(-CUT / 24, abs=0.004)
    assert result.values["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.02)
    assert result.values["material.E"] == pytest.approx(TRUTH["material.E"], rel=0.03)
    assert json.loads((tmp_path / "fit/fit.json").read_text())["course"]["first"]


def test_rivals_of_a_film_in_motion_are_judged_by_the_points_of_their_own_first_frames(cut, fit_of, monkeypatch):
    """Points that are followed from where a wrong wind has them speak for that wind."""
    made = fit_of(AZIMUTH | {FILM_START: [-0.2, 0.0]}, cut, search=0, iterations=1)
    sought = made.plan.unknowns
    wrong = [sought[0].share(90.0), sought[1].share(-CUT / 24)]
    true = [sought[0].share(TRUTH["wind.azimuth"]), wrong[1]]
    begun, seen = Problem.begin_at, []

    def begin_at(self, first):
        seen.append(list(first))
        begun(self, first)

    monkeypatch.setattr(Problem, "begin_at", begin_at)
    made.begin_at(wrong)
    monkeypatch.setattr("gaussian_swaying.inverse.fit.BRIEF", 0)  # where they are, not where they would go
    best, other = made._brief([wrong, true], None, made.fitted)
    assert seen == [wrong, wrong, true]
    assert (best[1], other[1]) == (true, wrong)
    assert other[0] > 3 * best[0]
    assert made.first == wrong


@pytest.mark.parametrize("ends", [(-0.2, 0.0), (-0.2, 0.1), (-0.2, -0.05)])
def test_the_place_that_a_film_in_motion_begins_from(cut, fit_of, ends):
    """The wind whose simulation looks most like the first frame, and when it was so; not another wind's, nor rest."""
    made = fit_of(AZIMUTH | {FILM_START: ends}, cut)
    winds = (110.0, TRUTH["wind.azimuth"], -50.0)
    places = double([[made.plan.unknowns[0].share(wind), 0.5] for wind in winds])
    azimuth, start = made.values(made.begin_from(places)).values()
    assert azimuth == pytest.approx(TRUTH["wind.azimuth"])
    assert start == pytest.approx(-CUT / 24, abs=0.05)


def test_a_film_in_motion_is_said(cut, simulation):
    """And nothing once the unknown is there."""
    left, _ = read_videos(cut)
    (note,) = first_look(simulation, left, None)
    assert note.endswith("film.start: {range: [-1, 0]} to `unknowns`, or give a film that begins at rest.")
    assert first_look(simulation, left, -0.4) == []


def test_variants_that_started_before_the_film(simulation):
    times = [k / 24 for k in range(3)]
    now, before = zip(*states_of(simulation, [{}, {FILM_START: -2 / 24}], times), strict=True)
    assert torch.equal(before[0].position, now[2].position)
    assert [float(state.time) for state in before] == pytest.approx([2 / 24, 3 / 24, 4 / 24])


def test_starts_that_are_compared_at_once(own, simulation):
    """One simulation shows what any start would: as simulations of each start do."""
    (video, _) = read_videos(own / "video")
    evidence = [track(simulation, video)]
    times, starts = list(video.times[:5]), [-2 / 24, 0.0, 1 / 24]
    together = compare(evidence, [{"wind.speed": 4.0}], times, True, starts=starts)
    apart = [{"wind.speed": 4.0, FILM_START: start} for start in starts]
    (block,) = compare(evidence, apart, times, moving=True)
    for number, own_block in enumerate(together):
        assert own_block.values[0].shape == block.values[number].shape
        assert peak(own_block.values[0] - block.values[number]) < 0.02  # other steps
    assert peak(together[0].values - together[1].values) > 1


def test_gaussians_that_look_otherwise_are_not_seen(own, simulation):
    """The picture of one state is followed to that of another; far from it, nothing that is found is trusted."""
    (video, _) = read_videos(own / "video")
    near = track(simulation, video, first=simulation.scene.rest())
    assert near.seen[0].float().mean() > 0.8
    blank = replace(video, images=torch.full_like(video.images, 128))
    assert not track(simulation, blank, first=simulation.scene.rest()).seen[0].any()
