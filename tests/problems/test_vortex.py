"""The generalised vortex: its body force, and the order of the error under large rotation and shear."""

import dataclasses
import math

import pytest
import torch
from bench.problems.settings import Settings
from bench.problems.vortex import annulus, body_force, placement, vortex
from torch.func import jacrev, vmap

from gaussian_swaying.mpm.laws.fixed_corotated import fixed_corotated_pk1

TURN = 1.0  # rad


def _fixed(settings, cells):
    """A constant substep in proportion to the cell."""
    return dataclasses.replace(settings, substep=0.5 / (16 * math.ceil(5 * cells / 16)))


def test_body_force_is_the_residual_of_the_momentum_balance():
    """Acceleration and divergence of the stress by automatic differentiation of the placement."""
    rest = annulus(4)[0][::9]
    mu, lam, density = torch.tensor(380.0).double(), torch.tensor(570.0).double(), 900.0
    for seconds in (0.1, 0.5, 0.8):
        time = torch.tensor(seconds, dtype=torch.float64)

        def stress(x, time=time):
            return fixed_corotated_pk1(jacrev(lambda y: placement(y, time, TURN))(x), mu, lam)

        divergence = torch.stack([torch.einsum("iJJ->i", jacrev(stress)(x)) for x in rest])
        acceleration = vmap(lambda x, t=time: jacrev(jacrev(lambda s: placement(x, s, TURN)))(t))(rest)
        expected = acceleration - divergence / density
        assert float(expected.norm(dim=-1).max()) > 1
        torch.testing.assert_close(body_force(rest, time, TURN, 380.0, density), expected, rtol=0, atol=1e-11)


def test_points_fill_the_annulus():
    position, volume = annulus(8)
    assert float(volume.sum()) * 8 == pytest.approx(math.pi * (1.25**2 - 0.75**2), rel=1e-12)
    radius = position.norm(dim=-1)
    assert float(radius.min()) > 0.75
    assert float(radius.max()) < 1.25
    assert float(volume.max() / volume.min()) < 1.05


@pytest.mark.slow(twin="test_vortex_in_updated_is_second_order_too")
def test_vortex_in_total_is_second_order():
    """A turn of 1 rad and a shear of more than 4, at the time of the largest turn."""
    coarse, fine = (vortex(n, _fixed(Settings(), n), TURN) for n in (16, 24))
    assert fine["error"] < 0.03
    assert math.log(coarse["error"] / fine["error"]) / math.log(24 / 16) > 1.8


def test_vortex_in_updated_is_second_order_too():
    """Half the turn, and the error that the splines alone explain.

    A quadratic B-spline has a variance of dx²/4, so a transfer is off by dx²/8 of the second derivative, which is 64
    times the turn at its crest; there are two, to the nodes and back.
    """
    coarse, fine = (vortex(n, Settings("updated"), 0.5) for n in (8, 12))
    assert fine["error"] < 2 * 64 / 8 / 12**2
    assert math.log(coarse["error"] / fine["error"]) / math.log(12 / 8) > 1.8
