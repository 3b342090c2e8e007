"""``scene.loose: carry``: specks that hang on nothing follow what is simulated."""

import dataclasses

import pytest
import torch
from shared import advanced, seeded
from small_scenes import together

from gaussian_swaying.scenes.procedural import FlagScene

POINTS = ["gaussian", "grid"]
FLAG = 30 * 20  # Gaussians


def speckled():
    """A flag of 0.04 m between Gaussians, with two clumps of six 0.4 m in front of it."""
    flag = FlagScene(spacing=0.04).generate()
    own = flag.select(torch.tensor([300] * 6 + [420] * 6))
    jitter = 0.01 * torch.rand(12, 3, generator=seeded(0))
    specks = dataclasses.replace(own, means=own.means + jitter - torch.tensor([0.0, 0.4, 0.0]))
    return together(flag, specks)


@pytest.mark.parametrize("points", POINTS)
def test_specks_are_carried_and_weigh_nothing(points, make_scene):
    cloud = speckled()
    scene = make_scene(cloud, dx=0.1, points=points, loose="carry")
    alone = make_scene(cloud.select(torch.arange(FLAG)), dx=0.1, points=points)
    specks = torch.arange(FLAG, FLAG + 12)
    assert scene.loose == 12
    assert torch.isin(specks, scene.carried).all()
    assert torch.equal(scene.simulated, torch.arange(FLAG))
    assert scene.points.count == alone.points.count
    assert float(scene.points.mass.sum()) == pytest.approx(float(alone.points.mass.sum()), rel=1e-5)
    simulated = make_scene(cloud, dx=0.1, points=points)
    assert simulated.loose == 0
    assert torch.equal(simulated.simulated, torch.arange(FLAG + 12))
    assert scene.size == simulated.size  # the region's, whoever is simulated in it
    assert torch.equal(scene.frame.origin, simulated.frame.origin)


@pytest.mark.slow(gate=["grid"])
@pytest.mark.parametrize("points", POINTS)
def test_the_wind_blows_specks_away_unless_they_are_carried(points, make_simulation):
    moved = {}
    for loose in ("simulate", "carry"):
        simulation = make_simulation(cloud=speckled(), dx=0.1, scene={"points": points, "loose": loose})
        with torch.inference_mode():
            state, _ = advanced(simulation, 12)
            moved[loose] = (simulation.scene.deformed(state).means - simulation.scene.rest().means).norm(dim=-1)
    flag, specks = moved["simulate"][:FLAG], moved["simulate"][FLAG:]
    assert specks.min() > 2 * flag.max()
    flag, specks = moved["carry"][:FLAG], moved["carry"][FLAG:]
    assert specks.max() < 1.5 * flag.max()


def test_what_further_points_join_is_not_loose(make_scene):
    cloud = FlagScene(spacing=0.025).generate()
    wide = cloud.scales + 1.4 * (cloud.scales > cloud.scales.amin(-1, keepdim=True))
    thin = (cloud.means[:, 0] < 0.8) | (torch.arange(len(cloud)) % 5 == 0)  # large ones alone at the free end
    few = dataclasses.replace(cloud, scales=wide).select(thin)
    assert make_scene(few, dx=0.06, loose="carry").loose > 0
    filled = make_scene(few, dx=0.06, particle_spacing=0.025, loose="carry")
    assert filled.loose == 0
    assert filled.on_surface > len(filled.simulated)
    alone = few.select(torch.tensor([30]))
    speck = dataclasses.replace(alone, means=torch.tensor([[0.6, -0.7, 0.4]]), scales=alone.scales - 1.1)
    assert make_scene(speck, dx=0.06, particle_spacing=0.025).on_surface > 1
    scene = make_scene(together(few, speck), dx=0.06, particle_spacing=0.025, loose="carry")
    assert scene.loose == 1
    assert scene.points.count == filled.points.count  # its further points are gone with it
