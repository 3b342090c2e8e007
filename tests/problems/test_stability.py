"""How runs of the stability map are judged, apart from what the package says of them."""

import math

import pytest
import torch
from bench.problems.stability import AXES, BODIES, SIZE, RodScene, apart, configuration, energy_error, faults

REST = {"kinetic": 0.0, "elastic": 0.0, "potential": 1.0, "wind_work": 0.0, "J_min": 1.0, "displacement_mean": 0.0}


def run(**last):
    """Two frames: at rest, and one that has got 3 J from the wind and 1 J from gravity."""
    return [REST, REST | {"kinetic": 3.0, "elastic": 1.0, "potential": 0.0, "wind_work": 3.0} | last]


def test_a_run_that_is_right():
    assert energy_error(run()) == 0
    assert faults(run(), run()) == []
    assert faults(run(), None) == []


@pytest.mark.parametrize(("last", "found"), [
    ({"kinetic": math.nan}, "not a number"),
    ({"J_min": -0.1}, "inverted"),
    ({"kinetic": 3.5}, "energy"),
    ({"kinetic": 2.5}, "energy"),
    ({"displacement_mean": 0.14}, "grid"),
])  # fmt: skip
def test_a_run_that_is_wrong(last, found):
    assert faults(run(**last), run(displacement_mean=0.2) if found == "grid" else run()) == [found]


def test_how_far_from_a_finer_grid():
    assert apart(run(displacement_mean=0.15), run(displacement_mean=0.2)) == pytest.approx(0.25)
    assert apart(run(displacement_mean=1e-3), run(displacement_mean=5e-4)) == 0  # less than can be seen


def test_the_bodies_have_their_size():
    rod = RodScene().generate().means
    assert float(rod[:, 2].max() - rod[:, 2].min()) == pytest.approx(SIZE, abs=0.01)
    assert torch.allclose(rod[:, :2].norm(dim=-1), torch.tensor(0.01), atol=1e-3)
    for body in BODIES.values():
        assert list(body.sizes) == sorted(body.sizes, reverse=True)
        given = configuration(body, body.sizes[0])
        assert all(name.split(".")[0] in given for name in AXES)
