"""Winds computed together are those computed one by one, to the bit."""

import pytest
import torch

from gaussian_swaying import AeroForce, GaussianGust, SineSway, UniformGust, WindField, WindForce
from gaussian_swaying.wind.field import FlowKey
from gaussian_swaying.wind.wind_batch import WindBatch

TIMES = torch.linspace(-0.3, 4.0, 37, dtype=torch.float64)


def _gusty(k):
    modulations = [
        SineSway(0.3 + 0.1 * k, 1.0 + k, 0.2 * k),
        UniformGust(0.1 * k, 0.04 + 0.01 * k),
        GaussianGust(0.3 * k, 0.05),
    ]
    return WindField([3.0 + k, 0.5 * k, 0.0], modulations=modulations, seed=7**k * (-1) ** k)


def _scheduled(k, interpolation):
    keys = [FlowKey(0.5 * j + 0.1 * k, [1.0 * j + k, 2.0, -j]) for j in range(1 + k)]
    return WindField(schedule=keys, interpolation=interpolation, modulations=[GaussianGust()], seed=k)


@pytest.mark.parametrize(
    "winds",
    [
        [_gusty(k) for k in range(4)],
        [_scheduled(k, "step") for k in range(3)],
        [_scheduled(k, "linear") for k in range(3)],
        [WindField([2.0, 0.0, 0.0], seed=2**70)],
    ],
    ids=["gusts", "steps", "lines", "steady"],
)
def test_the_same_winds(winds):
    expected = torch.stack([wind(TIMES) for wind in winds], dim=1)
    assert torch.equal(WindBatch(winds)(TIMES), expected)


def test_a_force_in_many_winds():
    winds, points = [_gusty(k) for k in range(3)], 5
    normal = torch.nn.functional.normalize(torch.ones(points, 3), dim=-1)
    area = torch.full((points,), 0.1)
    batch = WindForce(AeroForce(), WindBatch(winds), normal, area)
    listed = WindForce(AeroForce(), winds, normal.expand(3, points, 3), area.expand(3, points))
    now = torch.tensor(0.7, dtype=torch.float64)
    assert torch.equal(batch.winds(now, 1e-3, 6), listed.winds(now, 1e-3, 6))
    assert batch.uniform
    assert batch.recordable
    assert batch.twin() is not None


def test_what_cannot_be_computed_together():
    with pytest.raises(ValueError, match="same `interpolation`"):
        WindBatch([_gusty(1), WindField([1.0, 0.0, 0.0])])
    with pytest.raises(ValueError, match="at least one"):
        WindBatch([])
    with pytest.raises(ValueError, match=r"one `wind` for each of the \(3,\) scenes"):
        WindForce(AeroForce(), WindBatch([_gusty(1)]), torch.ones(3, 5, 3), torch.ones(3, 5))
