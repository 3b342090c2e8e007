"""What a fit says: whether its values have settled, where the wind blows, and what nobody measured."""

import json
import math
from dataclasses import replace

import pytest
import torch
from shared import double, peak
from small_films import changed

from gaussian_swaying.inverse.fit import STEPS, UNSETTLED, run_fit
from gaussian_swaying.inverse.least_squares import Block, solve
from gaussian_swaying.inverse.plan import Unknown
from gaussian_swaying.inverse.report import Fit, consequences, scene_text
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.simulation.simulation import Simulation

from .test_least_squares import scaled

UNKNOWNS = [Unknown("wind.speed", 1.0, 10.0, "log"), Unknown("material.E", 1e3, 1e5, "log")]
SCALE = scaled(0.1)


def test_matches_reach_the_lowest_place_of_a_motion_that_soon_depends_on_everything():
    """Phases that part with time: from afar, all frames at once end beside the true rate 0.7, growing parts do not."""

    def end(steps):
        place = double([0.67])
        for share in steps:
            time = torch.linspace(0, 2, 49, dtype=torch.float64)[: max(3, round(share * 49))]

            def swing(places, time=time):
                found = torch.sin(60 * places * time.square()) - torch.sin(60 * 0.7 * time.square())
                return Block(torch.stack([found, 0 * found], -1), torch.arange(len(time)))

            place = solve(swing, place, 8, True, SCALE).place
        return float(place[0])

    assert end(STEPS) == pytest.approx(0.7, abs=1e-4)
    assert end([1.0] * 3) != pytest.approx(0.7, abs=0.01)


def test_a_camera_that_is_not_followed_is_named():
    result = Fit(UNKNOWNS, (0.5, 0.5), 1e-4 * torch.eye(2), (), 1.0, worse={"left": 15.9, "right": 3.0})
    assert result.verdict == "failed"
    (told,) = [line for line in result.text().splitlines() if "not followed" in line]
    assert told.startswith("camera left")
    assert "16 dB worse" in told
    assert "`until`" in told
    assert replace(result, followed={"left": 0.99, "right": 0.99}).verdict == "good"  # its points say otherwise


@pytest.mark.parametrize(
    ("changes", "verdict", "words"),
    [
        ({}, "good", "This fit is good."),
        ({"followed": {"left": 0.95, "right": 0.7}}, "doubtful", "camera right: the simulation explains 70% of"),
        ({"followed": {"left": 0.95, "right": 0.0}}, "failed", "camera right: the simulation explains 0% of"),
        ({"unsettled": "More `iterations`."}, "doubtful", "More `iterations`."),
        ({"notes": ("Nothing moves.",)}, "doubtful", "Nothing moves."),
        ({"rivals": ({"wind.speed": 9.0},)}, "doubtful", "Another start fits as well or better (wind.speed 9)"),
        ({"place": (0.5, 1.0)}, "doubtful", "is at an end of its range"),
        ({"covariance": torch.eye(2)}, "doubtful", "is not determined"),
        ({"covariance": torch.diag(torch.tensor([0.0, 0.04]))}, "doubtful", "material.E is not determined"),
    ],
)
def test_the_verdict_of_a_fit(changes, verdict, words):
    good = Fit(UNKNOWNS, (0.5, 0.5), 1e-4 * torch.eye(2), (), 1.0, followed={"left": 0.95})
    result = replace(good, **changes)
    assert result.verdict == verdict
    assert words in result.text()


@pytest.mark.slow
def test_a_whole_fit_tells_it_and_goes_on(plan_of, tmp_path, brief, monkeypatch):
    """One iteration is not enough; the same fit with more of them continues where it stood, and settles."""
    pytest.importorskip("cv2", reason="needs the extra [fit]")
    monkeypatch.setattr("gaussian_swaying.inverse.fit.BRIEF", 1)  # or the start would be the end
    sought = {
        "wind.speed": {"range": [2.0, 12.0], "start": 11.0}, "material.E": {"range": [2e3, 5e4], "start": 4e4}
    }  # fmt: skip
    plan = plan_of(sought, search=0, iterations=1, tracks=40)
    first = run_fit(plan, tmp_path / "fit", device="cpu", progress=False)
    assert first.unsettled == UNSETTLED
    assert first.unsettled in first.text()
    assert first.unsettled in json.loads((tmp_path / "fit/result.json").read_text())["why"]
    again = run_fit(replace(plan, iterations=8), tmp_path / "fit", resume=True, device="cpu", progress=False)
    assert again.history[: len(first.history)] == first.history
    assert len(again.history) > len(first.history)
    assert again.unsettled == ""
    assert again.values["wind.speed"] == pytest.approx(5.0, rel=0.05)


def test_what_follows_from_what_was_not_measured(simulation, tmp_path):
    """The flag is 0.4 m long and has 0.25 kg/m²."""
    size = simulation.scene.size
    told = consequences(["length", "mass"], {"wind.speed": 5.0}, simulation)
    assert f"the speed is {5.0 / size:.3g} a second" in told[0]
    assert "Gravity" in told[0]
    assert "taken as 0.25 kg/m²" in told[1]
    assert "Gravity" not in consequences(["length"], {}, changed(tmp_path, solver={"gravity": [0.0, 0.0, 0.0]}))[0]
    assert math.isclose(size, 0.4, abs_tol=0.15)
    assert consequences([], {"wind.speed": 5.0}, simulation) == []


SCHEDULE = [{"time": 0.0, "flow": [4.0, 3.0, 0.0]}, {"time": 0.3, "flow": [1.0, 0.0, 0.0]}]


@pytest.mark.parametrize(
    "changes", [{}, {"wind": {"flow": None, "schedule": SCHEDULE}}, {"material": {"bending": 0.02}}]
)
def test_the_configuration_that_is_written_moves_as_the_fit(tmp_path, changes):
    simulation, parser, values = changed(tmp_path, **changes), Simulation.parser(), {"material.E": 2e4}
    values |= {} if "wind" in changes else {"wind.speed": 4.0, "wind.azimuth": 20.0}
    settings = parser.parse_args(["--config", str(tmp_path / "made.yaml")])
    (tmp_path / "scene.yaml").write_text(scene_text(values, parser, settings, simulation))
    written = Simulation.from_yaml(tmp_path / "scene.yaml", device="cpu")
    (found,), (wanted,) = (
        list(states_of(one, [own], [0.0, 0.3]))[-1] for one, own in ((written, {}), (simulation, values))
    )
    assert peak(wanted.position - simulation.model.points.position) > 0.01
    torch.testing.assert_close(found.position, wanted.position, rtol=1e-3, atol=1e-5)
