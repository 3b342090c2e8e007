"""``scene.sampling: grid``: as many points as the grid can use, and all Gaussians follow them."""

import dataclasses

import pytest
import torch

from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.preview.picture import classify
from gaussian_swaying.simulation.scene import POINTS_PER_CELL, Material


def fine_flag():
    cloud = FlagScene(spacing=0.02).generate()
    cloud.opacities[::7] = -6.0  # some are faint
    return cloud


def test_mass_and_area_are_kept_by_few_points(make_scene):
    full = make_scene(fine_flag(), dx=0.15)
    scene = make_scene(fine_flag(), dx=0.15, sampling="grid")
    assert torch.equal(scene.chosen, full.simulated)
    assert scene.points.count == len(scene.simulated) < len(full.simulated) / 5
    assert float(scene.points.mass.sum()) == pytest.approx(float(full.points.mass.sum()), rel=1e-5)
    assert float(scene.patch_area.sum()) == pytest.approx(float(full.patch_area.sum()), rel=1e-5)
    cells = torch.floor((scene.points.position - scene.points.position.amin(0)) / (0.15 / POINTS_PER_CELL))
    assert len(cells.unique(dim=0)) > 0.7 * len(cells)  # evenly spread
    everyone = torch.cat([scene.simulated, scene.carried]).sort().values
    assert torch.equal(everyone, torch.arange(len(scene.model.means)))


def test_everything_follows_a_linear_motion_and_stays_at_rest(make_scene):
    """The same F everywhere takes every Gaussian where F takes it, whichever points it follows."""
    scene = make_scene(fine_flag(), dx=0.15, sampling="grid", up=[0.0, -1.0, 0.0], metres_per_unit=0.5)
    state = MPMSolver(dx=0.15).init_state(scene.points)
    still = scene.deformed(state)
    assert torch.equal(still.means, scene.rest().means)
    F = torch.tensor([[1.1, 0.2, 0.0], [0.0, 0.9, 0.3], [-0.1, 0.0, 1.0]])
    moved = state.replace(position=state.position @ F.T, F_total=F.expand_as(state.F_total))
    expected = scene.frame.point_to_scene(scene.frame.point_to_sim(scene.model.means.double()) @ F.double().T)
    torch.testing.assert_close(scene.deformed(moved).means.double(), expected, atol=1e-5, rtol=0)
    values = torch.rand(scene.points.count)
    found = scene.on_gaussians(values)
    assert torch.equal(found[scene.simulated], values)
    assert float(values.min()) <= float(found.min()) <= float(found.max()) <= float(values.max())


def test_it_moves_as_with_all_points(make_simulation):
    """A flag of 11 points a cell: half a second of wind, within a twentieth of the distance moved."""
    ends = {}
    for sampling in ("gaussian", "grid"):
        simulation = make_simulation(cloud=FlagScene(spacing=0.03).generate(), dx=0.2, scene={"sampling": sampling})
        with torch.inference_mode():
            state = simulation.start()
            for _ in range(12):
                state, _ = simulation.advance(state)
            ends[sampling] = simulation.scene.deformed(state).means - simulation.scene.rest().means
    moved = ends["gaussian"].norm(dim=-1)
    assert float(moved.max()) > 0.1
    assert float((ends["grid"] - ends["gaussian"]).norm(dim=-1).mean()) < 0.05 * float(moved.mean())


def test_further_points_are_grouped_with_the_gaussians(make_scene):
    cloud = FlagScene(spacing=0.05).generate()
    wide = cloud.scales + 1.4 * (cloud.scales > cloud.scales.amin(-1, keepdim=True))
    few = dataclasses.replace(cloud, scales=wide).select(torch.arange(len(cloud)) % 5 == 0)
    full = make_scene(few, dx=0.12, particle_spacing=0.03)
    scene = make_scene(few, dx=0.12, particle_spacing=0.03, sampling="grid", material=Material(thickness=0.02))
    assert len(scene.simulated) < scene.points.count < full.points.count
    assert scene.on_surface == scene.points.count
    assert float(scene.points.volume.sum()) == pytest.approx(2 * float(full.points.volume.sum()), rel=1e-5)
    assert torch.equal(scene.points.position[: len(scene.simulated)],
                       full.points.position[torch.isin(full.simulated, scene.simulated).nonzero()[:, 0]])  # fmt: skip


def test_what_is_drawn_as_held_and_simulated_are_all_gaussians(make_simulation):
    simulation = make_simulation(cloud=FlagScene(spacing=0.02).generate(), dx=0.2, scene={"sampling": "grid"})
    parts = classify(simulation)
    assert bool(parts.simulated.all())
    assert not bool(parts.carried.any())
    assert torch.equal(parts.pinned, simulation.scene.model.means[:, 0] <= 0.11)


def test_bad_sampling_is_refused(make_scene):
    with pytest.raises(ValueError, match=r"`scene.sampling`"):
        make_scene(sampling="few")
    with pytest.raises(ValueError, match=r"`scene.sampling` \"gaussian\" with `scene.filling`"):
        make_scene(sampling="grid", filling=InteriorFilling(), region=Box([None] * 3, [None] * 3))
