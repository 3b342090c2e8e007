"""The lean of a standing thing against beam theory."""

import pytest
import torch

from gaussian_swaying.data.procedural import FlagScene
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.simulation.lean import LEAN, SHELL_E, cantilever_lean, stiffness_for, thinned


def test_lean_of_a_hollow_column_is_that_of_a_beam():
    """Two walls 0.2 m apart face the wind: mean displacement q L^4 / (20 E I), for a uniform load q."""
    dx, width, gap, thickness, E = 0.01, 0.3, 0.2, 0.004, 1e5
    z = torch.arange(0.0025, 1.0, 0.005, dtype=torch.float64)
    wall = torch.stack([torch.zeros_like(z), torch.full_like(z, gap / 2), z], -1)
    position = torch.cat([wall, wall * torch.tensor([1, -1, 1])])
    normal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(len(position), 3)
    area = torch.full((len(position),), 0.005 * width, dtype=torch.float64)
    lean = cantilever_lean(position, position[:, 2], normal, area, (0, 3.0, 0), E, thickness, dx)
    load = 2 * width * 0.5 * 1.225 * 9.0 * 0.5  # C_D 0.5 at right angles
    inertia = 2 * width * thickness * (gap**2 / 4 + dx**2 / 12)
    # slices of one cell make an error of first order in dx, with a factor below 4 for this polynomial
    assert lean == pytest.approx(load / (20 * E * inertia), rel=4 * dx)
    twice = cantilever_lean(position, position[:, 2], normal, area, (0, 6.0, 0), E, thickness, dx)
    assert twice == pytest.approx(4 * lean)


def test_stiffness_brings_the_lean_to_its_aim():
    assert stiffness_for(LEAN) == (SHELL_E, 1.0)
    assert stiffness_for(2 * LEAN) == (pytest.approx(2 * SHELL_E), 1.0)
    modulus, wind = stiffness_for(75 * LEAN)
    assert modulus == pytest.approx(3 * SHELL_E)
    assert wind == pytest.approx(0.2)  # the force grows with the square
    assert stiffness_for(1e-9) == (pytest.approx(0.1 * SHELL_E), 1.0)


def test_thinned_splat_has_the_same_patch_area():
    cloud = FlagScene(spacing=0.0125).generate()  # 6144 equal patches
    part = thinned(cloud, 2000)
    assert len(part) == 6144 / 4
    assert float(patch_area(part.scales).sum()) == pytest.approx(float(patch_area(cloud.scales).sum()), rel=1e-5)
    assert torch.equal(thinned(cloud).scales, cloud.scales)
