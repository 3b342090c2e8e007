import gc
import math
from functools import partial

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import ZERO, in_both, peak, rand, seeded, up_to

from gaussian_swaying import (
    Box,
    GaussianGust,
    MPMSolver,
    PinnedRegion,
    SimulationDiverged,
    SineSway,
    UniformGust,
    WindField,
)
from gaussian_swaying._fixed import assign
from gaussian_swaying.geometry.regions import HalfSpace, Sphere
from gaussian_swaying.mpm import run, total, updated
from gaussian_swaying.mpm.colliders import Obstacle, VelocityBox, Wall
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.simulation.measure import measure
from gaussian_swaying.wind.field import FlowKey

from .bodies import (
    DT,
    DX,
    FIELDS,
    FORMULATIONS,
    LEFT,
    TOLERANCE,
    WIND,
    check_agreement,
    make_body,
    make_load,
    make_points,
    make_solver,
    noise,
    on_each,
    run_both,
    run_in_wind,
    set_going,
)


@in_both
def test_a_substep_that_changes(kernel_device, formulation):
    """Forces act for the mean of the old and the new one, at most twice the new one."""
    points = make_points(kernel_device)
    load = make_load(points)

    def run(solver, state):
        states = []
        for dt, steps in ((1e-3, 1), (4e-4, 2), (1e-4, 1)):
            state = solver.rollout(state, dt, steps, load)
            states.append(state)
        return states

    check_agreement(run_both(points, run, formulation))


@in_both
def test_rollouts_in_parts(kernel_device, formulation, monkeypatch):
    monkeypatch.setattr(run, "MAX_STEPS", 4)
    monkeypatch.setattr(updated, "sorted_for", lambda *known: 2)
    wind = WindField(schedule=[FlowKey(0.0, [0.0] * 3), FlowKey(5 * DT, [30.0, 0.0, 0.0])], interpolation="linear")
    points = make_points(kernel_device, count=12, batch=(2,))
    load = make_load(points, [wind, WIND])

    def start(solver, points):
        state = set_going(solver, points, strain=0.05)
        return state if solver.neighbours_fixed else state.replace(velocity=10 * state.velocity)  # across cells

    ends = run_both(points, lambda solver, state: solver.rollout(state, DT, 5, load), formulation, start=start)
    check_agreement(ends)


@pytest.mark.slow(gate=["cpu-corotated, total", "cpu-sand, updated"])
@pytest.mark.parametrize(
    ("kernel_device", "case"),
    on_each(
        *((law, formulation) for law in ("corotated", "springs") for formulation in FORMULATIONS),
        ("sand", "updated"),
        cpu=[("hencky", "total"), ("metal", "updated"), ("springs and hencky", "total"), ("neo-hookean", "updated")],
    ),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else ", ".join(value),
)
def test_looks_on_the_way(kernel_device, case, monkeypatch):
    """The largest Courant number seen, and the same motion; some checks fall between two sorts of the particles.

    With several energies, or with one that has no kernel, the checks run in torch, between the kernels' substeps.
    """
    monkeypatch.setattr(updated, "sorted_for", lambda *known: 2)
    laws, formulation = case[0].split(" and "), case[1]
    index = torch.arange(24) % 2 if len(laws) > 1 else None
    points = make_points(kernel_device, [(ELASTIC | PLASTIC)[law] for law in laws], law_index=index)

    def run(solver, state):
        if solver.transfer == "kernels" and solver.kernels.watches:
            assert solver.bound.longest_substep > DT  # of the material at rest, in torch, once
            monkeypatch.setattr(solver.laws, "moduli", None)  # the measured values stay in the kernels
        return solver.watched_rollout(state, DT, 3, make_load(points), 3)

    found = run_both(points, run, formulation)
    check_agreement([state for state, _ in found])
    assert float(found[1][1]) == pytest.approx(float(found[0][1]), rel=2 * TOLERANCE)


