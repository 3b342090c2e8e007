import math

import pytest
import torch
from bench.problems.surfaces import sphere_of_gaussians
from shared import ZERO, double, in_both, solid

from gaussian_swaying import AeroForce, MPMSolver
from gaussian_swaying.geometry.patches import deform_patch

SIDE, SPACING, THICKNESS, DENSITY, AIR, C = 0.4, 0.05, 0.01, 20.0, 1.225, 1.2


def _fly(formulation, law, wind, seconds):
    axis = (torch.arange(round(SIDE / SPACING)).double() + 0.5) * SPACING
    points = solid(torch.cartesian_prod(axis, torch.zeros(1).double(), axis), SPACING**2 * THICKNESS, DENSITY)
    solver = MPMSolver(0.1, formulation, gravity=ZERO)
    aero = AeroForce(C_D=C, C_F=0.0, C_L=0.0, air_density=AIR, law=law)
    normal = double([0.0, 1.0, 0.0]).expand(points.count, 3)
    area = torch.full((points.count,), SPACING**2, dtype=torch.float64)
    flow = double([0.0, wind, 0.0])
    state = solver.init_state(points)
    for _ in range(round(seconds / 0.04)):
        steps = solver.substeps(state, 0.04)
        state = solver.fit_grid(state, 0.04)
        for _ in range(steps):
            n, a = deform_patch(state.F_total, normal, area)
            state = solver.step(state, 0.04 / steps, force=aero(flow, state.velocity, n, a))
    return float((points.mass * state.velocity[:, 1]).sum() / points.mass.sum())


@pytest.mark.slow(gate=["paper-total", "projected-updated", "linear-total", "linear-updated"])
@in_both
@pytest.mark.parametrize("law", ["paper", "projected", "linear"])
def test_a_free_plate_approaches_the_speed_of_the_wind(formulation, law):
    """v = U - U / (1 + U t / L), or U (1 - exp(-U t / L)) in linear drag, with L = 2 m / (rho A C): within 1 %."""
    length = 2 * DENSITY * THICKNESS / (AIR * C)
    for seconds in (0.08, 0.4):
        lag = math.exp(-5.0 * seconds / length) if law == "linear" else 1 / (1 + 5.0 * seconds / length)
        assert _fly(formulation, law, 5.0, seconds) == pytest.approx(5.0 * (1 - lag), rel=0.01)


# Integrals over a sphere of radius R, flow along d, with the angle a between d and the outward normal N; n = +-N along
# the flow, so that both halves feel the wind: |n.d| dA gives 2 pi R^2, (n.d)^2 dA gives 4 pi R^2 / 3.
#   paper drag       n                 2 pi R^2
#   projected drag   (n.d) n           4 pi R^2 / 3
#   friction         d - (d.n) n       4 pi R^2 - 4 pi R^2 / 3
#   side             d x n             d x (2 pi R^2 d) = 0
@pytest.mark.parametrize(
    ("options", "exact"),
    [
        ({"C_D": 1.0, "law": "paper"}, 2 * math.pi),
        ({"C_D": 1.0, "law": "projected"}, 4 * math.pi / 3),
        ({"C_F": 1.0}, 8 * math.pi / 3),
        ({"C_L": 1.0}, 0.0),
    ],
    ids=["paper", "projected", "friction", "side"],
)
def test_force_on_a_sphere_does_not_depend_on_the_gaussians_that_carry_it(options, exact):
    radius, flow = 0.5, torch.tensor([1.0, -2.0, 2.0])
    aero = AeroForce(**({"C_D": 0.0, "C_F": 0.0, "C_L": 0.0, "air_density": AIR} | options))
    unit = 0.5 * AIR * 9.0 * radius**2
    for count, overlap in ((500, 0.5), (2000, 0.3), (2000, 1.0), (6000, 0.6)):
        model = sphere_of_gaussians(count, overlap, radius)
        force = aero(flow, torch.zeros(count, 3), model.normals(), model.areas("coverage")).sum(0) / unit
        assert (force - exact * flow / 3).norm() < 0.03 * (exact or 2 * math.pi)


def test_the_literal_areas_scale_the_force_on_a_sphere_by_the_overlap():
    """Areas pi s1 s2 add up to pi overlap^2 times the surface: 0.28 to 3.1 here."""
    aero = AeroForce(C_D=1.0, C_F=0.0, C_L=0.0, air_density=AIR)
    for overlap in (0.3, 1.0):
        model = sphere_of_gaussians(2000, overlap)
        force = aero(torch.tensor([3.0, 0, 0]), torch.zeros(2000, 3), model.normals(), model.areas("paper"))
        expected = math.pi * overlap**2 * 0.5 * AIR * 9.0 * 2 * math.pi * 0.25
        assert float(force[:, 0].sum()) == pytest.approx(expected, rel=0.01)
