"""The collision: ten moments and 27 populations are the same flow, and nothing that is conserved changes."""

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying.air.collision import MOMENTS, collide, population, relaxation_time, sums
from gaussian_swaying.air.lattice import DIRECTIONS

DOUBLE = torch.float64


@pytest.fixture
def moments():
    torch.manual_seed(0)
    return 0.05 * torch.randn(MOMENTS, 50, dtype=DOUBLE)


def _split(moments):
    return sums([population(moments, k) for k in range(len(DIRECTIONS))])


def test_populations_have_the_moments_that_made_them(moments):
    excess, momentum, second = _split(moments)
    rho, u = 1 + moments[0], moments[1:4]
    assert_close(excess, moments[0])
    assert_close(momentum, rho * u)
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    expected = [rho * u[a] * u[b] + moments[4 + k] + (a == b) * excess / 3 for k, (a, b) in enumerate(pairs)]
    assert_close(second, torch.stack(expected))


def test_third_moments_follow_the_recursion(moments):
    f = torch.stack([population(moments, k) for k in range(len(DIRECTIONS))])
    c = double(DIRECTIONS)
    third = torch.einsum("ia,ib,ic,in->abcn", c, c, c, f)
    rho, u = 1 + moments[0], moments[1:4]
    xxy = rho * u[0] ** 2 * u[1] + u[1] * moments[4] + 2 * u[0] * moments[7]
    assert_close(third[0, 0, 1] - rho * u[1] / 3, xxy)
    xyz = rho * u.prod(0) + u[0] * moments[9] + u[1] * moments[8] + u[2] * moments[7]
    assert_close(third[0, 1, 2], xyz)


def test_a_collision_keeps_mass_and_momentum_and_relaxes_the_stress(moments):
    after = collide(*_split(moments), molecular=0.8, smagorinsky=0.0)
    assert_close(after[:4], moments[:4])
    assert_close(after[4:], (1 - 1 / 0.8) * moments[4:])


def test_a_push_adds_momentum(moments):
    push = double([[0.01], [0.02], [-0.03]])
    after = collide(*_split(moments), molecular=0.8, smagorinsky=0.0, push=push)
    assert_close(after[1:4], moments[1:4] + push)


def test_eddies_have_the_viscosity_of_smagorinsky():
    """nu_t = C² |S|, with the strain rate that the stress and the whole relaxation time give."""
    stress = 0.01 * torch.randn(6, 20, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    rho, tau0, constant = torch.ones(20, dtype=DOUBLE), 0.505, 0.15
    tau = relaxation_time(stress, rho, tau0, constant)
    strain = -1.5 / tau * stress
    size = (2 * (strain[:3].square().sum(0) + 2 * strain[3:].square().sum(0))).sqrt()
    assert_close((tau - tau0) / 3, constant**2 * size)
