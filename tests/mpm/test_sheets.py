import dataclasses

import pytest
import torch
from catalogue import ELASTIC
from shared import EYE, double, peak, randn, seeded, solid, unit, value_error
from torch.testing import assert_close

from gaussian_swaying import MaterialPoints, MPMSolver
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.mpm.laws.law import lame_parameters
from gaussian_swaying.mpm.sheets import bending_of, director_energy, in_plane_stress, stress_of_sheets

NU = 0.3


def turned(seed):
    if seed == 0:
        return EYE
    return polar_rotation(randn(3, 3, generator=seeded(seed)))


def sheet(rotation, size=6, per_cell=2.2, bending=0.7, heights=(0.0,), dtype=torch.float64, **more):
    side = torch.arange(round(size * per_cell)).double() / per_cell - size / 2 + 0.13
    flat = torch.cartesian_prod(side, side, double(heights))
    normal = rotation[:, 2].expand(len(flat), 3).to(dtype)
    area = per_cell**-2
    return solid(
        (flat @ rotation.T + 0.21).to(dtype), 0.1 * area, 1.0, 100.0, NU, normal=normal, bending=bending * area, **more
    )


def bound(points, **options):
    solver = MPMSolver(1.0, **({"gravity": (0, 0, 0), "transfer": "torch"} | options))
    return solver, solver.init_state(points)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_energy_is_that_of_kirchhoffs_plate_in_any_direction(seed):
    """Of a curved, a twisted and a saddle-shaped plate: quadratic splines have their exact second derivatives."""
    rotation = turned(seed)
    points = sheet(rotation)
    solver, _ = bound(points)
    form = solver.bound
    place = (form.node_positions(points.position) - 0.21) @ rotation
    a, b = place[:, 0], place[:, 1]
    area, D = 1 / 2.2**2 * len(points.position), 0.7
    for height, density in (
        (0.05 * a**2, 0.1**2),
        (0.05 * (a**2 + b**2), 2 * (1 + NU) * 0.1**2),
        (0.05 * (a**2 - b**2), 2 * (1 - NU) * 0.1**2),
        (0.1 * a * b, 2 * (1 - NU) * 0.1**2),
    ):
        energy = float(form.bending.energy(height[:, None] * rotation[:, 2]))
        assert energy == pytest.approx(0.5 * D * density * area, rel=1e-10)


def test_a_softened_point_bends_as_much_more_easily():
    points = sheet(turned(1), size=3)
    form = bound(points)[0].bound
    moved = torch.randn(form.node_positions(points.position).shape, generator=seeded(0)).double()
    share = double([0.25] * len(points.position))
    soft = bending_of(points, form.stencil, 1.0, share)
    assert_close(soft.forces(moved), 0.25 * form.bending.forces(moved))


def test_motion_without_curvature_has_no_force():
    points = sheet(turned(1))
    solver, _ = bound(points)
    nodes = solver.bound.node_positions(points.position)
    for map_ in (turned(3), EYE + 0.3 * turned(4)):
        moved = nodes @ map_.T + 0.4 - nodes
        assert peak(solver.bound.bending.forces(moved)) < 1e-12


def test_forces_are_those_of_the_energy_and_keep_both_momenta():
    points = sheet(turned(1), size=3)
    solver, _ = bound(points)
    form, generator = solver.bound, seeded(0)
    nodes = form.node_positions(points.position)
    moved = randn(nodes.shape, generator=generator).requires_grad_()
    (slope,) = torch.autograd.grad(form.bending.energy(moved) * 1.0, moved)
    force = form.bending.forces(moved.detach())
    assert_close(force, -slope, rtol=1e-10, atol=1e-10)
    assert peak(force.sum(0)) < 1e-10 * force.abs().sum()
    torque = torch.linalg.cross(nodes + moved.detach(), force).sum(0)
    assert peak(torque) < 1e-10 * force.abs().sum()


def test_a_curved_sheet_feels_the_change_of_its_curvature_alone():
    radius, per_cell = 20.0, 2.2
    count = round(12 * per_cell)
    angle = (torch.arange(count).double() - count / 2) / per_cell / radius
    along = torch.arange(round(6 * per_cell)).double() / per_cell
    s, y = torch.cartesian_prod(angle, along).T
    position = torch.stack([radius * s.sin(), y, radius * s.cos() - radius], -1)
    normal = torch.stack([s.sin(), 0 * s, s.cos()], -1)
    points = solid(position, 0.01, 1.0, 100.0, 0.0, normal=normal, bending=1.0)
    solver, state = bound(points)
    form = solver.bound
    assert float(form.bending.energy(state.node_displacement)) == 0
    nodes = form.node_positions(position)
    out = (nodes[:, 0].square() + (nodes[:, 2] + radius).square()).sqrt()
    turn = torch.atan2(nodes[:, 0], nodes[:, 2] + radius)
    flat = torch.stack([radius * turn, nodes[:, 1], out - radius], -1)
    energy = float(form.bending.energy(flat - nodes))
    # the splines interpolate with the values of the map, and smooth it over a cell: (dx / radius)^2 and as much in F
    assert energy == pytest.approx(0.5 * len(points.position) / radius**2, rel=0.02)


