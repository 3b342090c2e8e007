"""``scene.area: open``: what wind and mass of a capture are, and how it is turned off."""

import math

import pytest
import torch
from bodies import cluttered_sphere
from shared import normalized
from small_scenes import plain_cloud

from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.rotations import rotation_to_quat
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material, Scene, SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A sphere of radius 1 with clutter inside, as a file."""
    body = cluttered_sphere(6000)
    helper = torch.nn.functional.one_hot(body.normals.abs().argmin(-1), 3).double()
    first = normalized(torch.linalg.cross(helper, body.normals))
    axes = torch.stack([first, torch.linalg.cross(body.normals, first), body.normals], dim=-1)
    opacity = torch.logit(body.opacity).float()
    cloud = plain_cloud(body.means, body.log_scales.float(), rotation_to_quat(axes).float(), opacity)
    path = tmp_path_factory.mktemp("capture") / "sphere.ply"
    write_ply(path, cloud)
    return path


def simulated(dx=0.2, material=None, **settings):
    return SimulatedScene(Scene(metres_per_unit=0.5, **settings), material or Material(), dx)


@pytest.mark.parametrize("points", ["grid", "gaussian"])
def test_wind_and_mass_of_a_capture_are_those_of_its_skin(points, capture):
    material = Material(density=200.0, thickness=0.01)
    found = simulated(ply=capture, points=points, material=material)
    skin = 4 * math.pi * 0.5**2
    assert float(found.patches.area.sum()) == pytest.approx(skin, rel=0.05)
    assert float(found.points.mass.sum()) == pytest.approx(200.0 * 0.01 * skin, rel=0.05)
    assert found.points.mass.min() > 0
    layers = simulated(ply=capture, points=points, material=material, area="coverage")
    assert layers.patches.area.sum() > 3 * skin
    assert found.hull_area() == pytest.approx(skin, rel=0.01)


def test_null_is_open_for_files_only(capture):
    flag = FlagScene(spacing=0.1)
    assert Scene(ply=capture).area_kind == "open"
    assert Scene(generator=flag).area_kind == "coverage"
    assert Scene(ply=capture, generator=flag).area_kind == "open"
    assert Scene(ply=capture, wind_on="all").area_kind == "coverage"
    assert Scene(ply=capture, area="coverage").area_kind == "coverage"
    assert Scene(generator=flag, area="open").area_kind == "open"


def test_flag_keeps_its_area():
    flags = [simulated(generator=FlagScene(spacing=0.05), area=area, dx=0.1) for area in ("open", "coverage")]
    torch.testing.assert_close(flags[0].patches.area, flags[1].patches.area)
    torch.testing.assert_close(flags[0].points.mass, flags[1].points.mass)


def test_filled_solid_takes_its_mass_from_its_volume(capture):
    filling = InteriorFilling(spacing=0.05)
    found = [simulated(ply=capture, filling=filling, area=area, dx=0.1) for area in ("open", "coverage")]
    torch.testing.assert_close(found[0].points.mass.sum(), found[1].points.mass.sum(), rtol=0.02, atol=0)
    assert found[0].patches.area.sum() < found[1].patches.area.sum()


def test_summary_has_area_and_hull(tmp_path, capture):
    simulation = Simulation(Scene(ply=capture, metres_per_unit=0.5))
    summary = simulation.run(tmp_path, 1, progress=False)
    assert summary["patch_area_m2"] == pytest.approx(math.pi, rel=0.05)
    assert summary["hull_area_m2"] == pytest.approx(math.pi, rel=0.01)
