"""A CPU sums in a fixed order: any number of threads gives the same bits."""

import pytest
import torch

from gaussian_swaying import Box, MPMSolver, PinnedRegion, UniformGust, WindField
from gaussian_swaying._fixed import assign
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.laws.sand import Sand

from .bodies import DT, FIELDS, make_body, make_load, noise

BEHIND = PinnedRegion(Box([None] * 3, [0.12, None, None]), "clamp")
CASES = {
    "total": lambda: {"boundaries": [BEHIND]},
    "total with an obstacle": lambda: {"boundaries": [BEHIND, BallObstacle([0.5, 0.5, 0.1], 0.2, 0.4)]},
    "updated": lambda: {"boundaries": [Plane([0.0, 0.0, 0.1], [0.1, 0.0, 1.0], "separate", 0.3)]},
    "sand": lambda: {"boundaries": [PinnedRegion(Box([None] * 3, [0.12, None, None]), "nodes")]},
}


@pytest.fixture
def use_threads():
    """``torch.set_num_threads``, undone afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def _end(case, dtype):
    """Of two rollouts, of which the second one is replayed, by a solver of its own."""
    generator = torch.Generator().manual_seed(0)
    place = 0.1 + 0.9 * torch.rand(3000, 3, generator=generator, dtype=torch.float64)
    place[:, 2] = 0.2 + 0.1 * place[:, 2]
    points = make_body(place.to(dtype), Sand() if case == "sand" else None)
    solver = MPMSolver(0.1, case.split()[0] if "total" in case else "updated", damping=0.3, **CASES[case]())
    state = solver.init_state(points, noise(1, *place.shape).to(dtype))
    load = make_load(points, WindField([5.0, 2.0, -1.0], modulations=[UniformGust()], seed=3))
    assign(load, normal=load.normal.to(dtype), area=load.area.to(dtype))
    if "total" not in case:
        state = solver.fit_grid(state, 40 * DT / 4)
    for _ in range(2):
        state = solver.rollout(state, DT / 4, 20, load)
    assert solver.fused() is not None
    return state


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", CASES)
def test_threads_change_no_bit(case, dtype, use_threads):
    """Nor does another run."""
    ends = []
    with torch.no_grad():
        for number in (1, 2, 4, 1):
            use_threads(number)
            ends.append(_end(case, dtype))
    assert float((ends[0].velocity - noise(1, 3000, 3)).abs().max()) > 0.5
    for end in ends[1:]:
        for name in (*FIELDS, "work", "impulse", "lost"):
            first, other = getattr(ends[0], name), getattr(end, name)
            assert (first is None and other is None) or torch.equal(first, other), name
