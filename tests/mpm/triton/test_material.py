"""Laws, and what is conserved, in the fused substep.

Covers: mpm.triton.shared, mpm.triton.total_kernels, mpm.triton.updated_kernels.
"""

import dataclasses

import pytest
import torch

from gaussian_swaying.mpm.laws.fluid import Fluid

from .bodies import (
    DT,
    ELASTIC,
    FORMULATIONS,
    PLASTIC,
    check_agreement,
    make_load,
    make_points,
    make_solver,
    noise,
    on_each,
    run_in_wind,
    set_going,
)


@pytest.mark.parametrize(("kernel_device", "law"), on_each(*ELASTIC), indirect=["kernel_device"])
def test_elastic_laws_in_total(kernel_device, law):
    check_agreement(run_in_wind(make_points(kernel_device, ELASTIC[law]), "total", steps=2))


@pytest.mark.parametrize(
    ("kernel_device", "law"),
    on_each("corotated", cpu=["neo-hookean", "hencky", "sand", "sand that swells", "snow", "fluid"]),
    indirect=["kernel_device"],
)
def test_laws_in_updated(kernel_device, law):
    """Two substeps: the first scatters the given values, the second the result of the return map."""
    law = (ELASTIC | PLASTIC)[law]
    ends = run_in_wind(make_points(kernel_device, law), "updated", steps=2)
    check_agreement(ends)
    if law.plastic and not isinstance(law, Fluid):
        assert float((ends[1].F_elastic - ends[1].F_total).abs().max()) > 0.01


@pytest.mark.parametrize(
    ("kernel_device", "names"),
    on_each([*ELASTIC, *PLASTIC], cpu=[[*ELASTIC], ["neo-hookean", "fluid", "snow"]]),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} laws",
)
def test_several_laws_in_updated(kernel_device, names):
    laws = [(ELASTIC | PLASTIC)[name] for name in names]
    index = torch.randint(len(laws), (24 if len(laws) < 5 else 60,), generator=torch.Generator().manual_seed(6))
    points = make_points(kernel_device, laws, count=len(index), law_index=index)
    check_agreement(run_in_wind(points, "updated", steps=2))


@pytest.mark.parametrize(
    ("kernel_device", "names"),
    on_each([*ELASTIC], cpu=[["corotated", "neo-hookean"], ["neo-hookean", "hencky"]]),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} laws",
)
def test_several_laws_in_total(kernel_device, names):
    laws = [ELASTIC[name] for name in names]
    index = torch.randint(len(laws), (24,), generator=torch.Generator().manual_seed(6))
    check_agreement(run_in_wind(make_points(kernel_device, laws, law_index=index), "total"))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_crushed_and_inverted_particles(kernel_device, formulation):
    """If the nearest rotation is not unique, as for a reflected ball, there is nothing to compare."""

    def start(solver, points):
        if solver.neighbours_fixed:
            state = set_going(solver, points, strain=0.9)
            assert bool((torch.linalg.det(state.F_elastic) < 0).any())
            return state
        state = set_going(solver, points)
        F = state.F_elastic.clone()
        for k, stretch in enumerate(
            [(1e-3, 1, 1), (1, 2e-4, 0.5), (-0.5, 1, 1.2), (1.1, 1, -1e-3), (0, 1, 2), (2, 2, 2), (6, 0.3, 1)]
        ):
            turn = torch.linalg.qr(noise(20 + k, 3, 3))[0]
            F[k] = (turn @ torch.diag(torch.tensor(stretch, dtype=torch.float32)) @ turn.mT).to(F)
        return state.replace(F_elastic=F, F_total=F)

    check_agreement(run_in_wind(make_points(kernel_device), formulation, start=start))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_momentum(kernel_device, formulation):
    """Linear and angular momentum of a free body, to float32; angular momentum about a point within the body."""
    points = make_points(kernel_device)
    solver = make_solver("kernels", formulation, gravity=(0, 0, 0), damping=0.0)
    state = set_going(solver, points)
    if formulation == "updated":  # a spin that belongs to the stretch of the nodes, as after any substep
        state = solver.rollout(state, DT, 1)
    end = solver.rollout(state, DT, 2)
    scale = float((points.mass[:, None] * state.velocity).abs().sum())
    before, after = (solver.momenta(s) for s in (state, end))
    torch.testing.assert_close(after["linear"], before["linear"], rtol=0, atol=1e-6 * scale)
    torch.testing.assert_close(after["angular"], before["angular"], rtol=0, atol=1e-6 * scale)
    assert float((end.velocity - state.velocity).abs().max()) > 0.1


@pytest.mark.parametrize(
    ("kernel_device", "drag_step"),
    on_each("explicit", "semi_implicit"),
    indirect=["kernel_device"],
)
def test_the_work_is_what_the_energy_grows_by(kernel_device, drag_step):
    """In a body that is too soft to store any; the energies are computed separately from the work."""
    points = make_points(kernel_device)
    points = dataclasses.replace(points, youngs_modulus=torch.full_like(points.mass, 1e-6))
    solver = make_solver("kernels", "total", gravity=(0, 0, 0), damping=0.0)
    state = set_going(solver, points)
    end = solver.rollout(state, DT, 2, make_load(points, drag_step=drag_step))
    growth = solver.energies(end)["kinetic"] - solver.energies(state)["kinetic"]
    assert abs(float(growth)) > 1e-4
    # a difference of two energies in float32
    torch.testing.assert_close(end.work.float(), growth, rtol=0, atol=2e-6 * float(solver.energies(end)["kinetic"]))


@pytest.mark.gpu
def test_total_gives_the_same_bits_twice():
    pytest.importorskip("triton")
    points = make_points("cuda", count=2000)
    ends = []
    for _ in range(2):
        solver = make_solver("kernels", "total")
        ends.append(solver.rollout(set_going(solver, points), DT, 40, make_load(points)))
    for name in ("position", "velocity", "F_elastic", "node_velocity", "work"):
        assert torch.equal(getattr(ends[0], name), getattr(ends[1], name))