@pytest.mark.gpu
@pytest.mark.parametrize("wide", [False, True], ids=["of one number", "of four numbers"])
def test_atomic_sums(wide, monkeypatch):
    if wide and torch.cuda.get_device_capability() < (9, 0):
        pytest.skip("this GPU has no such instruction")
    monkeypatch.setattr(updated, "wide", lambda device: wide)
    points = make_points(torch.device("cuda"), PLASTIC["sand"], count=100)
    check_agreement(run_both(points, lambda solver, state: solver.rollout(state, DT, 3), "updated"))


@pytest.mark.gpu
@in_both
def test_many_substeps(formulation):
    """Round-off grows in fifty substeps, though not by much where the motion is stable."""
    pytest.importorskip("triton")

    def start(solver, points):
        return set_going(solver, points, strain=0.02)

    ends = run_in_wind(make_points("cuda", count=2000), formulation, steps=50, start=start)
    check_agreement(ends, tolerance=2e-4)


# ---- rollouts from graphs


def _gusty():
    gusts = [SineSway(period=0.01), GaussianGust(1.0, interval=2 * DT)]
    return WindField(schedule=[FlowKey(0.0, [5.0, 0.0, 0.0]), FlowKey(0.004, [0.0, 5.0, 1.0])], modulations=gusts)


REPLAYED = {
    "a hinge": {"boundaries": lambda: [PinnedRegion(LEFT)]},
    "nodes, crowded cells": {"boundaries": lambda: [PinnedRegion(LEFT, "nodes")], "count": 40},
    "a handle": {"boundaries": lambda: [PinnedRegion(LEFT, velocity=[0.5, 0.0, 0.2])]},
    "a batch": {"boundaries": lambda: [PinnedRegion(LEFT)], "batch": (2,)},
    "no wind": {"boundaries": lambda: [], "wind": False},
}


@pytest.mark.slow(gate=["cpu-a hinge", "cpu-no wind"])
@pytest.mark.parametrize("case", REPLAYED)
def test_replayed_rollouts_give_the_same_bits(kernel_device, case, monkeypatch):
    steps = 37 if kernel_device.type == "cuda" else 5
    monkeypatch.setattr(total, "_PROGRAMS", 1 if case == "nodes, crowded cells" else 2048)
    given = REPLAYED[case]
    points = make_points(kernel_device, count=given.get("count", 12), batch=given.get("batch", ()))
    solver = make_solver("kernels", "total", boundaries=given["boundaries"]())
    wind = [_gusty(), WIND] if "batch" in given else _gusty()
    forces = [make_load(points, wind)] if given.get("wind", True) else []
    start = set_going(solver, points, strain=0.05)

    def go(state, count=steps):
        with torch.no_grad():
            return solver.watched_rollout(state, DT, count, forces, 3)

    first, cells = go(start)
    kept = {name: getattr(first, name).clone() for name in (*FIELDS, "work", "impulse", "time") if name != "internal"}
    for _ in range(2):
        again, its_cells = go(start)
        assert float(its_cells) == float(cells)
        for name, value in kept.items():
            assert torch.equal(getattr(again, name), value), name
    go(again, steps - 2)
    for name, value in kept.items():
        assert torch.equal(getattr(first, name), value), name
        assert torch.equal(getattr(again, name), value), name


@in_both
def test_a_replayed_rollout_follows_what_changes(kernel_device, formulation):
    points = make_points(kernel_device, count=12)
    schedule = WindField(schedule=[FlowKey(0.005, [30.0, 0.0, 0.0])])
    load, other = make_load(points), make_load(points, schedule, seed=7, C_D=2.0)
    turning = PinnedRegion(
        LEFT,
        velocity=[0.5, 0.0, 0.2],
        angular_velocity=[0.0, 9.0, 3.0],
        pivot=[0.1, 0.1, 0.1],
        start=1e-4,
        end=5.5 * DT,
    )

    def run(solver, state):
        states = [solver.rollout(state, DT, 2, load) for _ in range(3)]
        load.area *= 2
        load.aero.C_D += 1.0
        states += [solver.rollout(state, DT, 2, load) for _ in range(2)]
        load.wind.flows *= 0.5
        states += [solver.rollout(state, DT, 2, forces) for forces in (load, load, load, other, other)]
        states += [solver.rollout(states[-1], 0.7 * DT, steps, load) for steps in (5, 3, 1, 4)]
        last = states[-1]
        if formulation == "updated":
            last = last.replace(grid=GridSpec(DX, (-2, -2, -2), (8, 8, 9)))
        states += [solver.rollout(last, DT, 2, forces) for forces in (load, None, load)]
        load.area /= 2
        load.aero.C_D -= 1.0
        load.wind.flows *= 2
        return states

    start = partial(set_going, strain=0.02)
    ends = run_both(points, run, formulation, start, boundaries=[turning] if formulation == "updated" else [])
    check_agreement(ends, tolerance=1e-4)


