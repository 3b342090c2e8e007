import subprocess
import sys

import pytest
import torch
from shared import double, in_both, near, peak, rand, solid
from torch.testing import assert_close

from gaussian_swaying import MPMSolver
from gaussian_swaying.mpm.state import GridSpec, bounding_grid
from gaussian_swaying.mpm.transfer import bspline_stencil, g2p, gather, scatter, scatter_momentum

DX = 0.1
GRID = GridSpec(DX, (0, 0, 0), (10, 10, 10))


def _particles(device, dtype, *batch, count=64):
    draw = rand(*batch, count, 16).to(device, dtype)
    return (
        0.2 + 0.6 * draw[..., :3],
        0.5 + draw[..., 3],
        draw[..., 4:7] - 0.5,
        draw[..., 7:].unflatten(-1, (3, 3)) - 0.5,
    )


def p2g(mass, velocity, affine, stencil):
    found = scatter_momentum(mass, velocity, affine, None, torch.zeros_like(affine), stencil)
    return found[..., 3], found[..., :3]


def test_round_trip_reproduces_affine_field(device, dtype):
    """APIC is exact on v(x) = v0 + A x; PIC, a transposed C or a wrong 4/dx² is not."""
    position, mass, velocity, affine = _particles(device, dtype)
    v0, a = velocity[0], affine[:1]
    expected = v0 + position @ a[0].T
    stencil = bspline_stencil(position, GRID)
    grid_mass, momentum = p2g(mass, expected, a.expand_as(affine), stencil)
    velocity, affine, gradient = g2p(momentum / grid_mass.clamp_min(1e-12)[:, None], stencil)
    tol = 1e3 * torch.finfo(dtype).eps
    assert_close(velocity, expected, rtol=tol, atol=tol)
    assert_close(affine, a.expand_as(affine), rtol=tol, atol=10 * tol)
    assert_close(gradient, a.expand_as(affine), rtol=tol, atol=10 * tol)


def test_snap_leaves_no_vanishing_weight():
    """Half-cell planes: weights that would be 1e-16 become exactly zero and the rest still sums to one."""
    position = double([[0.45, 0.5, 0.5 + 1e-9], [0.45 + 1e-9, 0.35 - 1e-9, 0.5]])
    weights = bspline_stencil(position, GRID, snap=1e-6).basis[:, 0]
    assert not ((weights > 0) & (weights < 1e-12)).any()
    assert_close(weights.sum(-1), torch.ones(2).double())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_the_border_of_a_stencil_stay_in_the_grid(dtype):
    """0.03 / 0.02 is 1.5 in one precision and a little less in another: the grid has to round as the stencil does."""
    for cells in (0.02, 0.07, 0.1, 0.3):
        for k in range(-40, 41):
            position = torch.full((1, 3), (k + 0.5) * cells, dtype=torch.float64).to(dtype)
            grid = bounding_grid(position.amin(0), position.amax(0), cells, margin=0)
            assert bspline_stencil(position, grid).inside.all(), (cells, k)


