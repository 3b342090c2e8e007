import dataclasses
import warnings

import pytest
import torch
from shared import double, peak, unit, value_error
from small_scenes import together

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.regions import Box, Sphere, StillGaussians
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.contact import Contact
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import DemoScene, FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene, still_distance
from gaussian_swaying.simulation.simulation import Simulation


def _ball(contact=None, boundaries=None, **more):
    """A small cloth above the ball of radius 0.3 m."""
    scene = Scene(
        generator=DemoScene("cloth_over_ball", 0.03, size=0.6),
        region=Box([None, None, 0.67], [None, None, 0.69]),
        metres_per_unit=1.0,
    )
    given = [Obstacle(Sphere([0, 0, 0.35], 0.3))] if boundaries is None else boundaries
    solver = MPMSolver(0.06, boundaries=given, **more)
    return Simulation(
        scene, Material(E=5e3, density=50.0, thickness=0.02), solver=solver, contact=contact, device="cpu"
    )


def _fallen(simulation, frames):
    *_, frame = simulation.frames(frames)
    means = frame.gaussians.means[simulation.scene.simulated]
    return means, (means - torch.tensor([0.0, 0.0, 0.35])).norm(dim=-1) - 0.3


def test_a_cloth_falls_onto_a_ball_and_stays_outside():
    """In scene units, and the places of the surface are Gaussians: they keep half the thickness."""
    means, away = _fallen(_ball(Contact()), 10)
    assert away.min() > 0.005
    assert away.min() < 0.02  # it has arrived
    assert means[:, 2].min() < 0.6  # and hangs down beside it


def test_gaussians_that_stand_still_are_an_obstacle():
    """The ball of the splat stops the cloth as the exact one does, to the width of a cell of the distance grid."""
    _, away = _fallen(_ball(boundaries=[Obstacle(StillGaussians(cells=48, margin=0.5))]), 8)
    cell = 1.2 / 48
    assert -0.5 * cell < away.min() - 0.01 < 1.5 * cell


def test_the_distance_from_gaussians_is_that_of_the_ball_that_they_cover():
    cloud = DemoScene("cloth_over_ball", 0.03, size=0.6).generate()
    ball = cloud.select((cloud.means - torch.tensor([0.0, 0.0, 0.35])).norm(dim=-1) < 0.31)
    model = GaussianSurfaceModel.from_cloud(ball, requires_grad=False)
    corner = double([0.5, 0.5, 0.5])
    centre = double([0.0, 0.0, 0.35])
    given = (ball.means.double(), model.covariance().double(), model.opacity(), centre - corner, centre + corner)
    found = still_distance(*given, 50, 0.5)
    direction = unit(400, 3)
    distance, normal = found.at(centre + 0.34 * direction)
    assert peak(distance - 0.04) < found.spacing  # the Gaussians themselves are some millimetres thick
    assert (normal * direction).sum(-1).min() > 0.9
    with value_error(r"nowhere denser than 0\.5"):
        still_distance(*given[:3], centre + 9, centre + 10, 20, 0.5)


def _two_sheets(gap):
    one = FlagScene(0.4, 0.4, 0.02, ripple=0.0).generate()
    other = dataclasses.replace(one, means=one.means + torch.tensor([0.0, gap, 0.0]))
    return GivenScene(together(one, other))


@pytest.mark.parametrize(("gap", "warned"), [(0.012, True), (0.05, False)])
def test_surfaces_that_start_too_close_are_warned_of(gap, warned):
    scene = Scene(generator=_two_sheets(gap), metres_per_unit=1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Simulation(scene, Material(thickness=0.02), solver=MPMSolver(0.04), contact=Contact(), device="cpu")
    assert any("start closer than 0.02 m" in str(w.message) for w in caught) == warned


def test_a_configuration_turns_contact_on(tmp_path):
    text = """
scene:
  generator: {class_path: DemoScene, init_args: {kind: cloth_over_ball, size: 0.4, spacing: 0.04}}
  region: {class_path: Box, init_args: {min: [null, null, 0.67], max: [null, null, 0.69]}}
  metres_per_unit: 1.0
contact: {thickness: 0.007, friction: 0.1}
solver:
  dx: 0.1
  boundaries:
    - class_path: Obstacle
      init_args:
        shape: {class_path: Sphere, init_args: {center: [0, 0, 0.35], radius: 0.3}}
        path: {times: [0, 1], moves: [[0, 0, 0], [0, 0, 1]]}
"""
    file = tmp_path / "cloth.yaml"
    file.write_text(text)
    simulation = Simulation.from_yaml(file, device="cpu")
    surface = simulation.scene.surface_places
    assert surface is not None
    assert surface.contact == Contact(thickness=0.007, friction=0.1)
    assert float(surface.thickness.amax()) == pytest.approx(0.007)
    assert simulation.solver.boundaries[0].path.speed == 1.0
    file.write_text(text.replace("0.007", "-1"))
    with value_error(r"contact\.thickness"):
        Simulation.from_yaml(file, device="cpu")
    file.write_text(text.replace("solver:", "solver:\n  formulation: updated"))
    with value_error(r"`contact` needs `solver\.formulation: total`"):
        Simulation.from_yaml(file, device="cpu")