def test_sheets_in_one_cell_bend_each_for_itself():
    generator = seeded(0)
    for other in (sheet(turned(1)), sheet(turned(2))):
        parts = [sheet(turned(1)), other]
        forms = [bound(points)[0].bound for points in (*parts, MaterialPoints.join(parts))]
        shape = randn(3, 3, generator=generator)
        bends = [
            float(form.bending.energy((form.node_positions(parts[0].position) @ shape).square().sin()))
            for form in forms
        ]
        assert bends[0] > 0
        assert bends[2] == pytest.approx(bends[0] + bends[1], rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_largest_frequency_is_found_and_bounds_the_substep(seed):
    points = sheet(turned(seed), size=3, bending=40.0)
    solver, state = bound(points)
    form = solver.bound
    mass = form.node_mass
    moving = (mass > 0).nonzero()[:, 0]
    forces = [form.bending.forces(torch.eye(len(mass)).double()[:, [k, k, k]])[:, 0] for k in moving]
    root = form.node_inverse_mass[moving].sqrt()
    matrix = -torch.stack(forces)[:, moving] * root * root[:, None]
    largest = float(torch.linalg.eigvalsh(matrix)[-1])
    assert form.bending_rate == pytest.approx(largest, rel=0.02)
    without = bound(dataclasses.replace(points, normal=None, bending=None))[0]
    assert solver.stable_substep(state) < 0.7 * without.stable_substep(None)
    noise = 1e-4 * randn(points.position.shape, generator=seeded(0))
    start = solver.init_state(points, noise)
    calm = solver.rollout(start, 0.99 * solver.stable_substep(start), 400)
    assert peak(calm.velocity) < 2 * peak(noise)


@pytest.mark.parametrize("name", ELASTIC)
def test_the_stress_of_a_sheet_is_the_slope_of_its_energy(name):
    law = ELASTIC[name]
    generator = seeded(0)
    count = 50
    F = EYE + 0.3 * randn(count, 3, 3, generator=generator)
    normal = unit(count, 3, generator=generator)
    normal[:5] = 0
    F[:5] = EYE
    mu, lam = (torch.full((count,), value, dtype=torch.float64) for value in (3.0, 4.0))
    F.requires_grad_()
    energy = law.energy(in_plane_stress(F, normal, mu, lam), mu, lam) + director_energy(F, normal, mu)
    (slope,) = torch.autograd.grad(energy.sum(), F)
    stress = stress_of_sheets(F.detach(), normal, mu, lam, lambda own: law.pk1(own, mu, lam))
    assert_close(stress, slope, rtol=1e-8, atol=1e-8)


def test_a_sheet_is_stretched_as_in_plane_stress():
    """E / (1 - nu^2) across a strip that cannot narrow, E along one that can; and it gets thinner by nu / (1 - nu)."""
    mu, lam = (torch.full((1,), value, dtype=torch.float64) for value in lame_parameters(1.0, NU))
    normal = double([[0.0, 0.0, 1.0]])
    stretch = torch.diag(double([1e-6, 0.0, 0.7]))[None] + EYE
    law = ELASTIC["corotated"]
    flat = in_plane_stress(stretch, normal, mu, lam)
    stress = law.pk1(flat, mu, lam)
    assert float(stress[0, 0, 0]) == pytest.approx(1e-6 / (1 - NU**2), rel=1e-5)
    assert float(stress[0, 2, 2]) == pytest.approx(0, abs=1e-11)
    assert float(flat[0, 2, 2]) - 1 == pytest.approx(-1e-6 * NU / (1 - NU), rel=1e-4)


def test_the_state_has_the_normal_of_the_sheet():
    """Whatever the nodes do across it: F of a state turns the normal as the middle plane turns."""
    points = sheet(turned(1))
    for transfer in ("torch", "kernels"):
        solver, state = bound(points, transfer=transfer)
        state = solver.init_state(points, 0.5 * points.position[..., [1, 2, 0]].sin())
        F = solver.rollout(state, 0.5 * solver.stable_substep(state), 40).F_elastic
        out = (F @ points.normal[..., None])[..., 0]
        along = F @ (EYE - points.normal[..., :, None] * points.normal[..., None, :])
        assert peak(out[..., None, :] @ along) < 1e-12
        assert peak(F - EYE) > 0.05


def test_wrong_numbers_are_refused():
    good = {"volume": 1.0, "density": 1.0, "youngs_modulus": 1.0, "poisson_ratio": 0.0}
    for given, what in (
        ({"bending": 1.0}, "`bending` needs `normal`"),
        ({"normal": torch.zeros(4, 3)}, "`normal` needs `bending`"),
        ({"normal": torch.zeros(3, 3), "bending": 1.0}, "`normal`"),
        ({"normal": torch.zeros(4, 3), "bending": -1.0}, "`bending`"),
    ):
        with value_error(what):
            MaterialPoints.create(torch.rand(4, 3), **good, **given)


def test_joined_bodies_keep_their_bending():
    bends, limp = sheet(turned(1)), dataclasses.replace(sheet(turned(2)), normal=None, bending=None)
    both = MaterialPoints.join([limp, bends])
    assert torch.equal(both.bending[limp.count :], bends.bending)
    assert not both.bending[: limp.count].any()
    assert torch.equal(both.normal[limp.count :], bends.normal)
