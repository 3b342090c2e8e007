"""A wind that changes during a film: its speed and azimuth at a few times, taken where they predict better."""

import json
import math

import pytest
import torch
import yaml
from bench.problems.films import write_video
from shared import near, peak, value_error
from small_films import TRUTH, cameras, changed

from gaussian_swaying.inverse.unknowns import (
    FILM_START,
    KNOTS,
    WALK,
    Plan,
    Unknown,
    changes_of,
    knots_of,
    prior_of,
    read_plan,
    states_of,
    steady_share,
)
from gaussian_swaying.simulation.simulation import Simulation

SPEED, AZIMUTH = Unknown("wind.speed", 2.0, 12.0, "log"), Unknown("wind.azimuth", -20.0, 100.0)


def test_the_unknowns_of_a_wind_that_changes():
    """The azimuth changes only where it is sought; in the middle of their ranges nothing changes."""
    names = [u.name for u in changes_of([SPEED, AZIMUTH], 0.6)]
    assert names == [f"wind.{kind}@{time}" for kind in ("speed", "azimuth") for time in ("0.2", "0.4", "0.6")]
    assert [u.name for u in changes_of([SPEED], 0.6)] == names[:KNOTS]
    assert [u.name.split("@")[1] for u in changes_of([SPEED], 2.8)] == ["0.4", "0.8", "1.2", "1.6", "2", "2.4", "2.8"]
    assert [u.value(steady_share(u)) for u in changes_of([SPEED, AZIMUTH], 0.6)] == pytest.approx([1] * 3 + [0] * 3)
    assert {u.unit for u in changes_of([SPEED, AZIMUTH], 0.6)} == {"", "degrees"}


def test_flows_at_the_times():
    times, flows = knots_of([3.0, 0.0, 0.0], {"wind.speed@0.5": 2.0, "wind.azimuth@1": 90.0, "wind.azimuth@0.5": 0.0})
    assert times == [0.0, 0.5, 1.0]
    assert [part for flow in flows for part in flow] == pytest.approx([3, 0, 0, 6, 0, 0, 0, 3, 0])


def test_the_prior_is_a_random_walk():
    unknowns = [SPEED, *changes_of([SPEED], 0.75)]
    places = torch.tensor([[0.3, *(u.share(value) for u, value in zip(unknowns[1:], (1.0, 2.0, 2.0), strict=True))]])
    found = prior_of(unknowns, places)
    assert found.shape == (1, KNOTS, 1)
    step = math.log(2) / (WALK["wind.speed@"] * 0.5)
    assert found.flatten().tolist() == pytest.approx([0, step, 0], abs=1e-6)
    assert prior_of([SPEED, AZIMUTH], places[:, :2]) is None


def test_variants_in_winds_that_change(own, simulation):
    """As a simulation with a schedule, side by side, and later if the motion begins later."""
    changes = {"wind.speed@0.1": 2.0, "wind.azimuth@0.1": 30.0}
    times, flows = knots_of([4.0, 3.0, 0.0], changes)
    schedule = [{"time": time, "flow": flow} for time, flow in zip(times, flows, strict=True)]
    other = changed(own, wind={"flow": None, "schedule": schedule, "interpolation": "linear"})
    frames = [k / 24 for k in range(4)]
    values = [{}, changes, changes | {FILM_START: -1 / 24}]
    steady, found, before = zip(*states_of(simulation, values, frames, alike=False), strict=True)
    (expected,) = zip(*states_of(other, [{}], frames, alike=False), strict=True)
    for mine, theirs in zip(found, expected, strict=True):
        near(mine.position, theirs.position, 1e-6)
    assert peak(found[3].position - steady[3].position) > 1e-3
    assert not torch.equal(before[2].position, found[3].position)  # the wind at a time of the film is the same


@pytest.mark.parametrize("ramp", [2.0, 1.0])
def test_it_is_taken_where_it_predicts_better(fitted, tmp_path, ramp, capsys):
    pytest.importorskip("cv2", reason="needs the extra [fit]")
    flow = [4.0, 3.0, 0.0]
    ends = [{"time": 0.0, "flow": flow}, {"time": 0.75, "flow": [ramp * part for part in flow]}]
    simulation = changed(tmp_path, wind={"flow": None, "schedule": ends, "interpolation": "linear"})
    write_video(simulation, tmp_path / "video", {"left": cameras()["left"]}, 19, noise=2.0)
    sought = {"wind.speed": [2.0, 12.0], "material.E": [2e3, 5e4]}
    options = {"search": 8, "starts": 1, "fit_share": 1.0, "wind_changes": True, "stages": ["tracks"]}
    result = fitted(sought, tmp_path / "video", progress=True, **options)
    assert "a wind that changes is" in capsys.readouterr().err
    if ramp == 1:
        assert set(result.values) == set(sought)
        return
    assert len(result.values) == len(sought) + KNOTS
    assert result.gusts.seconds == pytest.approx(0.75)
    assert result.gusts.sentence() in result.text()
    assert json.loads((tmp_path / "fit/result.json").read_text())["gusts"]["time_scale_is_told"] is False
    assert result.values["wind.speed"] == pytest.approx(TRUTH["wind.speed"], rel=0.1)
    assert result.values["wind.speed@0.75"] == pytest.approx(2.0, rel=0.15)
    again = Simulation.from_yaml(tmp_path / "fit/scene.yaml", device="cpu")
    assert again.wind.interpolation == "linear"
    last = torch.linalg.norm(again.wind.flows[-1]) / torch.linalg.norm(again.wind.flows[0])
    assert float(last) == pytest.approx(result.values["wind.speed@0.75"])


def test_what_it_needs_is_said(tmp_path):
    with value_error(r"Expected `wind\.speed` in `unknowns` with `wind_changes`: add it."):
        Plan(["base"], ["video"], [AZIMUTH], wind_changes=True)
    file = tmp_path / "fit.yaml"
    given = {"base": "flag", "videos": "video", "unknowns": {"wind.speed": [1, 9]}, "wind_changes": 3}
    file.write_text(yaml.safe_dump(given))
    with value_error(r"Expected `wind_changes` in .* to be true or false, but got 3"):
        read_plan(file)
