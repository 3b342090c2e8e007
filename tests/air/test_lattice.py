"""The velocities of the lattice against the moments that make a fluid of it."""

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying.air.lattice import DIRECTIONS, OPPOSITE, WEIGHTS, LatticeUnits

C = double(DIRECTIONS)
W = double(WEIGHTS)


def test_moments_of_the_weights_are_those_of_a_gas_at_rest():
    """Up to the fourth: sums of w c c = I / 3, and of w c c c c = (I I) / 9, without which viscosity has directions."""
    eye = torch.eye(3, dtype=torch.float64)
    assert_close(W.sum(), torch.ones((), dtype=torch.float64))
    assert_close(torch.einsum("i,ia,ib->ab", W, C, C), eye / 3)
    fourth = sum(torch.einsum(f"{a},{b}->abcd", eye, eye) for a, b in (("ab", "cd"), ("ac", "bd"), ("ad", "bc")))
    assert_close(torch.einsum("i,ia,ib,ic,id->abcd", W, C, C, C, C), fourth / 9)
    assert_close(torch.einsum("i,ia,ib,ic->abc", W, C, C, C), torch.zeros(3, 3, 3, dtype=torch.float64))


def test_opposites():
    assert all(DIRECTIONS[o] == tuple(-c for c in DIRECTIONS[k]) for k, o in enumerate(OPPOSITE))


def test_units_of_a_speed():
    units = LatticeUnits.at_speed(0.1, 5.0, lattice_speed=0.05, viscosity=1e-3, density=1.2)
    assert units.dt == pytest.approx(0.001)
    assert units.speed == pytest.approx(100.0)
    assert units.relaxation == pytest.approx(0.5 + 3 * 1e-3 * 0.001 / 0.01)
    assert units.cell_mass == pytest.approx(1.2e-3)
