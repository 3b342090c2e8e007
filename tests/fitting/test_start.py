"""A film that is still at first: the time at which the motion starts is one more unknown."""

import json
import shutil

import pytest
import torch

from gaussian_swaying.fitting.fit import Fit, fit
from gaussian_swaying.fitting.plan import Plan
from gaussian_swaying.fitting.unknowns import FILM_START, Unknown, default_scale
from gaussian_swaying.fitting.variants import states_of
from gaussian_swaying.fitting.videos import read_videos

from .conftest import TRUTH

pytest.importorskip("cv2", reason="needs the extra [fit]")

STILL = 4  # frames


@pytest.fixture
def late(own, tmp_path):
    """The video of the flag after some frames in which nothing moves."""
    folder = tmp_path / "late"
    shutil.copytree(own / "video", folder)
    file = folder / "transforms.json"
    frames = json.loads(file.read_text())["frames"]
    first = [frame for frame in frames if frame["time"] == 0]
    moved = [frame | {"time": frame["time"] + STILL / 24} for frame in frames]
    still = []
    for k in range(STILL):
        for frame in first:
            name = f"still{k}_{frame['file_path']}"
            shutil.copy(folder / frame["file_path"], folder / name)
            still.append(frame | {"file_path": name, "time": k / 24})
    file.write_text(json.dumps({"frames": [*still, *moved]}))
    return folder


def test_the_start_of_the_motion_is_found(own, late, tmp_path):
    sought = {"wind.speed": [2.0, 12.0], "material.E": [2e3, 5e4], FILM_START: [0.0, 0.4]}
    options = {"device": "cpu", "search": 16, "progress": False}
    result = fit(own / "base.yaml", late, sought, tmp_path / "fit", **options)
    assert result.values[FILM_START] == pytest.approx(STILL / 24, abs=0.004)
    assert result.values["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.02)
    assert result.values["material.E"] == pytest.approx(TRUTH["material.E"], rel=0.02)
    assert not result.notes
    assert FILM_START in (tmp_path / "fit/scene.yaml").read_text()


def test_a_start_that_is_missing_is_said(own, late, simulation):
    """And only there: the video that starts at once has no such note."""
    plan = Plan([str(own / "base.yaml")], [str(late)], [Unknown("wind.speed", 2.0, 12.0)])
    (note,) = Fit(simulation, read_videos(late), plan).notes()
    assert note.startswith("Nothing moves in the first 0.17 s of the film")
    assert "film.start: {range: [0, 0.4]}" in note
    assert Fit(simulation, read_videos(own / "video"), plan).notes() == []
    known = Plan(plan.base, plan.videos, [*plan.unknowns, Unknown(FILM_START, 0.0, 0.4)])
    assert Fit(simulation, read_videos(late), known).notes() == []


def test_variants_that_start_at_other_times(simulation):
    """Each is at rest until then, and moves as one that started at once."""
    times = [k / 24 for k in range(5)]
    early, late, between = zip(
        *states_of(simulation, [{}, {FILM_START: 2 / 24}, {FILM_START: 0.5 / 24}], times), strict=True
    )
    assert torch.equal(late[2].position, early[0].position)
    assert not torch.equal(between[1].position, early[0].position)
    moved = (early[4].position - early[0].position).norm(dim=-1).max()
    assert (late[4].position - early[2].position).norm(dim=-1).max() < 6e-3 * moved
    assert [float(state.time) for state in between] == pytest.approx([0, 0.5 / 24, 1.5 / 24, 2.5 / 24, 3.5 / 24])


def test_a_start_before_the_film_is_refused():
    assert default_scale(FILM_START, 0.1) == "linear"
    assert Unknown(FILM_START, 0.0, 1.0).unit == "s"
    with pytest.raises(ValueError, match=r"`unknowns.film.start.range` from 0 on, as the film begins at rest"):
        Unknown(FILM_START, -0.1, 1.0)
