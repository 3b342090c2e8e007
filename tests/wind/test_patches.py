import math

import pytest
import torch
from shared import EYE, double, normalized, rand, randn, seeded, unit
from torch.testing import assert_close

from gaussian_swaying import AeroForce, WindField, WindForce, aero_force
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.wind.patches import MOST, Patches, PatchSums

LAWS = {
    "paper": {"drag": 0.5, "friction": 0.4, "lift": 0.01, "law": "paper"},
    "projected": {"drag": 1.28, "friction": 0.0, "lift": 0.0, "law": "projected"},
    "projected with all terms": {"drag": 0.5, "friction": 0.4, "lift": 0.3, "law": "projected"},
    "linear with all terms": {"drag": 0.5, "friction": 0.4, "lift": 0.3, "law": "linear"},
    "cross flow with all terms": {"drag": 0.5, "friction": 0.4, "lift": 0.3, "law": "cross_flow"},
    "paper with lift": {"drag": 0.5, "friction": 0.1, "lift": 0.5, "law": "paper"},
}
POINTS = 40


def random_patches(spread, each=30, seed=0):
    """Patches of random areas whose normals spread around that of their point; one point has none."""
    generator = seeded(seed)
    main = unit(POINTS, 3, generator=generator)
    point = torch.randint(1, POINTS, (each * POINTS,), generator=generator)
    noise = spread * randn(len(point), 3, generator=generator)
    normal = normalized(main[point] + noise)
    normal = normal * torch.where(torch.rand(len(point), generator=generator) < 0.5, -1.0, 1.0)[:, None]
    area = 1e-4 * rand(len(point), generator=generator)
    return normal, area, point


def each_patch(wind, velocity, F, normal, area, point, cap=math.inf, **law):
    now, grown = deform_patch(F[point], normal, area)
    force = aero_force(wind, velocity[point], now, torch.minimum(grown, cap * area), **law)
    return torch.zeros_like(velocity).index_add(0, point, force)


def grouped_force(wind, velocity, F, patches, drag, friction, lift, law, cap=None):
    aero = AeroForce(drag, friction, C_L=lift, law=law, max_area_ratio=cap)
    return aero.on_patches(wind, velocity, F, patches)


def off(found, expected):
    return float((found - expected).norm(dim=-1).sum() / expected.norm(dim=-1).sum())


def winds(count=60):
    generator = seeded(1)
    return 5 * unit(count, 3, generator=generator)


def turned(stretch=0.0):
    generator = seeded(2)
    quats = randn(POINTS, 4, generator=generator)
    strain = stretch * randn(POINTS, 3, 3, generator=generator)
    return quat_to_rotation(quats) @ (EYE + 0.5 * (strain + strain.mT))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("spread", [0.005, 0.1, 3.0])
def test_force_is_the_sum_over_the_patches(law, spread):
    """Of a flat, a noisy and an arbitrary group, in any direction, whatever its rotation: within 1 %."""
    normal, area, point = random_patches(spread)
    sums, F = PatchSums(Patches(normal, area, point, POINTS)), turned()
    velocity = torch.zeros(POINTS, 3).double()
    for wind in winds():
        expected = each_patch(wind, velocity, F, normal, area, point, **LAWS[law])
        found, now = grouped_force(wind, velocity, F, sums, **LAWS[law])
        assert off(found, expected) < 0.01
        assert (found - expected).sum(0).norm() < 0.01 * expected.norm(dim=-1).sum()
        assert not found[0].any()
        assert_close(now.sum(), area.sum())
        aero = AeroForce(C_D=0.5, drag_step="semi_implicit")
        alone = aero.resistance(wind, velocity[point], area)
        assert_close(aero.resistance(wind, velocity, now), torch.zeros_like(now).index_add(0, point, alone))


@pytest.mark.parametrize(
    "law", ["projected", "projected with all terms", "linear with all terms", "cross flow with all terms", "paper"]
)
def test_strain_costs_less_than_itself(law):
    """The mean growth of area stands for that of each patch: exact for one direction, else no worse than the strain."""
    velocity = torch.zeros(POINTS, 3).double()
    for spread, bound in ((0.0, 1e-9), (0.1, 0.01), (3.0, 0.05)):
        normal, area, point = random_patches(spread)
        sums, F = PatchSums(Patches(normal, area, point, POINTS)), turned(0.05)
        for wind in winds(20):
            for cap in (math.inf, 0.9) if spread == 0 else (math.inf,):
                expected = each_patch(wind, velocity, F, normal, area, point, cap=cap, **LAWS[law])
                found, _ = grouped_force(wind, velocity, F, sums, cap=cap, **LAWS[law])
                assert off(found, expected) <= bound


def test_one_direction_takes_the_path_of_single_patches():
    normal, area, point = random_patches(0.0)
    force = WindForce(AeroForce(), WindField([3.0, 1.0, 0.0]), Patches(normal, area, point, POINTS))
    assert force.sums is None
    assert_close(force.area.sum(), area.sum())
    assert (force.normal[point] * normal).sum(-1).abs().min() > 1 - 1e-12
    assert not force.area[0]
    several = WindForce(AeroForce(), WindField([3.0, 1.0, 0.0]), Patches(*random_patches(0.1), POINTS))
    assert several.sums is not None


@pytest.mark.parametrize("lift", [0.01, 0.04])
def test_a_small_lift_needs_few_directions(lift):
    """With the projected law, lift alone depends on the sum of signs: within 1 % with less than half the list."""
    normal, area, point = random_patches(3.0, each=60)
    patches, aero = Patches(normal, area, point, POINTS), AeroForce(C_L=lift, law="projected")
    few, all_of_them = WindForce(aero, WindField([1.0, 0.0, 0.0]), patches).sums, PatchSums(patches)
    assert len(few.vector) < 0.6 * len(all_of_them.vector)
    velocity, F = torch.zeros(POINTS, 3).double(), turned()
    for wind in winds():
        law = {"drag": 0.5, "friction": 0.4, "lift": lift, "law": "projected"}
        expected = each_patch(wind, velocity, F, normal, area, point, **law)
        found = grouped_force(wind, velocity, F, few, **law)[0]
        assert off(found, expected) < 0.01


@pytest.mark.parametrize("law", ["projected with all terms", "linear with all terms"])
def test_gradients(law):
    normal, area, point = random_patches(0.3, each=3)
    sums = PatchSums(Patches(normal, area, point, POINTS))
    wind = double([3.0, -1.0, 0.4]).requires_grad_()
    velocity = torch.zeros(POINTS, 3, dtype=torch.float64, requires_grad=True)
    F = turned(0.05).requires_grad_()

    def function(wind, velocity, F):
        return grouped_force(wind, velocity, F, sums, **LAWS[law])[0]

    assert torch.autograd.gradcheck(function, (wind, velocity, F), fast_mode=True)


def test_directions_are_joined_up_to_a_number():
    normal, area, point = random_patches(3.0, each=400)
    sums = PatchSums(Patches(normal, area, point, POINTS))
    assert int(sums.point.bincount().max()) <= MOST
    assert (sums.point.diff() >= 0).all()
    total = torch.zeros(POINTS).double().index_add(0, sums.point, sums.vector.norm(dim=-1))
    assert_close(total, sums.area)
    assert not PatchSums(Patches(normal, area, point, POINTS)).single
    nothing = PatchSums(Patches(normal[:0], area[:0], point[:0], 3))
    assert nothing.single
    assert nothing.area.tolist() == [0.0] * 3
