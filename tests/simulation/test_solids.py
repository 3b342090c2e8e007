import dataclasses
import math

import pytest
import torch
from shared import in_both, longest, near, up_to

from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.geometry.regions import Not, Sphere
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.scenes import GivenScene
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.simulation.body import Material, MaterialRegion, Scene, SimulatedScene, cell_volume
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField

DX = 0.12  # m
FILLING = InteriorFilling()
SETTINGS = {"shape": "ball", "size": 0.6, "spacing": 0.06}
VOLUME, AREA = math.pi / 6 * 0.6**3, math.pi * 0.6**2


def _scene(gaussians="shell", material=None, dtype=torch.float32, generator=None, **settings):
    settings = {"filling": FILLING, **settings}
    generator = generator or SolidScene(**SETTINGS, gaussians=gaussians)
    return SimulatedScene(
        Scene(points="gaussian", generator=generator, **settings), material or Material(density=200.0), DX, dtype
    )


def _simulation(material=None, solver=None, **scene):
    settings = {
        "generator": SolidScene(**SETTINGS, gaussians="shell"),
        "filling": FILLING,
        "points": "gaussian",
        **scene,
    }
    return Simulation(
        Scene(**settings),
        material or Material(density=200.0),
        solver=MPMSolver(DX, boundaries=[PinnedRegion(up_to(z=-0.24))], **(solver or {})),
        wind=WindField([6.0, 0.0, 0.0]),
        camera=OrbitCamera(width=32, height=18, radius=2.0),
        device="cpu",
    )


@pytest.mark.parametrize("gaussians", ["shell", "throughout"])
def test_the_body_weighs_density_times_volume(gaussians):
    """Whatever its Gaussians are, and whatever the thickness; half a cell of the surface bounds the error."""
    for thickness in (0.01, 0.1):
        scene = _scene(gaussians, Material(density=200.0, thickness=thickness), dtype=torch.float64)
        torch.testing.assert_close(scene.points.mass, 200.0 * scene.points.volume)
        assert abs(float(scene.points.mass.sum()) / 200.0 - VOLUME) < 0.25 * DX * AREA
        assert scene.filled == scene.points.count - len(scene.simulated) > 0
        assert (scene.points.mass > 0).all()


def test_filled_points_feel_no_wind():
    """The total force is that on the patches of the hollow splat, to the last bit of each patch."""
    filled, hollow = _scene(), _scene(filling=None)
    count = len(filled.simulated)
    assert torch.equal(filled.patches.areas()[:count], hollow.patches.area)
    assert not filled.patches.areas()[count:].any()
    forces = []
    for settings in ({}, {"filling": None}):
        simulation = _simulation(**settings)
        state = simulation.start()
        turned = torch.eye(3) + 0.1 * torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 2.0], [0.0, 0.5, 0.3]])
        state = state.replace(F_total=turned.expand_as(state.F_total))
        forces.append(simulation.stepper.wind_force(state)[0])
    torch.testing.assert_close(forces[0][:count], forces[1])
    assert not forces[0][count:].any()
    assert forces[1].norm(dim=-1).min() > 0


def test_wind_on_the_surface_or_on_all():
    shell = len(SolidScene(**SETTINGS, gaussians="shell").generate())
    surface, everywhere = _scene("throughout"), _scene("throughout", wind_on="all")
    count = len(surface.simulated)
    assert count > 2 * shell
    windy = surface.patches.areas()[:count] > 0
    assert windy[:shell].all()
    deep = 0.3 - surface.model.means.norm(dim=-1)
    assert not windy[deep > DX].any()
    assert (everywhere.patches.areas()[:count] > 0).all()
    assert not everywhere.patches.areas()[count:].any()
    assert everywhere.patches.area.sum() > 1.5 * surface.patches.area.sum()
    assert torch.equal(everywhere.patches.areas()[:count][windy], surface.patches.areas()[:count][windy])
    assert torch.equal(surface.points.mass, everywhere.points.mass)
    # with cells so small that only the outer Gaussians are less than one deep, their areas are the ball's
    fine = _scene("throughout", filling=InteriorFilling(spacing=0.03))
    assert float(fine.patches.area.sum()) == pytest.approx(AREA, rel=0.1)