@pytest.mark.parametrize("offset", [(-3, -3, -3), (5, 5, 5)], ids=["around the origin", "beside it"])
@pytest.mark.parametrize("moments", [False, True])
def test_what_is_not_finite_or_far_away_indexes_nothing_and_weighs_nothing(device, dtype, offset, moments):
    """NaN and infinity become arbitrary integers, perhaps that of a node; they must not affect any node.

    Nor may a particle near a face, some of whose nodes lie beyond it: in a flattened grid it would act on the far side.
    """
    grid = GridSpec(0.1, offset, (8, 9, 10))
    start = torch.tensor(offset, dtype=dtype, device=device)
    good = 0.1 * (start + 2 + 4 * torch.rand(20, 3, dtype=dtype, device=device))
    bad = good[:12].clone()
    nan, inf, large = float("nan"), float("inf"), torch.finfo(dtype).max
    values = [nan, inf, -inf, large, -large, 1e10, -1e10, 2.0**31, -(2.0**31), 2.0**63, 0.1 * offset[1] + 0.04, 100.0]
    bad[range(12), [k % 3 for k in range(12)]] = torch.tensor(values, dtype=dtype, device=device)
    stencil = bspline_stencil(torch.cat([bad, good]), grid, moments)
    assert stencil.inside.tolist() == [False] * 12 + [True] * 20
    assert int(stencil.node.min()) >= 0
    assert int(stencil.node.max()) < grid.node_count
    assert int(stencil.basis[:12].count_nonzero()) == 0
    coefficients = torch.rand(32, stencil.basis.shape[1], 2, dtype=dtype, device=device)
    expected = scatter(bspline_stencil(good, grid, moments), coefficients[12:])
    assert_close(scatter(stencil, coefficients), expected)
    assert int(gather(expected, stencil)[:12].count_nonzero()) == 0


def test_gradients(device):
    position, mass, velocity, affine = _particles(device, torch.float64, 2, count=4)
    position[:, 1] = position[:, 0]
    position[:, 3] = 3.0
    inputs = [t.requires_grad_() for t in (position, mass, velocity, affine)]

    def run(x, m, v, c):
        return p2g(m, v, c, bspline_stencil(x, GRID))

    assert torch.autograd.gradcheck(run, inputs, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda *given: run(*given)[1], inputs, fast_mode=True)


@in_both
def test_deterministic_runs_have_the_same_bits(formulation, device):
    """Whole steps, and equal to those in any order to round-off."""
    position, mass, velocity, _ = _particles(device, torch.float32, count=4000)
    points = solid(position, 5e-5, 50 * mass)
    ends = []
    for fixed in (True, True, False):
        solver = MPMSolver(0.1, formulation, deterministic=fixed)
        ends.append(solver.rollout(solver.init_state(points, velocity), 5e-4, 20))
    for name in ("position", "velocity", "F_total", "affine"):
        assert torch.equal(getattr(ends[0], name), getattr(ends[1], name))
    near(ends[0].position, ends[2].position, 1e-5)


def test_scatter_momentum_is_the_sum_that_it_says(device):
    position, mass, velocity, affine = _particles("cpu", torch.float64, count=6)
    impulse, stress = torch.randn(6, 3).double(), torch.randn(6, 3, 3).double()  # not symmetric, to notice transposes
    given = [t.to(device) for t in (mass, velocity, affine, impulse, stress)]
    found = scatter_momentum(*given, bspline_stencil(position.to(device), GRID)).cpu()

    def weight(x):
        x = x.abs()
        return torch.where(x < 0.5, 0.75 - x**2, torch.where(x < 1.5, 0.5 * (1.5 - x) ** 2, torch.zeros_like(x)))

    expected = torch.zeros(GRID.node_count, 4).double()
    for i, node in enumerate(GRID.node_positions(position)):
        for p in range(6):
            d = node - position[p]
            if float(peak(d)) > 1.5 * DX:
                continue
            place = position[p].clone().requires_grad_()
            w = weight((node - place) / DX).prod()
            (gradient,) = torch.autograd.grad(w, place)
            w = w.detach()
            expected[i, :3] += w * (mass[p] * (velocity[p] + affine[p] @ d) + impulse[p]) - stress[p] @ gradient
            expected[i, 3] += w * mass[p]
    near(found, expected, 1e-12)


def test_fixed_order_is_restored_and_does_not_load_the_compiler_of_torch():
    code = (
        "import sys, torch\n"
        "from gaussian_swaying.mpm.transfer import in_fixed_order\n"
        "torch.set_deterministic_debug_mode('warn')\n"
        "with in_fixed_order(True):\n"
        "    inside = torch.get_deterministic_debug_mode()\n"
        "print(inside, torch.get_deterministic_debug_mode(), 'torch._inductor' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2", "1", "False"]
