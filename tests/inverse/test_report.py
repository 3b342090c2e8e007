"""A result in words: where the wind blows in the pictures, and what follows from what was not measured."""

import math

import pytest
import torch
from small_films import changed

from gaussian_swaying.inverse.report import consequences, wind_seen
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import look_at_camera


def _camera(eye):
    camera = look_at_camera(eye, (0.0, 0.0, 0.0), (0, 0, 1), 38.0, 20, 10)
    return Footage("a", (0.0,), (camera,), torch.zeros(1, 10, 20, 3, dtype=torch.uint8))


@pytest.mark.parametrize(
    ("eye", "azimuth", "elevation", "told"),
    [
        ((0.0, -3.0, 0.0), 60.0, 0.0, "to the right, 60 degrees away from it"),
        ((0.0, 3.0, 0.0), 60.0, 0.0, "to the left, 60 degrees towards it"),
        ((3.0, 0.0, 0.0), 90.0, 30.0, "to the right, up, 0 degrees"),
    ],
)
def test_where_the_wind_blows_in_a_picture(simulation, eye, azimuth, elevation, told):
    values = {"wind.speed": 3.0, "wind.azimuth": azimuth, "wind.elevation": elevation}
    (sentence,) = wind_seen(values, [_camera(eye)], simulation)
    assert told in sentence
    assert wind_seen({"material.E": 1.0}, [_camera(eye)], simulation) == []


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