def test_the_filling_is_neither_drawn_nor_exported(tmp_path):
    simulation = _simulation()
    scene, state = simulation.scene, simulation.start()
    shift = torch.linspace(0, 0.1, len(state.position))[:, None]
    state = state.replace(position=state.position + shift, F_total=state.F_total * 1.1)
    deformed = scene.deformed(state)
    count = len(scene.simulated)
    assert len(deformed.means) == count == len(scene.model.means)
    torch.testing.assert_close(deformed.means, scene.model.means + shift[:count])
    assert len(deformed.to_cloud()) == count
    # a point that fills can be anywhere: the picture is the same
    other = state.replace(position=torch.cat([state.position[:count], state.position[count:] + 0.3]))
    assert torch.equal(simulation.painter.render(state, 0).color, simulation.painter.render(other, 0).color)


def test_carried_gaussians_follow_gaussians():
    cloud = SolidScene(**SETTINGS, gaussians="shell").generate()
    opacities = cloud.opacities.clone()
    opacities[::10] = -6.0
    faint = dataclasses.replace(cloud, opacities=opacities)

    simulation = _simulation(generator=GivenScene(faint))
    scene, state = simulation.scene, simulation.start()
    assert len(scene.carried) > 0
    moved = torch.cat([state.position[: len(scene.simulated)] + 0.2, state.position[len(scene.simulated) :]])
    means = scene.deformed(state.replace(position=moved)).means
    near(means, cloud.means + 0.2, 1e-6)


def test_the_frame_reaches_the_filling():
    """Volumes are in cubic metres, z up, whatever the units and axes of the splat."""
    unit, large = _scene(), _scene(metres_per_unit=10.0, filling=InteriorFilling(spacing=5 * DX))
    torch.testing.assert_close(large.points.position, 10 * unit.points.position)
    torch.testing.assert_close(large.points.volume, 1000 * unit.points.volume)
    turned = _scene(up=[0.0, -1.0, 0.0])
    assert float(turned.points.volume.sum()) == pytest.approx(VOLUME, abs=0.25 * DX * AREA)
    assert longest(turned.points.position) < 0.3 + 0.5 * DX


def test_regions_reach_the_filling():
    """They are in scene units and axes."""
    lower = MaterialRegion(up_to(y=0.05), density=400.0)
    settings = {"metres_per_unit": 10.0, "up": [0.0, 1.0, 0.0], "filling": InteriorFilling(spacing=5 * DX)}
    scene = _scene(material=Material(density=200.0, regions=[lower]), **settings)
    below = scene.frame.point_to_scene(scene.points.position)[:, 1] <= 0.05
    assert 0 < int(below[len(scene.simulated) :].sum()) < scene.filled
    assert torch.equal(scene.points.mass, scene.points.volume * torch.where(below, 400.0, 200.0))
    half = _scene(region=up_to(z=0.1))
    assert float(half.points.position[:, 2].max() - half.points.position[:, 2].min()) < 0.4 + 1e-6
    hole = _scene(region=Not(Sphere([0.0, 0.0, 0.0], 0.15)), metres_per_unit=2.0)
    assert len(hole.simulated) == len(hole.model.means)
    assert hole.points.position.norm(dim=-1).min() > 2 * 0.15


def test_physgaussians_volumes_count_the_filling():
    scene = _scene(material=Material(volume="cell"))
    torch.testing.assert_close(scene.points.volume, cell_volume(scene.points.position, DX))


def test_a_run_of_a_filled_solid(tmp_path):
    recorder = {"video": False, "checkpoint_every": 1}
    whole = tmp_path / "whole"
    summary = _simulation().run(whole, 4, progress=False, recorder=Recorder(**recorder))
    scene = _scene()
    count = len(scene.simulated)
    assert summary["filled_particles"] == scene.filled > 0
    assert summary["gaussians"] == count
    assert summary["particles"] == scene.points.count
    assert summary["mass_kg"] == pytest.approx(float(scene.points.mass.sum()), rel=1e-5)
    assert summary["patch_area_m2"] == pytest.approx(float(scene.patches.area.sum()), rel=1e-5)
    assert summary["lost_particles"] == 0
    hollow = _simulation(filling=None).run(tmp_path / "hollow", 4, progress=False, recorder=Recorder(**recorder))
    assert summary["wind_work_J"] < 0.5 * hollow["wind_work_J"]


@pytest.mark.gpu
@in_both
def test_a_filled_solid_on_a_gpu(formulation):
    ends = []
    for device in ("cpu", "cuda"):
        simulation = _simulation(solver={"formulation": formulation}).to(device)
        state, _ = simulation.advance(simulation.start())
        ends.append(state.position.cpu())
    near(ends[0], ends[1], 1e-5)