def test_a_grid_that_comes_back(kernel_device):
    points = make_points(kernel_device)
    count = 4 if kernel_device.type == "cuda" else 1
    boundaries = [Wall(HalfSpace([0.0, 0.0, 0.13], [0.0, 0.0, 1.0]))]
    solvers = [make_solver(transfer, boundaries=boundaries) for transfer in ("torch", "kernels")]
    state, _ = (set_going(solver, points) for solver in solvers)
    load = make_load(points)
    near, far = GridSpec(DX, (-2, -2, -2), (8, 8, 8)), GridSpec(DX, (-4, -3, -2), (8, 8, 7))
    larger = GridSpec(DX, (-8, -8, -8), (20, 20, 20))  # needs other buffers
    for grid in (near, near, far, far, near, far, larger, near):
        check_agreement([solver.rollout(state.replace(grid=grid), DT, count, load) for solver in solvers])


def _cloud(count, seed=8):
    """Particles of a box of half a metre."""
    return make_body(0.5 * torch.rand(count, 3, generator=seeded(seed)).cuda(), youngs_modulus=0.01)


@pytest.mark.gpu
def test_grids_that_grow_take_the_memory_of_the_largest():
    """Two hundred grids of up to 2.7 million nodes, each with graphs of its own.

    The most memory in use is the buffers and graphs of the largest grid, those of the grid before, and the temporaries
    of the substeps that were not recorded: three times the memory of the largest grid alone.
    """
    pytest.importorskip("triton")
    points = _cloud(500)
    far = VelocityBox(Box([8.0] * 3, [9.0] * 3), [0.0, 1.0, 0.0])  # in torch, which takes the most memory
    planes = [Wall(HalfSpace([0.0, 0.0, -0.2], [0.0, 0.0, 1.0])), Wall(Box([-9.0] * 3, [9.0] * 3)), far]

    def most_reserved(sizes):
        solver = MPMSolver(0.02, "updated", transfer="kernels", boundaries=planes)
        state, most = solver.init_state(points), 0
        for size in sizes:
            state = state.replace(grid=GridSpec(0.02, (-20, -20, -20), (size, size, size)))
            for _ in range(2):
                state = solver.rollout(state, 1e-5, 7)
                most = max(most, torch.cuda.memory_reserved())
            assert sum(map(len, solver.kernels.repeater._graphs.values())) == 2  # of four substeps and of one
        assert not state.lost.any()
        return most

    gc.collect()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_reserved()
    alone = most_reserved([140]) - before
    torch.cuda.empty_cache()
    assert alone > 2.7e6 * 60  # bytes; otherwise the test would show nothing
    assert most_reserved([*range(60, 140), *range(140, 60, -1), *range(101, 141)]) - before < 3 * alone


@pytest.mark.gpu
@pytest.mark.parametrize("flight", ["drifts", "expands"])
def test_a_cloud_that_flies_away_is_followed_in_bounded_memory(flight):
    pytest.importorskip("triton")
    points = _cloud(500)
    solver = MPMSolver(
        0.02, "updated", transfer="kernels", gravity=ZERO,
        boundaries=[Wall(HalfSpace([0.0, 0.0, -99.0], [0.0, 0.0, 1.0]))],
    )  # fmt: skip
    centre = points.position.mean(0)
    velocity = torch.ones_like(points.position) if flight == "drifts" else 3 * (points.position - centre)
    state = solver.init_state(points, velocity)
    torch.cuda.empty_cache()
    before, grids, most = torch.cuda.memory_reserved(), [], 0
    for _ in range(100):
        state = solver.fit_grid(state, 0.02)
        grids.append(state.grid)
        state = solver.rollout(state, 1e-3, 20)
        most = max(most, torch.cuda.memory_reserved() - before)
        # three sizes, for both buffers between which a sort moves the particles
        assert sum(map(len, solver.kernels.repeater._graphs.values())) <= 6
    assert not state.lost.any()
    assert 1 < len(set(grids)) < 40
    # some fifty numbers of four bytes a node in buffers and temporaries, three times over, and PyTorch's blocks
    assert most < 600 * max(grid.node_count for grid in grids) + 2e8


