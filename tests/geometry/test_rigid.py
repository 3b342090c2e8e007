import pytest
import torch
from shared import double, near, peak, rand, randn, seeded
from torch.testing import assert_close

from gaussian_swaying.geometry.rigid import centre, fitted_gradient, rigid_velocity
from gaussian_swaying.geometry.rotations import rotation_of

GENERATOR = seeded(2)
PLACE = rand(2, 40, 3, generator=GENERATOR)
VELOCITY = randn(2, 40, 3, generator=GENERATOR)
MASS = rand(2, 40, generator=GENERATOR)


def momenta(place, velocity):
    momentum = MASS[..., None] * velocity
    return momentum.sum(-2), torch.linalg.cross(place, momentum, dim=-1).sum(-2)


def distances(place):
    return (place[:, :, None] - place[:, None]).norm(dim=-1)


@pytest.mark.parametrize("dt", [1e-4, 1e-2, double(0.03)])
def test_momenta_and_distances_stay(dt):
    moved = rigid_velocity(PLACE, VELOCITY, MASS, dt)
    for found, given in zip(momenta(PLACE, moved), momenta(PLACE, VELOCITY), strict=True):
        near(found, given, 1e-11)
    after = PLACE + dt * moved
    near(distances(after), distances(PLACE), 1e-12)
    for found, given in zip(momenta(after, moved), momenta(PLACE, VELOCITY), strict=True):
        near(found, given, 1e-11)


def test_a_rigid_motion_stays_as_it_is():
    turn = 1e-3 * double([1.0, 2.0, -0.5])
    middle = centre(PLACE, MASS)
    velocity = ((PLACE - middle) @ rotation_of(turn).mT + middle - PLACE) / 1e-3 + torch.tensor([0.3, 0.0, 1.0])
    near(rigid_velocity(PLACE, velocity, MASS, 1e-3), velocity, 1e-9)


def test_points_without_mass_are_taken_along_and_do_not_count():
    mass = torch.where(torch.arange(40) < 20, MASS, 0.0)
    moved = rigid_velocity(PLACE, VELOCITY, mass, 1e-3)
    alone = rigid_velocity(PLACE[:, :20], VELOCITY[:, :20], mass[:, :20], 1e-3)
    near(moved[:, :20], alone, 1e-12)
    after = PLACE + 1e-3 * moved
    near(distances(after), distances(PLACE), 1e-12)
    assert peak(rigid_velocity(PLACE, VELOCITY, torch.zeros_like(mass), 1e-3)) == 0.0


def test_the_gradient_of_an_affine_field_is_found():
    gradient = randn(2, 3, 3, generator=GENERATOR)
    field = PLACE @ gradient.mT + 4.0
    assert_close(fitted_gradient(PLACE, field, MASS), gradient)


def test_it_has_gradients():
    velocity = VELOCITY[:, :6].clone().requires_grad_()
    place = PLACE[:, :6].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v, x: rigid_velocity(x, v, MASS[:, :6], 0.02), (velocity, place))
