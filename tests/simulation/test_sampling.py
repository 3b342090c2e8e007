import dataclasses

import pytest
import torch
from shared import double

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.simulation.body import Samples, grouped

DOUBLE = torch.float64
FRAME = SimFrame(torch.zeros(3, dtype=DOUBLE), torch.eye(3, dtype=DOUBLE), 0.5)


def _pairs():
    place = double([[0.9, 0.9, 1.0], [1.1, 0.9, 1.0], [0.9, 1.1, 1.0], [1.1, 1.1, 1.0]])
    each = {
        name: torch.ones(8, dtype=DOUBLE)
        for name in ("body_area", "area", "volume", "E", "density", "thickness", "bending", "damping")
    }
    return Samples(
        position=place.repeat_interleave(2, 0),
        normal=double([0.0, 0.0, 1.0]).repeat(8, 1),
        nu=torch.full((8,), 0.3, dtype=DOUBLE),
        law_index=torch.zeros(8, dtype=torch.long),
        surface=torch.ones(8, dtype=torch.bool),
        **each,
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("E", 2.0),
        ("nu", 0.4),
        ("density", 2.0),
        ("thickness", 2.0),
        ("bending", 2.0),
        ("damping", 2.0),
        ("law_index", 1),
        ("surface", False),
        ("area", 0.0),
    ],
)
def test_a_group_never_mixes_what_differs(name, value):
    samples = _pairs()
    odd = torch.arange(8) % 2 == 1
    samples = dataclasses.replace(samples, **{name: getattr(samples, name).masked_fill(odd, value)})
    points, owner, _ = grouped(samples, 1.0, 1, [], FRAME, DOUBLE)
    assert len(points.mass) == 2
    for point in (0, 1):
        own = getattr(samples, name)[owner == point]
        assert (own == own[0]).all()
        assert len(own) == 4


def test_areas_that_differ_share_a_group_if_all_feel_the_wind():
    samples = dataclasses.replace(_pairs(), area=torch.linspace(0.1, 3.0, 8, dtype=DOUBLE))
    points, owner, _ = grouped(samples, 1.0, 1, [], FRAME, DOUBLE)
    assert owner.tolist() == [0] * 8
    assert float(points.area) == pytest.approx(8 * 1.55)