BROKEN = [("position", math.nan), ("position", math.inf), ("position", 1e30), ("velocity", math.nan)]
BROKEN += [("velocity", -math.inf), ("velocity", 1e12), ("velocity", 1e30)]


@pytest.mark.slow(gate=["cpu-torch-velocity-nan", "cpu-kernels-velocity-nan", "cpu-kernels-position-1e+30"])
@pytest.mark.parametrize(("name", "value"), BROKEN)
@pytest.mark.parametrize("transfer", ["torch", "kernels"])
def test_a_broken_particle_is_reported_and_breaks_nothing_else(kernel_device, transfer, name, value):
    points, steps = make_points(kernel_device), 9 if kernel_device.type == "cuda" else 2
    solver = make_solver(transfer, boundaries=[Wall(HalfSpace([0.0, 0.0, -0.1], [0.0, 0.0, 1.0]))])
    start = solver.fit_grid(set_going(solver, points, strain=0.02), 0.04)
    end = good = solver.rollout(start, DT, steps)  # as it is, then recorded
    broken = getattr(start, name).clone()
    broken[5, 1] = value
    with torch.no_grad():
        for _ in range(2):
            end = solver.rollout(start.replace(**{name: broken}), DT, steps, check=False)
    with pytest.raises((FloatingPointError, ValueError), match=r"NaN or infinite|left the grid"):
        solver.rollout(start.replace(**{name: broken}), DT, steps)
    with pytest.raises(SimulationDiverged, match=r"particle .* (NaN or infinite|left the grid|object sizes)") as found:
        measure(solver, end, 0, 0.0).read(check=True)
    if name == "position":  # it has affected no other particle
        assert found.value.particle == 5
        assert end.lost.tolist() == [k == 5 for k in range(24)]
        assert torch.isfinite(end.velocity).all()
    with pytest.raises((FloatingPointError, ValueError)):
        solver.fit_grid(end, 0.04)
    again = solver.rollout(start, DT, steps)  # nothing remains
    check_agreement([good, again], tolerance=1e-4 if kernel_device.type == "cuda" else TOLERANCE)


# ---- a CPU sums in a fixed order: any number of threads gives the same bits


BEHIND = PinnedRegion(up_to(x=0.12), "clamp")
CASES = {
    "total": lambda: {"boundaries": [BEHIND]},
    "total with an obstacle": lambda: {"boundaries": [BEHIND, Obstacle(Sphere([0.5, 0.5, 0.1], 0.2), 0.4)]},
    "updated": lambda: {"boundaries": [Wall(HalfSpace([0.0, 0.0, 0.1], [0.1, 0.0, 1.0]), "separate", 0.3)]},
    "sand": lambda: {"boundaries": [PinnedRegion(up_to(x=0.12), "nodes")]},
}


def _end(case, dtype):
    generator = seeded(0)
    place = 0.1 + 0.9 * rand(3000, 3, generator=generator)
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
    assert solver.kernels is not None
    return state


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", CASES)
def test_threads_change_no_bit(case, dtype, use_threads):
    ends = []
    with torch.no_grad():
        for number in (1, 2, 4, 1):
            use_threads(number)
            ends.append(_end(case, dtype))
    assert peak(ends[0].velocity - noise(1, 3000, 3)) > 0.5
    for end in ends[1:]:
        for name in (*FIELDS, "work", "impulse", "lost"):
            first, other = getattr(ends[0], name), getattr(end, name)
            assert (first is None and other is None) or torch.equal(first, other), name
