"""Contact in the Triton substep against torch; on a CPU in Triton's interpreter."""

import pytest
import torch

from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.contact.surface import Contact
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.mpm.triton import fused_contact

DT = 1.2e-3


def _collision(sheet, device):
    """A small sheet that flies onto one that is held at two corners, beside a moving ball."""
    below, above = sheet(5, 5, dtype=torch.float32), sheet(3, 3, (0.023, 0.017, 0.1), dtype=torch.float32)
    points = MaterialPoints.join([below, above]).map(lambda t: t.to(device))
    velocity = torch.zeros_like(points.position)
    velocity[below.count :] = torch.tensor([6.0, 0.0, -20.0], device=device)
    ball = BallObstacle([0.04, 0.04, -0.06], 0.05, 0.4)
    return points, velocity, [PinnedPoints([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]]), ball]


@pytest.mark.parametrize("iterations", [1, 4])
def test_the_kernels_do_what_torch_does(sheet, scene, device, iterations):
    """Four substeps of free flight and four of collision; round-off grows in it, but not to a thousandth of it."""
    points, velocity, boundaries = _collision(sheet, device)
    ends, taken = [], []
    for transfer in ("torch", "triton"):
        solver, state = scene(points, Contact(iterations=iterations), boundaries, velocity=velocity, transfer=transfer)
        assert solver.has_kernels == (transfer == "triton")
        state = solver.rollout(state, DT, 4)
        middle = state.velocity.clone()
        state = solver.rollout(state, DT, 4)
        ends.append(state)
        taken.append(state.impulse)
    changed = float((ends[0].velocity - middle).abs().max())
    assert changed > 5.0
    torch.testing.assert_close(ends[1].position, ends[0].position, rtol=0, atol=2e-5)
    torch.testing.assert_close(ends[1].velocity, ends[0].velocity, rtol=0, atol=1e-3 * changed)
    torch.testing.assert_close(taken[1], taken[0], rtol=0, atol=1e-4 * float(taken[0].abs().max()) + 1e-6)


def test_many_substeps_use_the_lists_again(sheet, scene, device):
    """A sheet that falls onto another is stopped as in torch, with lists that serve several substeps."""
    points, _, _ = _collision(sheet, device)
    velocity = torch.zeros_like(points.position)
    velocity[25:, 2] = -10.0
    ends = []
    for transfer in ("torch", "triton"):
        solver, state = scene(
            points, Contact(iterations=4), velocity=velocity, transfer=transfer, gravity=(0.0, 0.0, 0.0)
        )
        state = solver.rollout(state, DT, 12)
        ends.append(state)
    touching = solver.fused().touching
    assert touching.late == 0
    assert 0 < solver.bound.contact.made < 12
    assert float((ends[0].velocity[25:, 2] + 10.0).abs().max()) > 0.5  # they touched
    torch.testing.assert_close(ends[1].position, ends[0].position, rtol=0, atol=1e-4)


def test_lists_that_are_too_old_are_told(sheet, scene, device):
    """Once: points that jumped farther than the margin of the lists may have passed through each other."""
    points, velocity, _ = _collision(sheet, device)
    solver, state = scene(points, Contact(iterations=1), velocity=velocity, transfer="triton")
    state = solver.rollout(state, DT, 1)
    touching = solver.fused().touching
    jumped = state.replace(position=state.position + 10 * touching._lists.margin)
    with pytest.warns(UserWarning, match="passed through each other"):
        touching.look(jumped, DT)
    assert touching.late == 1


@pytest.mark.gpu
def test_graphs_do_what_single_substeps_do(sheet, scene):
    """On a GPU: substeps of a collision from graphs, and a new list in the middle, against torch."""
    device = torch.device("cuda")
    points, velocity, boundaries = _collision(sheet, device)
    ends = []
    for transfer in ("torch", "triton"):
        solver, state = scene(points, Contact(), boundaries, velocity=0.1 * velocity, transfer=transfer)
        for _ in range(4):
            state = solver.rollout(state, DT / 4, 80)
        ends.append(state)
    scale = float((ends[0].position - points.position).abs().max())
    assert scale > 0.05
    torch.testing.assert_close(ends[1].position, ends[0].position, rtol=0, atol=0.02 * scale)


@pytest.mark.gpu
def test_deterministic_contact_gives_the_same_bits(sheet, scene):
    device = torch.device("cuda")
    points, velocity, boundaries = _collision(sheet, device)
    ends = []
    for _ in range(2):
        solver, state = scene(points, Contact(), boundaries, velocity=velocity, transfer="auto", deterministic=True)
        ends.append(solver.rollout(state, DT, 12).position)
    assert torch.equal(*ends)
