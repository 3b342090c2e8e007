"""Small bodies for the fused substep against the torch substep, which is the reference.

Compiling takes most of the time, so bodies share their options, and some cases run only on a CPU.
"""

import math

import pytest
import torch
from shared import beyond, normalized, peak, seeded, solid, up_to
from torch.testing import assert_close

from gaussian_swaying import AeroForce, MPMSolver, WindField, WindForce

TOLERANCE = 2e-5
"""Relative to the largest value of a field. A substep rounds some hundred times (half of 1.2e-7 each): in the
decomposition, and in stresses that are differences of stretches near one; sums also have another order."""

DX, DT = 0.1, 1e-3
FORMULATIONS = ["total", "updated"]
FIELDS = ["position", "velocity", "affine", "F_elastic", "F_total", "internal", "node_displacement", "node_velocity"]
WIND = WindField([5.0, 2.0, -1.0])
LEFT, TOP = up_to(x=0.12), beyond(z=0.17)


def on_each(*everywhere, cpu=()):
    gpu = [pytest.param("cuda", case, marks=pytest.mark.gpu) for case in everywhere]
    return [pytest.param("cpu", case) for case in (*everywhere, *cpu)] + gpu


def noise(seed, *shape):
    return torch.randn(*shape, generator=seeded(seed))


def make_points(device, law=None, count=24, batch=(), **more):
    place = torch.rand(*batch, count, 3, generator=seeded(0))
    return make_body((0.06 + 0.18 * place).to(device), law, **more)


def make_body(position, law=None, youngs_modulus=1e4, **more):
    mass = 0.5 + torch.rand(position.shape[:-1], generator=seeded(5))
    return solid(position, 1e-4, (100.0 * mass).to(position.device), youngs_modulus, law=law, **more)


def set_going(solver, points, strain=0.2):
    shape = points.position.shape
    state = solver.init_state(points, noise(1, *shape).to(points.position))
    if solver.neighbours_fixed:
        sizes = ((2, strain * DX), (3, 1.0))
        nodes = [size * noise(seed, *state.node_velocity.shape).to(state.position) for seed, size in sizes]
        massive = (solver.bound.node_mass > 0)[..., None]  # others never move
        return solver.bound.read_particles(state, *(torch.where(massive, value, 0.0) for value in nodes))
    F = (torch.eye(3) + strain * noise(2, *shape, 3)).to(state.position)
    total = F.mT.contiguous() if solver.laws.plastic else F
    state = state.replace(F_elastic=F, F_total=total, affine=noise(3, *shape, 3).to(F))
    if state.internal is not None:
        state = state.replace(internal=state.internal + 0.01 * noise(10, *shape[:-1]).abs().to(F))
    return state


def make_load(points, wind=WIND, seed=4, **settings):
    shape, device = points.position.shape, points.position.device
    normal = normalized(noise(seed, *shape))
    area = 0.02 * torch.rand(shape[:-1], generator=seeded(seed))
    area[..., ::5] = 0.0  # within the body
    aero = AeroForce(**{"C_L": 0.3, **settings}).to(device)
    wind = wind.to(device) if isinstance(wind, WindField) else [w.to(device) for w in wind]
    return WindForce(aero, wind, normal.to(device), area.to(device))


def make_solver(transfer, formulation="updated", **options):
    return MPMSolver(**{"dx": DX, "formulation": formulation, "damping": 0.3, "transfer": transfer, **options})


def run_both(points, run, formulation="updated", start=set_going, **options):
    found = []
    for transfer in ("torch", "kernels"):
        solver = make_solver(transfer, formulation, **options)
        with torch.no_grad():
            found.append(run(solver, start(solver, points)))
    return found


def check_agreement(ends, tolerance=TOLERANCE, names=FIELDS):
    pairs = list(zip(*(end if isinstance(end, list) else [end] for end in ends), strict=True))
    # a running total is as exact as its largest value so far, also where it comes back to nearly zero
    most = max(1e-9, *(float(peak(expected.work)) for expected, _ in pairs))
    for expected, found in pairs:
        assert torch.equal(found.lost, expected.lost)
        assert found.grid == expected.grid
        assert found.substep == expected.substep
        assert_close(found.time, expected.time)
        assert found.work.dtype == torch.float64
        # a sum over particles with both signs: the sum of its absolute terms is some sqrt(P) larger
        scale = most * math.sqrt(expected.position.shape[-2])
        assert_close(found.work, expected.work, rtol=0, atol=tolerance * scale, msg=lambda m: "work " + m)
        # what is taken is a part of the momentum of the body
        assert found.impulse.dtype == torch.float64
        scale = float(peak(expected.velocity)) * 0.01 * expected.position.shape[-2]
        scale = max([scale, *expected.impulse.abs().reshape(-1).tolist()])
        assert_close(found.impulse, expected.impulse, rtol=0, atol=tolerance * scale, msg=lambda m: "impulse " + m)
        for name in names:
            a, b = getattr(expected, name), getattr(found, name)
            assert (a is None) == (b is None), name
            if a is None:
                continue
            assert torch.isfinite(a).all(), name
            error = float(peak(b - a)) / max(float(peak(a)), 1e-30)
            assert error <= tolerance, f"{name}: {error:.1e} of its largest value"


def run_in_wind(points, formulation, steps=1, aero=None, **options):
    load = make_load(points, **(aero or {}))
    return run_both(points, lambda solver, state: solver.rollout(state, DT, steps, load), formulation, **options)
