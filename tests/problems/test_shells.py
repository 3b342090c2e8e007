"""A ring of Kirchhoff and Love's shell, against closed forms."""

import math

import numpy as np
import pytest
import torch
from bench.problems.shells import GRAVITY, Ring, density, hang


def _plate(ring):
    """Deflection of the edge: w = q r^4 / 64 D + A r² log r + B r² + C log r + E, clamped inside and free outside."""
    a, b, nu, q = ring.inner, ring.outer, ring.nu, ring.mass * GRAVITY
    parts = [  # value, slope, second derivative, third derivative of each part
        lambda r: (r**2 * math.log(r), r * (2 * math.log(r) + 1), 2 * math.log(r) + 3, 2 / r),
        lambda r: (r**2, 2 * r, 2, 0),
        lambda r: (math.log(r), 1 / r, -1 / r**2, 2 / r**3),
        lambda r: (1, 0, 0, 0),
        lambda r: (r**4 / 64, r**3 / 16, 3 * r**2 / 16, 3 * r / 8),
    ]

    def conditions(part):
        w, slope = part(a)[:2]
        _, first, second, third = part(b)
        return w, slope, second + nu * first / b, third + second / b - first / b**2

    matrix = np.array([conditions(part) for part in parts]).T
    factors = np.linalg.solve(matrix[:, :4], -matrix[:, 4] * q / ring.bending)
    values = [part(b)[0] for part in parts]
    return float(factors @ values[:4] + values[4] * q / ring.bending)


def test_a_stiff_ring_sinks_as_a_plate():
    ring = Ring(0.09, 0.15, 2.84e-5, 100.0, 36e-6)  # sinks by 14 µm: the stiffness of a ring that bends alone
    found = hang(ring, folds=4, cells=(4, 8), seed=0.0)
    assert found.residual < 1e-7
    assert found.edge[:, 2] == pytest.approx(-_plate(ring), rel=1e-3)


def test_a_ring_turned_as_a_whole_has_no_energy_and_a_rolled_one_that_of_its_curvature():
    """Rolled to a cylinder of radius R about the axis along the angle, it has D / 2 R² to a unit of area."""
    ring, r = Ring(0.1, 0.2, 1.0, 50.0, 1e-3, nu=0.3), torch.tensor(0.15, dtype=torch.float64)
    flat = torch.tensor([[1, 0, 0], [0, 0.15, 0], [0, 0, 0], [0, 1, 0], [-0.15, 0, 0]], dtype=torch.float64)
    turn = torch.linalg.qr(torch.tensor([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]], dtype=torch.float64))[0]
    assert float(density((flat @ turn).reshape(-1), r, ring)) == pytest.approx(0, abs=1e-15)
    rolled = flat.clone()
    rolled[2, 2] = 1 / 0.3
    assert float(density(rolled.reshape(-1), r, ring)) == pytest.approx(0.5 * 1e-3 / 0.3**2, rel=1e-12)


def test_a_soft_ring_folds_and_rests():
    ring = Ring(0.09, 0.15, 0.284, 100.0, 36e-6)
    found = hang(ring, folds=5, cells=(6, 6))
    assert found.residual < 1e-6
    assert found.energy < 0
    assert found.edge[0, 2] > found.edge[-1, 2] + 0.02
    assert abs(found.edge[0, 1]) < 1e-12
    assert math.atan2(found.edge[-1, 1], found.edge[-1, 0]) == pytest.approx(math.pi / 5, abs=1e-9)
