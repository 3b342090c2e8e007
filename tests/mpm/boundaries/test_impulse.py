"""An impulse is applied in full and pushes only its region."""

import dataclasses
import math

import pytest
import torch
from shared import solid
from torch.testing import assert_close

from gaussian_swaying import Box, MaterialPoints, MPMSolver, PinnedRegion
from gaussian_swaying.mpm.pins import Impulse

from .bodies import block, lone, march, run_for

FORMULATIONS = ["total", "updated"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_impulse_does_not_move_what_is_pinned(formulation):
    """In either order of the two."""
    points, ends = block(), []
    pin = PinnedRegion(Box([None, None, 0.34], [None, None, None]))
    knock = Impulse(Box([None] * 3, [None] * 3), [0.5, 0.0, 0.0], end=0.02)
    for boundaries in ([pin, knock], [knock, pin]):
        ends.append(run_for(formulation, boundaries, points, 0.04, gravity=(0, 0, 0)).position)
    assert_close(ends[0], ends[1], rtol=0, atol=0)
    assert float((ends[0] - points.position).abs().max()) > 1e-4


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("dt", "start", "end"), [(1e-3, 0.0105, 0.0382), (3e-3, 0.0105, 0.0382), (2e-3, 0.0123, 0.0124)]
)
def test_impulse_arrives_whole_whatever_the_substep(formulation, dt, start, end):
    """In proportion to the time gone by within the window; substeps across its ends get their part, or all of it."""
    points = block(per_side=4)
    impulse = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    knock = Impulse(Box([None, None, 0.2], [None] * 3), impulse.tolist(), start, end)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[knock], gravity=(0, 0, 0))
    for state in march(solver, points, dt, math.ceil(0.05 / dt)):
        part = min(max((float(state.time) - start) / (end - start), 0.0), 1.0)
        assert_close(solver.momenta(state)["linear"], part * impulse, rtol=0, atol=1e-13)
        if part == 0:
            assert float(state.velocity.abs().max()) == 0.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impulse_pushes_by_mass_and_only_its_region(formulation):
    """A far body is not affected. The others get the same change of velocity at any mass, so the moment is that of the
    impulse at the region's centre of mass."""
    near, far = block(per_side=4), block(low=(2, 0, 0), per_side=4)
    points = MaterialPoints.join([near, far])
    points = dataclasses.replace(points, mass=points.mass * torch.linspace(1, 3, 128, dtype=torch.float64))
    region = Box([None, None, 0.15], [1.0, None, None])
    impulse = torch.tensor([0.3, 0.1, -0.4], dtype=torch.float64)
    solver = MPMSolver(
        dx=0.1, formulation=formulation, boundaries=[Impulse(region, impulse.tolist(), 0.0, 2e-3)], gravity=(0, 0, 0)
    )
    states = march(solver, points, 2e-3, 20)
    pushed = region.contains(points.position)
    mass, place = points.mass[pushed], points.position[pushed]
    centre = (mass[:, None] * place).sum(0) / mass.sum()
    for state in states[1:]:
        found = solver.momenta(state)
        assert_close(found["linear"], impulse, rtol=0, atol=1e-12)
        assert_close(found["angular"], torch.linalg.cross(centre, impulse), rtol=0, atol=1e-12)
        assert torch.equal(state.position[64:], points.position[64:])
    # at first only particles that share nodes with the region move; its top, with only nodes of the region, moves as
    # one
    first = states[1].velocity[:64]
    assert float(first[points.position[:64, 2] < 0.06].abs().max()) < 0.3 * float(first[pushed[:64]].abs().max())
    top = first[points.position[:64, 2] > 0.3]
    assert_close(top, (impulse / mass.sum()).expand_as(top), rtol=1e-9, atol=0)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impulse_per_particle_grows_with_their_number(formulation):
    """It also grows with the number in each scene of a batch, for any mass; counted again for another material."""
    knock = Impulse(Box([None, None, 0.2], [None] * 3), [0.01, -0.02, 0.03], end=2e-3, per_particle=True)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[knock], gravity=(0, 0, 0))
    impulse = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    for per_side, count in ((4, 32), (6, 108)):  # the upper half
        end = march(solver, block(per_side=per_side), 2e-3, 3)[-1]
        assert_close(solver.momenta(end)["linear"], count * impulse, rtol=1e-12, atol=0)
    one = lone([[0, 0, 0], [1, 0, 0.5], [2, 0, 1]])
    position = torch.stack([one.position, one.position + torch.tensor([0, 0, 5.0])])
    points = solid(position, 1e-3, 100.0, 1e3)
    end = march(solver, points, 2e-3, 3)[-1]
    expected = torch.stack([2 * impulse, 3 * impulse])
    assert_close(solver.momenta(end)["linear"], expected, rtol=1e-12, atol=0)
