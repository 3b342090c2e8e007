"""Compiled substeps against those that run as they are written."""

import dataclasses
import functools
import os
import shutil

import pytest
import torch

from gaussian_swaying.mpm import transfer
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

COUNT = 100


def _solver(formulation, device, compiled, youngs_modulus=1e4):
    position = 0.4 * torch.rand(COUNT, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = MaterialPoints.create(
        position.to(device), volume=0.4**3 / COUNT, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3
    )
    if isinstance(youngs_modulus, torch.Tensor):
        points = dataclasses.replace(points, youngs_modulus=youngs_modulus.expand(COUNT))
    solver = MPMSolver(dx=0.1, formulation=formulation, compile=compiled)
    velocity = torch.randn(COUNT, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).to(device)
    return solver, points, velocity


def _advance(formulation, device, compiled):
    """Substeps of different length; compiled, only the first two of a rollout may compile."""
    solver, points, velocity = _solver(formulation, device, compiled)
    with torch.no_grad():
        state = solver.init_state(points, velocity)
        for dt in (5e-4, 5e-4):
            state = solver.step(state, dt)
        with torch.compiler.set_stance("fail_on_recompile" if compiled else "default"):
            for dt in (4e-4, 3.1e-4, 6e-4, 1e-5):
                state = solver.step(state, dt)
    return state


def _gradient(formulation, device, compiled):
    youngs_modulus = torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True)
    solver, points, velocity = _solver(formulation, device, compiled, youngs_modulus)
    velocity.requires_grad_()
    end = solver.rollout(solver.init_state(points, velocity), 5e-4, 4)
    return torch.autograd.grad(end.position.square().sum() + end.F_elastic.square().sum(), [youngs_modulus, velocity])


def _compare(formulation, device):
    plain, fast = (_advance(formulation, device, compiled) for compiled in (False, True))
    for name in ("position", "velocity", "affine", "F_elastic"):
        torch.testing.assert_close(getattr(fast, name), getattr(plain, name), rtol=1e-12, atol=1e-12)
    for a, b in zip(*(_gradient(formulation, device, compiled) for compiled in (False, True)), strict=True):
        torch.testing.assert_close(b, a, rtol=1e-10, atol=1e-12 * float(a.abs().max()))


@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_traced_substeps_equal_the_plain_ones(formulation, device, monkeypatch):
    """The whole graph, forward and backward, without a code generator; sparse products are switched off."""
    torch.compiler.reset()
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="aot_eager"))
    monkeypatch.setattr(transfer, "_sparse_products", lambda factors: False)
    _compare(formulation, device)


@pytest.mark.parametrize("formulation", ["total", "updated"])
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_compiled_substeps_equal_the_plain_ones(formulation, device):
    if device.type == "cpu" and not any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "clang++")):
        pytest.skip("torch.compile on a CPU needs a C++ compiler")
    torch.compiler.reset()
    _compare(formulation, device)


def test_a_grid_that_moves_compiles_once_more(monkeypatch):
    """After its first change the number of nodes is a variable of the graph."""
    torch.compiler.reset()
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))
    solver, points, velocity = _solver("updated", torch.device("cpu"), True)
    with torch.no_grad():
        state = solver.init_state(points, velocity)
        for margin in (0, 0, 1, 1):
            state = solver.step(solver.fit_grid(state, 0.0, margin), 5e-4)
        with torch.compiler.set_stance("fail_on_recompile"):
            for margin in (2, 3, 5):
                state = solver.step(solver.fit_grid(state, 0.0, margin), 5e-4)


def test_compile_with_checkpoint_is_refused():
    solver, points, velocity = _solver("total", torch.device("cpu"), True)
    state = solver.init_state(points, velocity)
    with pytest.raises(ValueError, match="set `compile` or `checkpoint`, not both"):
        solver.rollout(state, 5e-4, 4, checkpoint=2)
