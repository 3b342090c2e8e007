"""A front releases the particles that it passes."""

import pytest
import torch
from shared import solid
from torch.testing import assert_close

from gaussian_swaying import Box, MPMSolver, SimFrame, Sphere
from gaussian_swaying.mpm.pins import Impulse, SequentialRelease

from .bodies import block, lone, march

FORMULATIONS = ["total", "updated"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_scenes_of_a_batch_have_their_own_impulse_and_front(formulation):
    """The impulse is on each scene; a scene without a particle in it gets none. Each front starts at its scene."""
    one = lone([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    shifts = torch.tensor([[0, 0, 0], [3, 0, 0], [0, 0, 1]], dtype=torch.float64)
    position = torch.stack([k * one.position + shift for k, shift in zip((1, 2, 1), shifts, strict=True)])
    points = solid(position, 1e-3, 100.0, 1e3)
    region = Box([None, None, -0.5], [None, None, 0.5])
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[Impulse(region, [1, 0, 0])], gravity=(0, 0, 0))
    states = march(solver, points, 0.01, 5)
    expected = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64)
    assert_close(solver.momenta(states[-1])["linear"], expected, rtol=0, atol=1e-12)
    release = SequentialRelease(region, [1, 0, 0], 0.0, 0.04)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    fall = march(solver, points, 0.01, 3)[-1].velocity[..., 2]
    # at 0.03 s the first of three has fallen for 3 substeps and the second, released at 0.02 s, for 1
    counts = torch.tensor([[3.0, 1, 0], [3, 1, 0], [3, 3, 3]], dtype=torch.float64)
    assert_close(fall, -0.098 * counts, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("direction", [(2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 2.5, 0.0)])
def test_release_passes_over_lone_particles_in_order(formulation, direction):
    """Each falls for exactly the substeps since the front met it; the others fall from the beginning."""
    points = lone([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1, 1, 0], [0, 9, 0]])
    release = SequentialRelease(Box([None] * 3, [None, 5, None]), direction, start=0.055, end=0.355)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    along = points.position[:5] @ torch.tensor(direction, dtype=torch.float64)
    part = (along - along.min()) / (along.max() - along.min())
    times = torch.cat([0.055 + 0.3 * part, torch.zeros(1).double()])
    dt = 0.01
    for k, state in enumerate(march(solver, points, dt, 45)):
        begins = dt * torch.arange(k, dtype=torch.float64)[:, None]
        falling = (begins >= times - 1e-9).sum(0).double()
        assert_close(state.velocity[:, 2], -9.8 * dt * falling, rtol=0, atol=1e-10)
    assert bool((falling > 0).all())


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_release_lets_layers_of_a_block_fall_in_order(formulation, sign):
    points = block(e=2e3)
    rest = points.position
    release = SequentialRelease(Sphere([0, 0, 0], 9.0), [sign, 0, 0], start=0.03, end=0.13, kind="nodes")
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    dt = 5e-3
    states = march(solver, points, dt, 45)
    assert torch.equal(states[6].position, rest)
    layers = rest[:, 0].unique()
    layers = layers if sign > 0 else layers.flip(0)
    drop = torch.stack([(rest - states[24].position)[rest[:, 0] == x, 2].mean() for x in layers])
    assert bool((drop[:-1] > drop[1:] - 1e-15).all())
    assert float(drop[0]) > 0.01
    assert float(drop[-1]) < 1e-3
    # past the end nothing is held: the whole gains momentum at the rate of its weight
    gained = solver.momenta(states[45])["linear"] - solver.momenta(states[28])["linear"]
    weight = torch.tensor([0.0, 0.0, -9.8], dtype=torch.float64) * points.mass.sum()
    assert_close(gained, weight * dt * 17, rtol=1e-9, atol=1e-9)


def test_release_of_a_single_layer_is_at_its_start():
    release = SequentialRelease(Sphere([0, 0, 0], 9.0), [0, 0, 1], start=0.25, end=2.0)
    assert release.release_time(torch.rand(5, 3) * torch.tensor([1.0, 1, 0])).tolist() == [0.25] * 5


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_release_between_given_points(up):
    """The front meets them at its start and end, in any frame, and independently of the other particles."""
    scene = torch.tensor([[-1.0, 5, 0], [0.5, 0, 1], [1.0, 2, 9], [2.0, 0, 0], [3.5, 0, 0]], dtype=torch.float64)
    frame = SimFrame.fit(scene, up=up, metres_per_unit=0.5)
    release = SequentialRelease(
        Sphere([0, 0, 0], 99.0), [2.0, 0, 0], start=1.0, end=3.0, first=[0, 0, 0], last=[2, 7, 7]
    ).in_frame(frame)
    expected = [0.0, 1.5, 2.0, 3.0, 4.5]
    assert release.release_time(frame.point_to_sim(scene)).tolist() == pytest.approx(expected)
    assert release.release_time(frame.point_to_sim(scene[1:2])).tolist() == pytest.approx([1.5])
