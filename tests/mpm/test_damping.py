"""Stiffness damping: what it damps and how much, and what it does not; and the stable substep, with it and without."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from shared import EYE, ZERO, double, in_both, near, peak, rand, randn, solid, up_to, value_error
from torch.testing import assert_close

from gaussian_swaying import MaterialPoints, MPMSolver, PinnedRegion
from gaussian_swaying.mpm.damping import damped_substep, decay_rate, kelvin_voigt_pk1
from gaussian_swaying.mpm.timestep import cfl_number, stable_limit, substeps_per_frame, wave_speed
from gaussian_swaying.mpm.transfer import bspline_stencil


def _bar(counts, spacing, e=2e4, nu=0.0):
    axes = [(torch.arange(n).double() + 0.5) * spacing for n in counts]
    position = torch.cartesian_prod(*axes)
    return solid(position, spacing**3, 100.0, e, nu)


# ---- the stress


def test_stress_is_the_rate_of_the_saint_venant_kirchhoff_stress():
    """P = beta F dS/dt with S = 2 mu E + lam tr(E) I, by a central difference in time.

    So it removes energy, keeps angular momentum, and turns with the body.
    """
    F = EYE + 0.3 * randn(20, 3, 3)
    rate = randn(20, 3, 3)
    mu, lam = 1 + rand(2, 20)

    def second(t):
        G = F + t * rate
        E = 0.5 * (G.mT @ G - EYE)
        return 2 * mu[:, None, None] * E + (lam * E.diagonal(dim1=-2, dim2=-1).sum(-1))[:, None, None] * EYE

    expected = 0.07 * F @ (second(1e-4) - second(-1e-4)) / 2e-4
    assert_close(kelvin_voigt_pk1(F, rate, mu, lam, 0.07), expected, rtol=1e-8, atol=1e-9)


# ---- whole steps


@in_both
def test_a_turn_is_not_damped(formulation):
    """A free block that spins, with damping so strong that every vibration is overdamped."""
    points = _bar((6, 6, 6), 0.4 / 6, e=5e3, nu=0.3)
    solver = MPMSolver(0.1, formulation, gravity=ZERO, stiffness_damping=0.02)
    centre = points.position.mean(0)
    spin = double([[0, -0.8, -0.5], [0.8, 0, -0.3], [0.5, 0.3, 0]])
    state = solver.init_state(points, (points.position - centre) @ spin.T, margin=6)
    affine = spin.expand_as(state.affine)
    if formulation == "updated":
        state = state.replace(affine=affine)
    else:
        place = state.grid.node_positions(centre) - centre
        state = state.replace(node_velocity=place @ spin.T, affine=affine)
    before = solver.momenta(state)["angular"]
    steps = solver.substeps(state, 0.25)
    state = solver.rollout(state, 0.25 / steps, steps)
    near(solver.momenta(state)["angular"], before, 1e-11 * float(before.norm()))
    # the centrifugal strain is rho omega² L² / (8 E) = 4e-4
    turn = torch.linalg.matrix_exp(0.25 * spin)
    near(state.F_elastic, turn.expand_as(state.F_elastic), 2e-3)


@pytest.mark.slow(gate=["updated"])
@in_both
def test_damping_in_proportion_to_frequency(formulation):
    """Energy ~ exp(-beta omega² t), four periods of 0.056 s; and dissipated energy never comes back."""
    points = _bar((8, 2, 2), 0.05)
    velocity = torch.zeros_like(points.position)
    velocity[:, 0] = 0.05 * torch.cos(math.pi * points.position[:, 0] / 0.4)
    left = {}
    for beta in (0.0, 5e-4, 1e-3):
        solver = MPMSolver(0.1, formulation, gravity=ZERO, stiffness_damping=beta)
        state = solver.init_state(points, velocity)
        energy = []
        for _ in range(224):  # four periods
            state = solver.step(state, 1e-3)
            energy.append(float(sum(solver.energies(state).values())))
        left[beta] = math.log(sum(energy[-56:]) / sum(energy[:56]))
        if beta:
            # an elastic energy of half a substep ago beside a kinetic one of now: a ripple of omega dt
            smooth = torch.tensor(energy).unfold(0, 28, 28).mean(-1)
            assert (smooth.diff() < 0).all()
    small, large = left[5e-4] - left[0.0], left[1e-3] - left[0.0]
    # the means are three periods apart; lumped mass and half cells at its ends change omega by a few per cent
    assert small == pytest.approx(-5e-4 * (2 * math.pi / 0.056) ** 2 * 0.168, rel=0.2)
    assert large == pytest.approx(2 * small, rel=0.08)


# ---- the substep


@in_both
def test_solver_divides_a_frame_by_the_damped_substep(formulation):
    """Its Courant number is that of the equally stable undamped substep: `cfl` for the longest substep."""
    points = _bar((3, 3, 3), 0.1, nu=0.3)
    cells = float(cfl_number(1.0, 0.1, wave_speed(points), None))
    undamped = float(stable_limit(points, 0.1).amin())
    counts = []
    for beta in (0.0, 1e-4, 1e-3, 1e-2):
        solver = MPMSolver(0.1, formulation, cfl=0.4, stiffness_damping=beta)
        state = solver.init_state(points)
        longest = damped_substep(0.4 / cells, beta)
        counts.append(solver.substeps(state, 0.04))
        assert counts[-1] == math.ceil(0.04 / longest - 1e-6)
        assert float(solver.cfl_number(state, longest)) == pytest.approx(0.4, rel=1e-9)
        assert float(solver.cfl_number(state, 0.04 / counts[-1])) <= 0.4 * (1 + 1e-9)
        assert solver.stable_substep() == pytest.approx(damped_substep(undamped, beta), rel=1e-9)
        substep = 1.01 * solver.stable_substep()
        fixed = MPMSolver(0.1, formulation, substep=substep, stiffness_damping=beta)
        with value_error(r"fixed `substep` of .* longer than the stable one"):
            fixed.substeps(fixed.init_state(points), 0.04)
    assert counts == sorted(set(counts))
    assert counts[-1] > 4 * counts[0]


# ---- the damping of the material


def _swing(stiffer, rate=0.0, beta=0.0):
    """Frequency [rad/s] and damping ratio of the lowest bending mode, from the logarithmic decrement; the energies."""
    points = _bar((30, 3, 3), 0.1 / 3, e=2e4 * stiffer**2)
    points = replace(points, damping=torch.full_like(points.mass, rate)) if rate else points
    pin = PinnedRegion(up_to(x=0.2), kind="clamp")
    solver = MPMSolver(0.1, gravity=ZERO, boundaries=[pin], stiffness_damping=beta)
    x = 1.875104 * ((points.position[:, 0] - 0.2) / 0.8).clamp(min=0)
    shape = torch.cosh(x) - torch.cos(x) - 0.734096 * (torch.sinh(x) - torch.sin(x))  # clamped-free, textbook
    velocity = torch.zeros_like(points.position)
    velocity[:, 2] = 1e-3 * shape
    state, dt, height, energy = solver.init_state(points, velocity), 2e-3 / stiffer, [], []
    for _ in range(160):
        state = solver.rollout(state, dt, 20)
        height.append(float((points.mass * shape * (state.position - points.position)[:, 2]).sum()))
        energy.append(float(sum(solver.energies(state).values())))
    found = double(height).abs()
    peaks = ((found[1:-1] > found[:-2]) & (found[1:-1] >= found[2:])).nonzero()[:, 0] + 1
    low, top, high = (found[peaks + k] for k in (-1, 0, 1))
    bend = low - 2 * top + high  # a parabola through the largest three
    size, place = top - 0.125 * (high - low) ** 2 / bend, peaks + 0.5 * (low - high) / bend
    half, decrement = float(place.diff().mean()) * 20 * dt, -2 * float(size.log().diff().mean())
    return math.pi / half, decrement / math.hypot(2 * math.pi, decrement), energy


@pytest.mark.parametrize(("share", "beta"), [(1.0, 0.0), (0.6, 1e-2)])
def test_a_cantilever_has_the_damping_ratio_at_two_frequencies(share, beta):
    """Rayleigh: rate / (2 omega) + beta omega / 2; the energy never grows."""
    first = _swing(1)[0]
    rate = share * decay_rate(0.05, first / (2 * math.pi))
    for stiffer in (1, 2):
        omega, ratio, energy = _swing(stiffer, rate, beta / stiffer)
        assert omega == pytest.approx(stiffer * first, rel=0.01)
        assert ratio == pytest.approx(rate / (2 * omega) + beta / stiffer * omega / 2, rel=0.02)
        tops = [max(energy[k : k + 20]) for k in range(0, 160, 20)]  # velocities are half a substep behind
        assert all(after < before for before, after in pairwise(tops))


def test_each_part_has_its_own_damping():
    one, other = (_bar((4, 2, 2), 0.05) for _ in range(2))
    far = replace(other, position=other.position + 2.0, damping=torch.full_like(other.mass, 3.0))
    points = MaterialPoints.join([one, far])
    assert points.damping[: one.count].tolist() == [0.0] * one.count
    solver = MPMSolver(0.1, gravity=ZERO)
    velocity = torch.ones_like(points.position)
    state = solver.rollout(solver.init_state(points, velocity), 1e-3, 100)
    expected = torch.exp(-0.1 * points.damping)[:, None].expand(-1, 3)
    assert_close(state.velocity, expected, rtol=1e-12, atol=1e-12)
    stacked = MaterialPoints.stack([one, replace(one, damping=torch.ones_like(one.mass))])
    assert stacked.damping.mean(-1).tolist() == [0.0, 1.0]


def test_damping_of_the_material_is_refused_in_updated_and_below_zero():
    bar = _bar((3, 3, 3), 0.1)
    with value_error(r"`material.damping_ratio` sets, needs `solver.formulation: total`"):
        MPMSolver(0.1, "updated").init_state(replace(bar, damping=torch.ones_like(bar.mass)))
    numbers = {"volume": 1e-3, "density": 1.0, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
    with value_error("`damping` not to be negative"):
        MaterialPoints.create(bar.position, damping=-1.0, **numbers)


# ---- the stable substep: the formulas, and that the solver is stable just below and unstable above them


def _points(position, e=1e4, nu=0.3, density=100.0):
    return solid(position, 1e-6, density, e, nu)


def test_frame_is_divided_without_losing_a_substep():
    """int(4e-2 / 2e-5) is 1999."""
    assert substeps_per_frame(4e-2, 2e-5, exact=True) == 2000
    assert substeps_per_frame(4e-2, 2e-5, exact=False) == 2000
    assert substeps_per_frame(0.04, 0.03, exact=False) == 2
    assert substeps_per_frame(0.04, 1.0, exact=False) == 1


@pytest.mark.slow(gate=["0.0", "1.0"])
@pytest.mark.parametrize("damping", [0.0, 0.05, 1.0, 30.0])
def test_limit_is_sharp_for_one_particle(damping):
    """The bound is reached as a particle nears a plane where a weight vanishes, in the mode v_i = grad(w_i) / w_i.

    Also where stiffness damping, here in undamped limits, shortens it.
    """
    position = torch.full((1, 3), 0.05001, dtype=torch.float64)
    points = _points(position, nu=0.3)
    undamped = float(stable_limit(points, 0.1).amin())
    solver = MPMSolver(0.1, gravity=ZERO, stiffness_damping=damping * undamped)
    limit = damped_substep(undamped, solver.stiffness_damping)
    assert (limit < undamped) == (damping > 0)
    for factor, stable in ((0.98, True), (1.02 if damping == 0 else 1.05, False)):
        state = solver.init_state(points)
        stencil = bspline_stencil(position, state.grid)
        mode = torch.zeros_like(state.node_velocity)
        mode[stencil.node[0]] = 1e-9 * (stencil.basis[0, 1:4] / stencil.basis[0, 0]).T
        end = solver.rollout(state.replace(node_velocity=mode), factor * limit, 400, check=False)
        strain = float(peak(end.F_elastic - EYE))
        assert (strain < 1e-6) == stable, (factor, strain)


@in_both
@pytest.mark.parametrize(("nu", "damping"), [(0.0, 0.0), (0.3, 0.0), (0.45, 0.0), (0.0, 2.0), (0.45, 2.0)])
def test_random_bodies_are_stable_below_the_limit(formulation, nu, damping):
    """With stiffness damping, in undamped limits, the damped one."""
    points = _points(0.15 * rand(40, 3), nu=nu)
    time = damping * float(stable_limit(points, 0.05).amin())
    solver = MPMSolver(0.05, formulation, gravity=ZERO, stiffness_damping=time)
    kick = 1e-6 * torch.randn_like(points.position)
    state = solver.init_state(points, kick)
    end = solver.rollout(state, 0.98 * solver.stable_substep(), 150)
    assert peak(end.velocity) < 2 * peak(kick)


def test_cfl_of_0_47_never_exceeds_the_limit():
    for nu in (0.0, 0.2, 0.4, 0.49, 0.4999):
        points = _points(torch.zeros(1, 3).double(), nu=nu)
        assert 0.47 / float(wave_speed(points)) <= float(stable_limit(points, 1.0))


def test_stretch_shortens_the_substep():
    points = _points(torch.zeros(1, 3).double())
    stretched = torch.diag(double([2.0, 2.0, 0.5]))[None]
    assert float(stable_limit(points, 1.0, stretched)) < 0.5 * float(stable_limit(points, 1.0))
    assert float(wave_speed(points, stretched)) > 1.5 * float(wave_speed(points))
    assert float(wave_speed(points, stretched, spatial=True)) == pytest.approx(2 * float(wave_speed(points, stretched)))


def test_rounding_does_not_lengthen_a_fixed_substep_beyond_the_stable_one():
    points = _points(rand(20, 3))
    solver = MPMSolver(0.1)
    solver.init_state(points)
    limit = solver.stable_substep()
    fixed = MPMSolver(0.1, substep=limit)
    assert fixed.substeps(fixed.init_state(points), 1.49 * limit) == 2
