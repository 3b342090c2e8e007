"""The fused substep against the torch substep, which is the reference.

Without a GPU the kernels run in Triton's interpreter, one operation after the other in numpy: slow, so the bodies are
small there. On a GPU, compiling takes most of the time, so bodies share their options, and some cases run only in the
interpreter.

Covers: aero.force_triton, mpm.triton.damping, mpm.triton.fused, mpm.triton.fused_total, mpm.triton.fused_updated,
mpm.triton.measure_kernels, mpm.triton.measures, mpm.triton.shared, mpm.triton.total_kernels,
mpm.triton.updated_kernels.
"""

import dataclasses
import gc
import math
import weakref

import pytest
import torch

from gaussian_swaying import _graphs
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.patches import Patches
from gaussian_swaying.aero.wind import FlowKey, GaussianGust, SineSway, SpatialWind, WindField
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.regions import Box, Everything
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.boundaries.handle import Handle
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.sequential_release import SequentialRelease
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.forces import Force, ForceTwin
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.fluid import Fluid
from gaussian_swaying.mpm.laws.foam import Foam
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.metal import Metal
from gaussian_swaying.mpm.laws.neo_hookean import NeoHookean
from gaussian_swaying.mpm.laws.plasticine import Plasticine
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.laws.snow import Snow
from gaussian_swaying.mpm.laws.spring_network import SpringNetwork
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints
from gaussian_swaying.simulation.diagnostics import SimulationDiverged, check_state

try:
    import triton
    import triton.language as tl

    from gaussian_swaying.mpm.triton import fused, fused_total, fused_updated, measures
except ImportError:
    fused = None

TOLERANCE = 2e-5
"""Relative to the largest value of a field. A substep rounds some hundred times (half of 1.2e-7 each): in the
decomposition, and in stresses that are differences of stretches near one; sums also have another order."""

DX, DT = 0.1, 1e-3
FORMULATIONS = ["total", "updated"]
FIELDS = ["position", "velocity", "affine", "F_elastic", "F_total", "internal", "node_displacement", "node_velocity"]
WIND = WindField([5.0, 2.0, -1.0])
ELASTIC = {
    "corotated": FixedCorotated(),
    "neo-hookean": NeoHookean(),
    "springs": SpringNetwork(),
    "hencky": StVKHencky(),
}
PLASTIC = {
    "sand": Sand(),
    "sand that swells": Sand(volume_correction=True),
    "metal": Metal(5e2, 1e3),
    "foam": Foam(2e2, 5.0),
    "foam without viscosity": Foam(2e2, 0.0),
    "plasticine": Plasticine(1e3, 2e4, 1e2),
    "snow": Snow(),
    "fluid": Fluid(),
}


@pytest.fixture(autouse=True)
def _one_width(monkeypatch):
    """The number of lanes is a constant of the compiled kernel: the same for all bodies."""
    if fused is not None:
        monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 4)


def _on(*everywhere, interpreted=()):
    """Cases for ``kernel_device``; some of them run only if nothing is compiled."""
    gpu = [pytest.param("cuda", case, marks=pytest.mark.gpu) for case in everywhere]
    return [pytest.param("interpreted", case) for case in (*everywhere, *interpreted)] + gpu


def _random(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _points(device, law=None, count=24, batch=(), **more):
    """A body of two cells per side."""
    place = torch.rand(*batch, count, 3, generator=torch.Generator().manual_seed(0))
    return _body((0.06 + 0.18 * place).to(device), law, **more)


def _body(position, law=None, youngs_modulus=1e4, **more):
    mass = 0.5 + torch.rand(position.shape[:-1], generator=torch.Generator().manual_seed(5))
    return MaterialPoints.create(
        position,
        volume=1e-4,
        density=(100.0 * mass).to(position.device),
        youngs_modulus=youngs_modulus,
        poisson_ratio=0.3,
        law=law,
        **more,
    )


def _start(solver, points, strain=0.2):
    """Deformed and in motion."""
    device, shape = points.position.device, points.position.shape
    state = solver.init_state(points, _random(1, *shape).to(points.position))
    if solver.neighbours_fixed:
        nodes = [
            (size * _random(seed, *state.node_velocity.shape)).to(device) for seed, size in ((2, strain * DX), (3, 1.0))
        ]
        massive = (solver.bound.node_mass > 0)[..., None]  # others never move
        return solver.bound.read_particles(state, *(torch.where(massive, value, 0.0) for value in nodes))
    F = (torch.eye(3) + strain * _random(2, *shape, 3)).to(device)
    total = F.mT.contiguous() if solver.laws.plastic else F
    state = state.replace(F_elastic=F, F_total=total, affine=_random(3, *shape, 3).to(device))
    if state.internal is not None:
        state = state.replace(internal=state.internal + (0.01 * _random(10, *shape[:-1]).abs()).to(device))
    return state


def _load(points, wind=WIND, seed=4, **settings):
    shape, device = points.position.shape, points.position.device
    normal = torch.nn.functional.normalize(_random(seed, *shape), dim=-1)
    area = 0.02 * torch.rand(shape[:-1], generator=torch.Generator().manual_seed(seed))
    area[..., ::5] = 0.0  # within the body
    aero = AeroForce(**{"C_L": 0.3, **settings}).to(device)
    wind = wind.to(device) if isinstance(wind, WindField) else [w.to(device) for w in wind]
    return WindForce(aero, wind, normal.to(device), area.to(device))


def _solver(transfer, formulation="updated", **options):
    return MPMSolver(**{"dx": DX, "formulation": formulation, "damping": 0.3, "transfer": transfer, **options})


def _both(points, run, formulation="updated", start=_start, **options):
    """The results of a function of solver and state with the torch substep and with the fused one."""
    found = []
    for transfer in ("torch", "triton"):
        solver = _solver(transfer, formulation, **options)
        with torch.no_grad():
            found.append(run(solver, start(solver, points)))
    return found


def _agree(ends, tolerance=TOLERANCE, names=FIELDS):
    """Both states are equal, and not the initial one."""
    pairs = list(zip(*(end if isinstance(end, list) else [end] for end in ends), strict=True))
    # a running total is as exact as its largest value so far, also where it comes back to nearly zero
    most = max(1e-9, *(float(expected.work.abs().max()) for expected, _ in pairs))
    for expected, found in pairs:
        assert torch.equal(found.lost, expected.lost)
        assert found.grid == expected.grid
        assert found.substep == expected.substep
        torch.testing.assert_close(found.time, expected.time)
        assert found.work.dtype == torch.float64
        # a sum over particles with both signs: the sum of its absolute terms is some sqrt(P) larger
        scale = most * math.sqrt(expected.position.shape[-2])
        torch.testing.assert_close(found.work, expected.work, rtol=0, atol=tolerance * scale, msg=lambda m: "work " + m)
        # what is taken is a part of the momentum of the body
        assert found.impulse.dtype == torch.float64
        scale = float(expected.velocity.abs().max()) * 0.01 * expected.position.shape[-2]
        scale = max([scale, *expected.impulse.abs().reshape(-1).tolist()])
        torch.testing.assert_close(
            found.impulse, expected.impulse, rtol=0, atol=tolerance * scale, msg=lambda m: "impulse " + m
        )
        for name in names:
            a, b = getattr(expected, name), getattr(found, name)
            assert (a is None) == (b is None), name
            if a is None:
                continue
            assert bool(torch.isfinite(a).all()), name
            error = float((b - a).abs().max()) / max(float(a.abs().max()), 1e-30)
            assert error <= tolerance, f"{name}: {error:.1e} of its largest value"


# ---- the material


def _wind_case(points, formulation, steps=1, aero=None, **options):
    load = _load(points, **(aero or {}))
    return _both(points, lambda solver, state: solver.rollout(state, DT, steps, load), formulation, **options)


@pytest.mark.parametrize(("kernel_device", "law"), _on(*ELASTIC), indirect=["kernel_device"])
def test_elastic_laws_in_total(kernel_device, law):
    _agree(_wind_case(_points(kernel_device, ELASTIC[law]), "total", steps=2))


@pytest.mark.parametrize(
    ("kernel_device", "law"),
    _on("corotated", interpreted=["neo-hookean", "hencky", "sand", "sand that swells", "snow", "fluid"]),
    indirect=["kernel_device"],
)
def test_laws_in_updated(kernel_device, law):
    """Two substeps: the first scatters the given values, the second the result of the return map."""
    law = (ELASTIC | PLASTIC)[law]
    ends = _wind_case(_points(kernel_device, law), "updated", steps=2)
    _agree(ends)
    if law.plastic and not isinstance(law, Fluid):
        assert float((ends[1].F_elastic - ends[1].F_total).abs().max()) > 0.01


@pytest.mark.parametrize(
    ("kernel_device", "names"),
    _on([*ELASTIC, *PLASTIC], interpreted=[[*ELASTIC], ["neo-hookean", "fluid", "snow"]]),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} laws",
)
def test_several_laws_in_updated(kernel_device, names):
    laws = [(ELASTIC | PLASTIC)[name] for name in names]
    index = torch.randint(len(laws), (24 if len(laws) < 5 else 60,), generator=torch.Generator().manual_seed(6))
    points = _points(kernel_device, laws, count=len(index), law_index=index)
    _agree(_wind_case(points, "updated", steps=2))


@pytest.mark.parametrize(
    ("kernel_device", "names"),
    _on([*ELASTIC], interpreted=[["corotated", "neo-hookean"], ["neo-hookean", "hencky"]]),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} laws",
)
def test_several_laws_in_total(kernel_device, names):
    laws = [ELASTIC[name] for name in names]
    index = torch.randint(len(laws), (24,), generator=torch.Generator().manual_seed(6))
    _agree(_wind_case(_points(kernel_device, laws, law_index=index), "total"))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_crushed_and_inverted_particles(kernel_device, formulation):
    """If the nearest rotation is not unique, as for a reflected ball, there is nothing to compare."""

    def start(solver, points):
        if solver.neighbours_fixed:
            state = _start(solver, points, strain=0.9)
            assert bool((torch.linalg.det(state.F_elastic) < 0).any())
            return state
        state = _start(solver, points)
        F = state.F_elastic.clone()
        for k, stretch in enumerate(
            [(1e-3, 1, 1), (1, 2e-4, 0.5), (-0.5, 1, 1.2), (1.1, 1, -1e-3), (0, 1, 2), (2, 2, 2), (6, 0.3, 1)]
        ):
            turn = torch.linalg.qr(_random(20 + k, 3, 3))[0]
            F[k] = (turn @ torch.diag(torch.tensor(stretch, dtype=torch.float32)) @ turn.mT).to(F)
        return state.replace(F_elastic=F, F_total=F)

    _agree(_wind_case(_points(kernel_device), formulation, start=start))


# ---- where the particles lie


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    [
        *_on(
            ("total", [1]), ("updated", [1]), ("total", [1, 3, 0, 64, 65, 130]), interpreted=[("updated", [3, 0, 64])]
        ),
        pytest.param("cuda", ("updated", [1, 3, 0, 64, 65, 130]), marks=pytest.mark.gpu),
    ],
    indirect=["kernel_device"],
    ids=str,
)
@pytest.mark.parametrize("programs", [1, 2048])
def test_cells_of_any_size(kernel_device, case, programs, monkeypatch):
    """Several chunks of lanes, pieces or warps for one cell; cells without a particle between others."""
    formulation, sizes = case
    if formulation == "updated" and programs > 1:
        pytest.skip("only `total` cuts cells")
    monkeypatch.setattr(fused_total, "_PROGRAMS", programs)
    if len(sizes) > 2:
        monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 64)
    generator = torch.Generator().manual_seed(7)
    cells = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    place = 0.52 + 0.96 * torch.rand(len(cells), 3, generator=generator)  # of a cell, from the first node
    place[:, 2] += cells
    place = place[torch.randperm(len(place), generator=generator)]
    _agree(_wind_case(_body((place * DX).to(kernel_device)), formulation))


@pytest.mark.gpu
@pytest.mark.parametrize("lanes", [32, 128])
def test_every_number_of_lanes(lanes, monkeypatch):
    """The others are used in other tests."""
    pytest.importorskip("triton")
    monkeypatch.setattr(fused_total, "_lanes", lambda sizes: lanes)
    _agree(_wind_case(_points("cuda", count=300), "total"))


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
def test_crowded_cells_are_cut_only_where_there_are_few(kernel_device, monkeypatch):
    """200 particles in a cell and 10 in the next, with 32 lanes."""
    monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 32)
    generator = torch.Generator().manual_seed(2)
    place = 0.52 + 0.96 * torch.rand(210, 3, generator=generator)
    place[200:, 2] += 1
    for programs, pieces in ((2048, 7 + 1), (3, 3 + 1), (1, 2)):
        monkeypatch.setattr(fused_total, "_PROGRAMS", programs)
        solver = MPMSolver(DX, formulation="total", transfer="triton")
        solver.init_state(_body((place * DX).to(kernel_device)))
        assert solver.fused().pieces == pieces


def test_the_number_of_lanes_suits_the_cells(monkeypatch):
    if fused is None:
        pytest.skip("needs triton, which is available on Linux only")
    monkeypatch.undo()
    few, many = (fused_total._lanes(torch.full((100,), size)) for size in (3, 300))
    assert few < many
    sizes = torch.tensor([4] * 4000 + [5] * 100)  # no program goes through its cells twice, if all run at once
    assert fused_total._lanes(sizes) == 8
    assert fused_total._lanes(sizes.repeat(10)) == 4


def test_a_node_adds_only_the_cells_around_it(monkeypatch):
    """A sheet one cell thick has at most nine cells around a node, and each of a node's rows is that of its place."""
    if fused is None:
        pytest.skip("needs triton, which is available on Linux only")
    cell = torch.full((27, 2), 5)
    cell[[3, 20], 0] = torch.tensor([4, 2])
    cell[26, 1] = 0
    assert fused_total._sources(cell, 5).tolist() == [[3 * 6 + 4, 26 * 6], [20 * 6 + 2, 5]]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_particles_on_the_borders_of_cells(kernel_device, formulation):
    steps = torch.tensor([0.05, 0.15, 0.1, 0.25])
    position = torch.cartesian_prod(steps, steps, steps)[:32]
    position = torch.cat([position, torch.nextafter(position, torch.zeros(()))[5:13]])
    _agree(_wind_case(_body(position.to(kernel_device)), formulation))


def test_what_leaves_the_grid_is_lost(kernel_device):
    """It has no weight, does not affect the far side, and keeps its place; particles too near the edge are lost too."""
    points = _points(kernel_device)
    outside = torch.tensor([[0.13, 0.14, 0.5], [0.5, 0.1, 0.1], [0.13, -0.4, 0.1], [0.15, 0.12, 0.349], [90.0, 0, 0]])
    count = len(outside)
    position = torch.cat([points.position[:-count], outside.to(kernel_device)])
    points = dataclasses.replace(points, position=position)
    grid = GridSpec(DX, (0, -1, 0), (5, 6, 5))

    def start(solver, points):
        state = _start(solver, points).replace(grid=grid)
        state.velocity[-2, 2] = 60.0  # from within the grid
        return state

    def run(solver, state):
        states = [solver.rollout(state, DT, steps, check=False) for steps in (1, 4)]
        assert states[0].lost.tolist() == [False] * 19 + [True] * 3 + [False, True]
        assert states[1].lost.tolist() == [False] * 19 + [True] * 5
        assert float(states[1].velocity[-1].abs().max()) == 0.0
        assert torch.equal(states[1].position[-5:-2], state.position[-5:-2])
        roomy = states[1].replace(grid=GridSpec(DX, (-1, -6, -1), (9, 12, 9)))
        states.append(solver.rollout(roomy, DT, 1, check=False))
        assert torch.equal(states[2].lost, states[1].lost)  # though most are back
        return states

    _agree(_both(points, run, start=start, gravity=(0, 0, 0)))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_batch_is_each_scene_by_itself(kernel_device, formulation):
    points = _points(kernel_device, count=10, batch=(2,))
    winds = [
        WindField([0.0, -8.0, 0.0]),
        WindField(schedule=[FlowKey(0.0, [1.0, 0, 0]), FlowKey(DT, [9.0, 0, 0])]),
    ]
    load = _load(points, winds)
    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 2, load), formulation)
    _agree(ends)
    assert ends[1].work.shape == (2,)
    solver = _solver("torch", formulation)
    whole = _start(solver, points)
    for k, wind in enumerate(winds):
        alone = points.map(lambda value, k=k: value[k])
        solver = _solver("triton", formulation)
        state = solver.init_state(alone)
        fields = {name: None if getattr(whole, name) is None else getattr(whole, name)[k] for name in FIELDS}
        if formulation == "total":
            nodes = state.grid.node_count
            offset = [a - b for a, b in zip(state.grid.offset, whole.grid.offset, strict=True)]
            index = torch.arange(whole.grid.node_count).reshape(whole.grid.resolution)
            for axis, (start, size) in enumerate(zip(offset, state.grid.resolution, strict=True)):
                index = index.narrow(axis, start, size)
            index = index.reshape(-1).to(kernel_device)
            assert len(index) == nodes
            fields |= {name: fields[name][index] for name in ("node_displacement", "node_velocity")}
        else:
            state = state.replace(grid=whole.grid)
        state = state.replace(**fields)
        end = solver.rollout(state, DT, 2, WindForce(load.aero, wind, load.normal[k], load.area[k]))
        for name in ("position", "velocity", "affine", "F_elastic"):
            error = (getattr(end, name) - getattr(ends[1], name)[k]).abs().max()
            assert float(error) <= TOLERANCE * float(getattr(end, name).abs().max()), name
        torch.testing.assert_close(end.work, ends[1].work[k], rtol=1e-4, atol=0)


# ---- forces


@pytest.mark.parametrize(
    ("kernel_device", "settings"),
    _on(
        {"drag_step": "semi_implicit"},
        {"law": "projected", "lift_direction": "lift", "unit_tangent": True},
        {"max_area_ratio": 0.9},
        {"law": "linear", "drag_step": "semi_implicit"},
        interpreted=[{"law": "projected"}, {"law": "linear"}, {"lift_direction": "lift"}, {"unit_tangent": True}],
    ),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else ", ".join(map(str, value.values())),
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_every_kind_of_wind(kernel_device, formulation, settings):
    _agree(_wind_case(_points(kernel_device), formulation, aero=settings))


@pytest.mark.parametrize(
    ("kernel_device", "settings"),
    _on(
        {"drag_step": "semi_implicit", "max_area_ratio": 0.9},
        {"law": "projected", "lift_direction": "lift", "unit_tangent": True},
        {"law": "linear", "drag_step": "semi_implicit"},
        interpreted=[{"law": "projected"}],
    ),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else ", ".join(map(str, value.values())),
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_wind_on_groups_of_patches(kernel_device, formulation, settings):
    """Up to a dozen patches for each point, none for some, and a longer list the second time."""
    points = _points(kernel_device)

    def load(count):
        normal = torch.nn.functional.normalize(_random(6, count, 3), dim=-1)
        area = 0.01 * torch.rand(count, generator=torch.Generator().manual_seed(6))
        which = torch.randint(0, points.count - 3, (count,), generator=torch.Generator().manual_seed(7))
        aero = AeroForce(**{"C_L": 0.3, **settings})
        return WindForce(aero, WIND, Patches(normal, area, which, points.count)).to(kernel_device)

    def run(solver, state):
        return [solver.rollout(state, DT, 1, load(count)) for count in (90, 130, 90)]

    assert load(90).sums is not None
    _agree(_both(points, run, formulation))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_cap_on_the_area_acts(kernel_device, formulation):
    """It is also read again in each rollout: a recorded graph stores the address that it reads, not the value."""
    points = _points(kernel_device)
    free, capped = _load(points), _load(points, max_area_ratio=0.5)
    solver = _solver("triton", formulation)
    start = _start(solver, points)
    ends = [solver.rollout(start, DT, 1, load) for load in (free, capped, free, capped, free)]
    for k in (2, 3, 4):
        if formulation == "total":
            assert torch.equal(ends[k].velocity, ends[k - 2].velocity)
    gained = [float((end.work - start.work).abs()) for end in ends]
    assert gained[1] < 0.9 * gained[0]
    assert gained[2:] == pytest.approx(gained[:3], rel=1e-5)


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
def test_patches_without_flow_and_flat_ones(kernel_device):
    """Air that moves with the patch, and a patch that is pressed to nothing."""

    def start(solver, points):
        state = _start(solver, points)
        state.velocity[:4] = torch.tensor(WIND.flows[0].tolist(), device=kernel_device)
        F = state.F_total.clone()
        F[2] = 0.0
        F[5] = 0.0
        return state.replace(F_total=F)

    points = _points(kernel_device, Sand())
    _agree(_wind_case(points, "updated", start=start))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_wind_along_the_normal(kernel_device, formulation):
    """Nothing of it is tangential, and the direction of a zero vector is zero."""
    points = _points(kernel_device)
    up = torch.tensor([0.0, 0.0, 1.0], device=kernel_device).expand(*points.position.shape)
    wind = WindField([0.0, 0.0, -50.0]).to(kernel_device)
    load = WindForce(AeroForce(unit_tangent=True).to(kernel_device), wind, up, 0.01 * torch.ones_like(points.mass))

    def start(solver, points):
        return solver.init_state(points)

    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 1, load), formulation, start=start)
    _agree(ends, names=["position", "velocity", "affine", "F_elastic"])


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("implicit", [False, True])
def test_forces_and_drag_of_step(kernel_device, formulation, implicit):
    points = _points(kernel_device)
    force = (0.3 * _random(8, *points.position.shape)).to(kernel_device)
    drag = (0.5 * _random(9, *points.mass.shape).abs()).to(kernel_device) if implicit else None

    def run(solver, state):
        states = [solver.step(state, DT, force=force, drag=drag)]
        states.append(solver.step(states[0], DT, force=2 * force, drag=drag))
        return states

    ends = _both(points, run, formulation)
    _agree(ends)
    assert float(ends[1][1].work.abs()) > 0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_drag_without_a_force(kernel_device, formulation):
    """Nothing is added to the work."""
    points = _points(kernel_device)
    drag = torch.full_like(points.mass, 0.7)
    _agree(_both(points, lambda solver, state: solver.step(state, DT, drag=drag), formulation))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_force_function_is_called_each_substep(kernel_device, formulation):
    points = _points(kernel_device)
    times = []

    def force(state):
        times.append(round(float(state.time), 9))
        return -20.0 * points.mass[:, None] * state.velocity

    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 2, force), formulation)
    _agree(ends)
    assert times == [0.0, DT] * 2


class _Pull(Force):
    """Pulls particles to a moving place, more strongly if they are sheared; with a resistance if requested."""

    recordable = True

    def __init__(self, device, resistance=None):
        super().__init__()
        self.register_buffer("place", torch.tensor([0.3, 0.1, -0.2], device=device))
        self.register_buffer("way", torch.tensor([80.0, 0.0, 0.0], device=device))
        self.resistance, self._called = resistance, 0

    def forward(self, state):
        self._called += 1
        shear = 1 + state.F_total[..., 0, 1:2].abs() + 1e-3 * state.affine[..., 1, 2:3].abs()
        pull = 5.0 * shear * (self.place + self.way * state.time - state.position) - 0.1 * state.velocity
        if state.internal is not None:
            pull = pull + state.internal[..., None]
        if self.resistance is None:
            return pull
        return pull, self.resistance * (1 + state.velocity.square().sum(-1))


FORCES = {
    "custom": lambda points, pull: [pull],
    "wind and custom": lambda points, pull: [_load(points), pull],
    "custom, wind, wind": lambda points, pull: [
        pull,
        _load(points),
        _load(points, WindField([0.0, 9.0, 0.0]), seed=14),
    ],
    "semi-implicit wind and custom": lambda points, pull: [_load(points, drag_step="semi_implicit"), pull],
}


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    _on(
        ("wind and custom", 2.0),
        ("custom, wind, wind", None),
        interpreted=[("custom", 2.0), ("semi-implicit wind and custom", None)],
    ),
    indirect=["kernel_device"],
    ids=str,
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_forces_in_torch_among_the_kernels(kernel_device, formulation, case, monkeypatch):
    """Across the end of a part, with particles sorted again, and with a batch; all forces and their work."""
    name, resistance = case
    monkeypatch.setattr(fused, "MAX_STEPS", 3)
    monkeypatch.setattr(fused_updated, "sorted_for", lambda *known: 2)
    points = _points(kernel_device, count=6, batch=(2,))
    pull = _Pull(kernel_device, resistance)

    def run(solver, state):
        monkeypatch.setattr(solver, "_step", None if solver.transfer == "triton" else solver._step)
        forces = FORCES[name](points, pull)
        states = [solver.rollout(state, DT, 1, forces)]
        states.append(solver.rollout(states[-1], 0.7 * DT, 4, forces))
        return states

    ends = _both(points, run, formulation)
    _agree(ends)
    free = _solver("torch", formulation)
    with torch.no_grad():
        calm = free.rollout(_start(free, points), DT, 1, FORCES[name](points, pull)[:-1])
    assert not torch.allclose(calm.velocity, ends[0][0].velocity, rtol=1e-3)


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    _on(("total", "corotated"), ("updated", "sand that swells")),
    indirect=["kernel_device"],
    ids=str,
)
def test_forces_in_torch_with_boundaries_looks_and_flow(kernel_device, case):
    """The time passed to forces and boundaries advances once per substep; the internal variable is passed too."""
    formulation, law = case
    points = _points(kernel_device, (ELASTIC | PLASTIC)[law], count=12)
    forces = [_Pull(kernel_device, 1.0), _load(points)]
    found = _both(
        points,
        lambda solver, state: solver.watched_rollout(state, DT, 3, forces, 2),
        formulation,
        boundaries=[PinnedRegion(LEFT, start=1.5 * DT), Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "separate")],
    )
    _agree([state for state, _ in found])
    assert float(found[1][1]) == pytest.approx(float(found[0][1]), rel=2 * TOLERANCE)


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_force_that_cannot_be_recorded_is_asked_by_the_host(kernel_device, formulation):
    """The other forces then run in torch as well."""
    points = _points(kernel_device, count=12)

    class Waiting(_Pull):
        def forward(self, state):
            return super().forward(state) if float(state.time) > 0.5 * DT else 0 * state.position

    def run(solver, state):
        waiting = Waiting(kernel_device)
        end = solver.rollout(state, DT, 3, [_load(points), waiting])
        assert waiting._called == 2
        return end

    _agree(_both(points, run, formulation))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_wind_that_depends_on_the_place(kernel_device, formulation):
    class Shear(SpatialWind):
        recordable = True

        def forward(self, time, position):
            speed = (8.0 + 1e3 * time) * (1 + 3 * position[..., 2])
            return torch.stack([speed, torch.zeros_like(speed), torch.ones_like(speed)], dim=-1)

    points = _points(kernel_device, count=12)
    load = _load(points)
    shear = WindForce(load.aero, Shear(), load.normal, load.area)
    _agree(_both(points, lambda solver, state: solver.rollout(state, DT, 2, shear), formulation))


if fused is not None:

    @triton.jit
    def _toward(F, velocity, values, vector, numbers, OPTIONS: tl.constexpr):
        """Pulls along a vector by a share of each particle; has a resistance if compiled with it."""
        scale = values[0] * tl.load(numbers) * F[0]
        resistance = values[0] * 0
        if OPTIONS[0]:
            resistance = values[1]
        force = (
            scale * tl.load(vector) - resistance * velocity[0],
            scale * tl.load(vector + 1) - resistance * velocity[1],
            scale * tl.load(vector + 2) - resistance * velocity[2],
        )
        return force, resistance


class _Toward(Force):
    """A force outside the package with a twin."""

    has_twin = True

    def __init__(self, points, resists):
        super().__init__()
        self.resists = resists
        self.register_buffer("share", torch.stack([points.mass, 3 * points.mass], dim=-1))

    def along(self, time):
        return torch.stack([300 * time + 9, -5 + 0 * time, 1 + 2000 * time], dim=-1)

    def forward(self, state):
        scale = self.share[..., 0] * 2.5 * state.F_total[..., 0, 0]
        force = scale[..., None] * self.along(state.time).to(scale)
        if not self.resists:
            return force
        return force - self.share[..., 1:] * state.velocity, self.share[..., 1]

    def twin(self):
        return ForceTwin(
            function=_toward,
            options=(self.resists,),
            implicit=self.resists,
            sources=(self.share,),
            values=lambda: self.share,
            numbers=lambda: torch.tensor([2.5], device=self.share.device),
            vectors=lambda time, dt, steps: self.along(
                time + dt * torch.arange(steps, dtype=torch.float64, device=time.device)
            ),
        )


@pytest.mark.parametrize("resists", [False, True])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_twin_from_outside(kernel_device, formulation, resists):
    """It comes before a wind, so the wind runs in torch; and the kernels can be given another twin."""
    points = _points(kernel_device, count=12)
    own = _Toward(points, resists)

    def run(solver, state):
        states = [solver.rollout(state, DT, 2, own)]
        states.append(solver.rollout(states[-1], DT, 2, [own, _load(points)]))
        states.append(solver.rollout(states[-1], DT, 2, _load(points)))
        own.share *= 2
        states.append(solver.rollout(states[-1], DT, 1, own))
        own.share /= 2
        return states

    _agree(_both(points, run, formulation))


@pytest.mark.gpu
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_forces_in_torch_are_replayed_from_graphs(formulation):
    """Python is not called after recording; changes in place take effect, and a changed number is recorded again."""
    pytest.importorskip("triton")
    points = _points(torch.device("cuda"), count=60)
    pulls = [_Pull("cuda", 1.0) for _ in range(2)]
    solvers = [_solver(transfer, formulation) for transfer in ("torch", "triton")]
    state = _start(solvers[0], points, strain=0.02)
    _start(solvers[1], points)
    load = _load(points)
    called = []
    for k in range(7):
        if k == 4:
            for pull in pulls:
                pull.place += 0.2
        if k == 5:
            for pull in pulls:
                pull.resistance = 3.0
        before = pulls[1]._called
        dt = [1e-4, 7e-5][k % 2]
        expected, found = (
            solver.rollout(state, dt, 22, [load, pull]) for solver, pull in zip(solvers, pulls, strict=True)
        )
        _agree([expected, found], tolerance=5e-4)
        called.append(pulls[1]._called - before)
        state = expected
    once = 1 if formulation == "updated" else 0  # at the start, where the particles are sorted
    assert called[0] > 22 - 1
    assert called[2] == called[3] == called[4] == once
    assert called[5] > 22 - 1
    assert any(solvers[1].fused().repeater._graphs.values())


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    _on(("total", False), ("updated", True), interpreted=[("updated", False)]),
    indirect=["kernel_device"],
    ids=str,
)
def test_gravity_damping_and_viscosity(kernel_device, case):
    """Also with MLS-MPM."""
    formulation, mls = case
    options = {"gravity": (1.0, 2.0, -9.8), "damping": 20.0, "stiffness_damping": 2e-3}
    _agree(_wind_case(_points(kernel_device), formulation, steps=2, mls=mls, **options))


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
def test_mls(kernel_device):
    _agree(_wind_case(_points(kernel_device), "updated", mls=True))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_without_any_load(kernel_device, formulation):
    """Also without damping."""
    points = _points(kernel_device)
    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 2), formulation, damping=0.0)
    _agree(ends)
    assert float(ends[1].work) == 0.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_substep_that_changes(kernel_device, formulation):
    """Forces act for the mean of the old and the new one, at most twice the new one."""
    points = _points(kernel_device)
    load = _load(points)

    def run(solver, state):
        states = []
        for dt, steps in ((1e-3, 1), (4e-4, 2), (1e-4, 1)):
            state = solver.rollout(state, dt, steps, load)
            states.append(state)
        return states

    _agree(_both(points, run, formulation))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_rollouts_in_parts(kernel_device, formulation, monkeypatch):
    """Longer than the schedule and the sorting of the particles; the wind and the work continue."""
    monkeypatch.setattr(fused, "MAX_STEPS", 4)
    monkeypatch.setattr(fused_updated, "sorted_for", lambda *known: 2)
    wind = WindField(schedule=[FlowKey(0.0, [0.0] * 3), FlowKey(5 * DT, [30.0, 0.0, 0.0])], interpolation="linear")
    points = _points(kernel_device, count=12, batch=(2,))
    load = _load(points, [wind, WIND])

    def start(solver, points):
        state = _start(solver, points, strain=0.05)
        return state if solver.neighbours_fixed else state.replace(velocity=10 * state.velocity)  # across cells

    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 5, load), formulation, start=start)
    _agree(ends)


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    _on(
        *((law, formulation) for law in ("corotated", "springs") for formulation in FORMULATIONS),
        ("sand", "updated"),
        interpreted=[("hencky", "total"), ("metal", "updated")],
    ),
    indirect=["kernel_device"],
    ids=lambda value: value if isinstance(value, str) else ", ".join(value),
)
def test_looks_on_the_way(kernel_device, case, monkeypatch):
    """The largest Courant number seen, and the same motion; some checks fall between two sorts of the particles."""
    monkeypatch.setattr(fused_updated, "sorted_for", lambda *known: 2)
    law, formulation = case
    points = _points(kernel_device, (ELASTIC | PLASTIC)[law])

    def run(solver, state):
        if solver.transfer == "triton":
            assert solver.bound.longest_substep > DT  # of the material at rest, in torch, once
            monkeypatch.setattr(solver.laws, "moduli", None)  # the measured values stay in the kernels
        return solver.watched_rollout(state, DT, 3, _load(points), 3)

    found = _both(points, run, formulation)
    _agree([state for state, _ in found])
    assert float(found[1][1]) == pytest.approx(float(found[0][1]), rel=2 * TOLERANCE)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_looks_at_other_laws(kernel_device, formulation):
    """With several energies, or with one that has no kernel, the checks run in torch, between the kernels' substeps."""
    index = torch.arange(24) % 2
    for laws, more in (([*ELASTIC.values()][2:], {"law_index": index}), (ELASTIC["neo-hookean"], {})):
        points = _points(kernel_device, laws, **more)
        found = _both(points, lambda solver, state: solver.watched_rollout(state, DT, 2, None, 2), formulation)
        _agree([state for state, _ in found])
        assert float(found[1][1]) == pytest.approx(float(found[0][1]), rel=2 * TOLERANCE)


@pytest.mark.gpu
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_many_substeps(formulation):
    """Round-off grows in fifty substeps, though not by much where the motion is stable."""
    pytest.importorskip("triton")

    def start(solver, points):
        return _start(solver, points, strain=0.02)

    ends = _wind_case(_points("cuda", count=2000), formulation, steps=50, start=start)
    _agree(ends, tolerance=2e-4)


# ---- rollouts from graphs


def _gusty():
    """A wind that is another in every substep."""
    gusts = [SineSway(period=0.01), GaussianGust(1.0, interval=2 * DT)]
    return WindField(schedule=[FlowKey(0.0, [5.0, 0.0, 0.0]), FlowKey(0.004, [0.0, 5.0, 1.0])], modulations=gusts)


REPLAYED = {
    "a hinge": {"boundaries": lambda: [PinnedRegion(LEFT)]},
    "nodes, crowded cells": {"boundaries": lambda: [PinnedRegion(LEFT, "nodes")], "count": 40},
    "a handle": {"boundaries": lambda: [Handle(LEFT, [0.5, 0.0, 0.2])]},
    "a batch": {"boundaries": lambda: [PinnedRegion(LEFT)], "batch": (2,)},
    "no wind": {"boundaries": lambda: [], "wind": False},
}


@pytest.mark.parametrize("case", REPLAYED)
def test_replayed_rollouts_give_the_same_bits(kernel_device, case, monkeypatch):
    """On a GPU nothing is recorded at first; results stay as they are when another rollout follows."""
    steps = 37 if kernel_device.type == "cuda" else 5
    monkeypatch.setattr(fused_total, "_PROGRAMS", 1 if case == "nodes, crowded cells" else 2048)
    given = REPLAYED[case]
    points = _points(kernel_device, count=given.get("count", 12), batch=given.get("batch", ()))
    solver = _solver("triton", "total", boundaries=given["boundaries"]())
    wind = [_gusty(), WIND] if "batch" in given else _gusty()
    forces = [_load(points, wind)] if given.get("wind", True) else []
    start = _start(solver, points, strain=0.05)

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


@pytest.mark.parametrize("graphs", ["as on the device", "played"])
def test_a_replayed_rollout_follows_what_changes(kernel_device, graphs, monkeypatch):
    """Numbers of the wind and patches that change in place, and a force that is another one.

    A played graph runs what was recorded, with what the recording knew of its first rollout.
    """
    if graphs == "played" and kernel_device.type == "cuda":
        pytest.skip("on this device graphs are real")
    points = _points(kernel_device, count=12)
    load, other = _load(points), _load(points, seed=7)
    if graphs == "played":
        monkeypatch.setattr(_graphs, "record", lambda device, work, pool, stream: _Played(work))
        monkeypatch.setattr(torch.cuda, "Stream", lambda device: None)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
        monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)

    def run(solver, state):
        if graphs == "played" and solver.transfer == "triton":
            solver.fused().repeater = _graphs.Repeater(torch.device("cuda"), kept=8)
        states = [solver.rollout(state, DT, 2, load) for _ in range(3)]
        load.area *= 2
        load.aero.C_D += 1.0
        states += [solver.rollout(state, DT, 2, load) for _ in range(2)]
        load.wind.seed = 3
        load.wind.flows *= 0.5
        states += [solver.rollout(state, DT, 2, load) for _ in range(3)]
        states += [solver.rollout(state, DT, 2, other) for _ in range(3)]
        states += [solver.rollout(states[-1], 0.7 * DT, steps, load) for steps in (5, 3, 1, 4)]
        load.area /= 2
        load.aero.C_D -= 1.0
        load.wind.seed = 0
        load.wind.flows *= 2
        return states

    _agree(_both(points, run, "total"))


# ---- boundaries

LEFT, TOP = Box([None] * 3, [0.12, None, None]), Box([None, None, 0.17], [None] * 3)
WINDOW = {"start": 0.5 * DT, "end": 1.5 * DT}
BOUNDARIES = {
    "pin": lambda: [PinnedRegion(LEFT, "nodes")],
    "hinge": lambda: [PinnedRegion(LEFT)],
    "two pins": lambda: [PinnedRegion(LEFT, "nodes"), PinnedRegion(TOP, "nodes", held_share=0.4)],
    "pin for some time": lambda: [PinnedRegion(LEFT, "nodes", **WINDOW)],
    "hinge for some time": lambda: [PinnedRegion(LEFT, **WINDOW)],
    "handle": lambda: [Handle(LEFT, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], "nodes", **WINDOW)],
    "hinged handle": lambda: [Handle(LEFT, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], **WINDOW)],
    "release": lambda: [SequentialRelease(LEFT, [0.0, 1.0, 0.0], start=0.5 * DT, end=1.5 * DT, kind="nodes")],
    "release of points": lambda: [SequentialRelease(LEFT, [0.0, 1.0, 0.0], start=0.5 * DT, end=1.5 * DT)],
    "impulse": lambda: [Impulse(TOP, [0.01, 0.0, 0.02], **WINDOW)],
    "plane": lambda: [Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "separate", 0.4, **WINDOW)],
    "box": lambda: [EnclosingBox([0.1, 0.1, 0.1], [0.2, 0.2, 0.2], "slip", 0.2)],
    "walls": lambda: [
        Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "sticky", **WINDOW),
        EnclosingBox([0.11, 0.1, 0.1], [0.2, 0.2, 0.2], "separate", 0.1, end=1.5 * DT),
    ],
    "velocity box": lambda: [VelocityBox(TOP, [0.0, 1.0, 0.0], **WINDOW)],
    "pin and plane": lambda: [PinnedRegion(LEFT, "nodes"), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")],
    "knock and release": lambda: [SequentialRelease(LEFT, end=1.5 * DT), Impulse(Everything(), [0, 0, 0.02], end=DT)],
}


@pytest.mark.parametrize(
    ("kernel_device", "name"),
    [
        *(pytest.param("cuda", name, marks=pytest.mark.gpu) for name in BOUNDARIES),
        *(
            ("interpreted", name)
            for name in ("two pins", "hinge", "handle", "hinged handle", "knock and release", "plane", "box", "walls")
        ),
    ],
    indirect=["kernel_device"],
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries(kernel_device, formulation, name):
    """Over three substeps, of which the first and the last lie outside the window."""
    _boundaries_case(kernel_device, formulation, BOUNDARIES[name])


POINT_HOLDS = {
    "clamp": lambda: [PinnedRegion(LEFT, "clamp")],
    "points": lambda: [PinnedPoints([[0.1, 0.12, 0.11], [0.2, 0.17, 0.13]])],
    "nodes, hinge and clamp": lambda: [
        PinnedRegion(LEFT),
        PinnedRegion(TOP, "nodes", held_share=0.4),
        PinnedPoints([[0.2, 0.1, 0.1]], "clamp"),
        PinnedRegion(LEFT, "nodes", held_share=0.5),
    ],
    "points and plane": lambda: [PinnedPoints([[0.2, 0.1, 0.1]]), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")],
    "points one after the other": lambda: [
        PinnedRegion(LEFT, end=1.5 * DT),
        PinnedPoints([[0.2, 0.1, 0.1]], "clamp", start=0.5 * DT),
        Handle(TOP, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], "clamp", start=1.5 * DT),
    ],
}
"""These are for `total` alone."""


@pytest.mark.parametrize(("kernel_device", "name"), _on(*POINT_HOLDS), indirect=["kernel_device"])
def test_points_that_are_held(kernel_device, name):
    _boundaries_case(kernel_device, "total", POINT_HOLDS[name])


def test_planes_and_boxes_are_a_part_of_the_kernel_of_the_nodes(kernel_device):
    """Of one scene in `updated`, if nothing else acts; in torch an enclosing box takes as long as the substep."""
    points = _points(kernel_device, count=12)
    with_walls, with_pin, batch = (
        _solver("triton", "updated", boundaries=BOUNDARIES[name]()) for name in ("walls", "pin and plane", "walls")
    )
    for solver in (with_walls, with_pin):
        solver.init_state(points)
    batch.init_state(_points(kernel_device, count=12, batch=(2,)))
    assert len(with_walls.fused().solids.parts) == 7
    assert with_pin.fused().solids.parts == []
    assert batch.fused().solids.parts == []


def test_a_plane_that_is_moved_in_place(kernel_device):
    """Between two rollouts, and without another buffer."""
    points, ends = _points(kernel_device, count=12), []
    for transfer in ("torch", "triton"):
        plane = Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], "sticky")
        solver = _solver(transfer, "updated", boundaries=[plane])
        state = solver.rollout(_start(solver, points), DT, 1)
        plane.point[2] = 0.13
        ends.append(solver.rollout(state, DT, 1))
    _agree(ends)
    assert float(ends[1].impulse.abs().max()) > 1e-4


def test_fast_particles_are_sorted_more_often_and_sheets_less():
    """At least every 64 substeps, and not so often that a small body waits for the host."""
    often = [fused_updated.sorted_for(8.0, rate, 1_000_000) for rate in (1e-6, 1e-3, 1e-2, 1e-1, 1.0)]
    assert often[0] == 64
    assert often == sorted(often, reverse=True)
    assert often[-1] == 4
    assert fused_updated.sorted_for(4.0, 1e-2, 1_000_000) > fused_updated.sorted_for(8.0, 1e-2, 1_000_000)
    assert fused_updated.sorted_for(100.0, 1e-2, 1_000_000) > fused_updated.sorted_for(8.0, 1e-2, 1_000_000)
    assert fused_updated.sorted_for(8.0, 1.0, 20_000) == 32
    axis = (torch.arange(32) + 0.5) * DX / 2
    assert 7 < fused_updated.crowd_of(torch.cartesian_prod(axis, axis, axis), DX) <= 8


def test_a_fast_body_is_sorted_more_often_from_the_second_rollout_on(kernel_device, monkeypatch):
    """The host does not wait for the speed: it reads that of an earlier rollout."""
    monkeypatch.setattr(fused_updated, "LEAST", 1)
    points = _points(kernel_device, count=48)
    found = []
    for speed in (0.01, 10.0):
        solver = _solver("triton", "updated", gravity=(0.0, 0.0, 0.0))
        state = solver.init_state(points, torch.full_like(points.position, speed))
        for _ in range(2):
            state = solver.rollout(state, 1e-3, 2)
            if kernel_device.type == "cuda":
                torch.cuda.synchronize()
        solver.rollout(state, 1e-3, 1)
        fused = solver.fused()
        found.append(fused.crossing)
        assert fused.crossing == pytest.approx(3 * speed * 1e-3 / solver.dx, rel=0.1)
    assert found[1] > 100 * found[0]


def test_points_held_in_a_batch(kernel_device):
    """The scenes have different rows."""
    points = _points(kernel_device, count=40, batch=(2,))
    boundaries = [PinnedRegion(LEFT), PinnedRegion(TOP, "nodes", held_share=0.4)]
    ends = _wind_case(points, "total", steps=2, boundaries=boundaries)
    _agree(ends)
    assert ends[1].impulse.shape == (2, 2, 3)


@pytest.mark.gpu
def test_held_points_stay_where_they_are_and_give_the_same_bits():
    """Thousands of substeps in float32, from graphs."""
    pytest.importorskip("triton")
    points = _points("cuda", count=2000)
    ends = []
    for _ in range(2):
        solver = _solver(
            "triton", "total", deterministic=True, boundaries=[PinnedRegion(LEFT), PinnedRegion(TOP, "clamp")]
        )
        ends.append(solver.rollout(_start(solver, points, strain=0.02), 2e-4, 4000, _load(points)))
    for name in ("position", "velocity", "node_velocity", "impulse"):
        assert torch.equal(getattr(ends[0], name), getattr(ends[1], name))
    holds = solver.bound.point_holds
    rows = (holds.weight[0, 0][..., None] * ends[0].node_displacement[holds.node[0, 0]].double()).sum(-2)
    start = _start(solver, points, strain=0.02).node_displacement
    before = (holds.weight[0, 0][..., None] * start[holds.node[0, 0]].double()).sum(-2)
    assert float((rows - before).abs().max()) < 1e-5 * DX


def _boundaries_case(kernel_device, formulation, make):
    points = _points(kernel_device, count=12)
    load = _load(points)

    def run(solver, state):
        state = solver.rollout(state, DT, 1, load)
        return [state, solver.rollout(state, DT, 2, load)]

    ends = _both(points, run, formulation, boundaries=make())
    _agree(ends)
    assert float(ends[1][1].impulse.abs().max()) > 1e-4
    free = _solver("torch", formulation)
    with torch.no_grad():
        velocity = run(free, _start(free, points))[1].velocity
    assert not torch.allclose(velocity, ends[0][1].velocity, rtol=1e-3)


def test_nodes_without_mass_are_let_go(kernel_device):
    """Boundaries see them at the origin, and so inside a region around it."""
    points = _points(kernel_device, count=12)
    boundaries = [VelocityBox(Box([-0.1] * 3, [0.1] * 3), [0.0, 1.0, 0.0], end=0.5 * DT)]
    _agree(_both(points, lambda solver, state: solver.rollout(state, DT, 3), "total", boundaries=boundaries))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries_of_a_batch(kernel_device, formulation):
    points = _points(kernel_device, count=40, batch=(2,))
    boundaries = [SequentialRelease(LEFT, [0.0, 1.0, 0.0], end=1.5 * DT), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0])]
    _agree(_wind_case(points, formulation, steps=2, boundaries=boundaries))


def test_nodes_held_in_a_batch_of_winds(kernel_device):
    """The momentum that pins take is summed for each scene, and all scenes share their patches."""
    points = _points(kernel_device, count=40, batch=(2,))
    winds = WindBatch([WindField([0.0, -8.0, 0.0]), WindField([3.0, 9.0, 0.0])]).to(kernel_device)
    listed = _load(points, [WindField([0.0, -8.0, 0.0]), WindField([3.0, 9.0, 0.0])])
    load = WindForce(listed.aero, winds, listed.normal[0], listed.area[0])
    boundaries = [PinnedRegion(LEFT, kind="nodes")]
    ends = _both(points, lambda solver, state: solver.rollout(state, DT, 2, load), "total", boundaries=boundaries)
    _agree(ends)
    assert float(ends[0].impulse.abs().amax()) > 0
    torch.testing.assert_close(ends[1].impulse, ends[0].impulse, rtol=1e-3, atol=1e-12)


# ---- what is conserved


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_momentum(kernel_device, formulation):
    """Linear and angular momentum of a free body, to float32; angular momentum about a point within the body."""
    points = _points(kernel_device)
    solver = _solver("triton", formulation, gravity=(0, 0, 0), damping=0.0)
    state = _start(solver, points)
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
    _on("explicit", "semi_implicit"),
    indirect=["kernel_device"],
)
def test_the_work_is_what_the_energy_grows_by(kernel_device, drag_step):
    """In a body that is too soft to store any; the energies are computed separately from the work."""
    points = _points(kernel_device)
    points = dataclasses.replace(points, youngs_modulus=torch.full_like(points.mass, 1e-6))
    solver = _solver("triton", "total", gravity=(0, 0, 0), damping=0.0)
    state = _start(solver, points)
    end = solver.rollout(state, DT, 2, _load(points, drag_step=drag_step))
    growth = solver.energies(end)["kinetic"] - solver.energies(state)["kinetic"]
    assert abs(float(growth)) > 1e-4
    # a difference of two energies in float32
    torch.testing.assert_close(end.work.float(), growth, rtol=0, atol=2e-6 * float(solver.energies(end)["kinetic"]))


@pytest.mark.gpu
def test_total_gives_the_same_bits_twice():
    pytest.importorskip("triton")
    points = _points("cuda", count=2000)
    ends = []
    for _ in range(2):
        solver = _solver("triton", "total", deterministic=True)
        ends.append(solver.rollout(_start(solver, points), DT, 40, _load(points)))
    for name in ("position", "velocity", "F_elastic", "node_velocity", "work"):
        assert torch.equal(getattr(ends[0], name), getattr(ends[1], name))


# ---- graphs


@pytest.mark.parametrize(
    ("kernel_device", "boundary"),
    [*_on("handle"), pytest.param("cuda", None, marks=pytest.mark.gpu)],
    indirect=["kernel_device"],
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_nothing_is_left_of_former_rollouts(kernel_device, formulation, boundary):
    """Rollouts of the same kind share a recorded graph: the wind, its coefficients, patches, substep and time are new.

    The second of a kind is recorded, the third is replayed. If nothing is compiled there are buffers but no graphs.
    """
    count = 23 if kernel_device.type == "cuda" else 1
    points = _points(kernel_device, count=12)
    turning = Handle(LEFT, [0.5, 0.0, 0.2], [0.0, 9.0, 3.0], [0.1, 0.1, 0.1], start=1e-4, end=2.5e-4 * count)
    solvers = [
        _solver(transfer, formulation, boundaries=[] if boundary is None else [turning])
        for transfer in ("torch", "triton")
    ]
    state = _start(solvers[0], points, strain=0.02)
    _start(solvers[1], points)
    winds = [WIND, WIND, WIND, WindField([0.0, -40.0, 5.0]), WindField(schedule=[FlowKey(0.005, [30.0, 0.0, 0.0])])]
    for k, wind in enumerate(winds):
        if k in (1, 2) and kernel_device.type == "cpu":
            continue
        load = _load(points, wind, seed=4 if k < 4 else 11, C_D=0.5 + k)
        dt = [1e-4, 1e-4, 5e-5, 1e-4, 7e-5][k]
        if formulation == "updated":
            state = state.replace(grid=GridSpec(DX, (-2, -2, -2), (8, 8, 8 if k < 4 else 9)))
        expected, found = (solver.rollout(state, dt, count, load) for solver in solvers)
        _agree([expected, found], tolerance=1e-4)
        state = expected  # or the errors add up
        if k == 3 and kernel_device.type == "cuda":
            assert any(solvers[1].fused().repeater._graphs.values())
    # a rollout without wind is another kind
    _agree([solver.rollout(state, 1e-4, 2) for solver in solvers])
    _agree([solver.rollout(state, 1e-4, 2, load) for solver in solvers])


def test_a_grid_that_comes_back(kernel_device):
    """A graph recorded for a grid finds its node positions again, even after another grid was used."""
    points = _points(kernel_device)
    count = 4 if kernel_device.type == "cuda" else 1
    boundaries = [Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0])]
    solvers = [_solver(transfer, boundaries=boundaries) for transfer in ("torch", "triton")]
    state = _start(solvers[0], points)
    _start(solvers[1], points)
    load = _load(points)
    near, far = GridSpec(DX, (-2, -2, -2), (8, 8, 8)), GridSpec(DX, (-4, -3, -2), (8, 8, 7))
    for grid in (near, near, far, far, near, far) if kernel_device.type == "cuda" else (near, far):
        filler = [torch.full((512, 3), 1e3, device=kernel_device) for _ in range(20)]  # over the freed memory
        expected, found = (solver.rollout(state.replace(grid=grid), DT, count, load) for solver in solvers)
        _agree([expected, found])
        del filler
    larger = GridSpec(DX, (-8, -8, -8), (20, 20, 20))  # needs other buffers
    for grid in (larger, near):
        _agree([solver.rollout(state.replace(grid=grid), DT, count, load) for solver in solvers])


class _Played:
    """Recorded work that can be replayed without a GPU."""

    def __init__(self, work):
        self.replay = work

    def pool(self):
        return None

    def reset(self):
        del self.replay


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
def test_graphs_go_with_their_grid(kernel_device, monkeypatch):
    """Over a hundred grids, with substeps that only count themselves."""
    alive, substeps = weakref.WeakSet(), []

    def record(device, work, pool, stream):
        graph = _Played(work)
        alive.add(graph)
        return graph

    for place, name, value in (
        (_graphs, "record", record),
        (torch.cuda, "Stream", lambda device: None),
        (torch.cuda, "synchronize", lambda device: None),
        (torch.cuda, "empty_cache", lambda: None),
        (fused_updated.FusedUpdated, "_load", lambda self, state: None),
        (fused_updated.FusedUpdated, "_particles", lambda self, *more, **options: None),
        (fused_updated.FusedUpdated, "_nodes", lambda self, offset, options: substeps.append(offset)),
        (fused_updated.FusedUpdated, "_read", lambda self, state: {}),
    ):
        monkeypatch.setattr(place, name, value)
    points, solver = _points(kernel_device, count=4), _solver("triton")
    state = solver.init_state(points)
    solver.fused().repeater = _graphs.Repeater(torch.device("cuda"))
    for k in range(100):  # some of one size, some that need other buffers
        grid = GridSpec(DX, (-2, -2, -2 - k % 3), (8, 8, 8 + k))
        for recorded in (0, 3, 3):
            solver.rollout(state.replace(grid=grid), DT, 22)
            assert len(alive) == recorded
    assert len(substeps) == 100 * 3 * 22


def _cloud(count, seed=8):
    """Particles of a box of half a metre."""
    return _body(0.5 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)).cuda(), youngs_modulus=0.01)


@pytest.mark.gpu
def test_grids_that_grow_take_the_memory_of_the_largest():
    """Two hundred grids of up to 2.7 million nodes, each with graphs of its own.

    The most memory in use is the buffers and graphs of the largest grid, those of the grid before, and the temporaries
    of the substeps that were not recorded: three times the memory of the largest grid alone.
    """
    pytest.importorskip("triton")
    points = _cloud(500)
    far = VelocityBox(Box([8.0] * 3, [9.0] * 3), [0.0, 1.0, 0.0])  # in torch, which takes the most memory
    planes = [Plane([0.0, 0.0, -0.2], [0.0, 0.0, 1.0]), EnclosingBox([-9.0] * 3, [9.0] * 3), far]

    def most_reserved(sizes):
        solver = MPMSolver(dx=0.02, formulation="updated", transfer="triton", boundaries=planes)
        state, most = solver.init_state(points), 0
        for size in sizes:
            state = state.replace(grid=GridSpec(0.02, (-20, -20, -20), (size, size, size)))
            for _ in range(2):
                state = solver.rollout(state, 1e-5, 7)
                most = max(most, torch.cuda.memory_reserved())
            assert sum(map(len, solver.fused().repeater._graphs.values())) == 2  # of four substeps and of one
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
    """Its grid moves or grows over a hundred frames, but much less often than once per frame."""
    pytest.importorskip("triton")
    points = _cloud(500)
    solver = MPMSolver(
        dx=0.02, formulation="updated", transfer="triton", gravity=(0, 0, 0),
        boundaries=[Plane([0.0, 0.0, -99.0], [0.0, 0.0, 1.0])],
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
        assert sum(map(len, solver.fused().repeater._graphs.values())) <= 6
    assert not state.lost.any()
    assert 1 < len(set(grids)) < 40
    # some fifty numbers of four bytes a node in buffers and temporaries, three times over, and PyTorch's blocks
    assert most < 600 * max(grid.node_count for grid in grids) + 2e8


BROKEN = [("position", math.nan), ("position", math.inf), ("position", 1e30), ("velocity", math.nan)]
BROKEN += [("velocity", -math.inf), ("velocity", 1e12), ("velocity", 1e30)]


@pytest.mark.parametrize(("name", "value"), BROKEN)
@pytest.mark.parametrize("transfer", ["torch", "triton"])
def test_a_broken_particle_is_reported_and_breaks_nothing_else(kernel_device, transfer, name, value):
    """Also within recorded substeps, and the device stays usable."""
    points, steps = _points(kernel_device), 9 if kernel_device.type == "cuda" else 2
    solver = _solver(transfer, boundaries=[Plane([0.0, 0.0, -0.1], [0.0, 0.0, 1.0])])
    start = solver.fit_grid(_start(solver, points, strain=0.02), 0.04)
    end = good = solver.rollout(start, DT, steps)  # as it is, then recorded
    broken = getattr(start, name).clone()
    broken[5, 1] = value
    with torch.no_grad():
        for _ in range(2):
            end = solver.rollout(start.replace(**{name: broken}), DT, steps, check=False)
    with pytest.raises((FloatingPointError, ValueError), match=r"NaN or infinite|left the grid"):
        solver.rollout(start.replace(**{name: broken}), DT, steps)
    with pytest.raises(SimulationDiverged, match=r"particle .* (NaN or infinite|left the grid|object sizes)") as found:
        check_state(solver, end)
    if name == "position":  # it has affected no other particle
        assert found.value.particle == 5
        assert end.lost.tolist() == [k == 5 for k in range(24)]
        assert bool(torch.isfinite(end.velocity).all())
    with pytest.raises((FloatingPointError, ValueError)):
        solver.fit_grid(end, 0.04)
    again = solver.rollout(start, DT, steps)  # nothing remains
    _agree([good, again], tolerance=1e-4 if kernel_device.type == "cuda" else TOLERANCE)


# ---- the Courant number


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", ["corotated", "springs", "hencky"])
def test_courant_number(kernel_device, formulation, law):
    """Against float64; without care, the closed form of the eigenvalues loses digits if two are equal."""
    points = _points(kernel_device, ELASTIC[law], count=48)
    state = _start(_solver("torch", formulation), points)
    eye = torch.eye(3)
    stretches = torch.tensor([[2.0, 2.0, 1.0], [2.0, 1.0, 1.0], [0.5, 2.0, 2.0], [3.0, 3.0, 3.0], [1.0, 0.0, 0.0]])
    double = torch.linalg.qr(_random(30, 48, 3, 3))[0]
    double = double @ stretches[torch.arange(48) % 5].diag_embed() @ double.mT
    solver = _solver("triton", formulation)
    solver.init_state(points)
    exact = _solver("torch", formulation)
    exact.init_state(points.map(torch.Tensor.double))
    largest = []
    for F in (eye + 1e-4 * _random(31, 48, 3, 3), 4.0 * _random(32, 48, 3, 3), double, 1e-12 * double, 0 * double):
        at = state.replace(F_elastic=F.to(kernel_device))
        wide = {n: getattr(at, n).double() for n in ("F_elastic", "F_total", "velocity", "position")}
        largest.append(float(measures.largest_speed(solver.bound, at)))
        assert largest[-1] == pytest.approx(float(exact.bound.cells_per_second(at.replace(**wide))), rel=1e-5)
        # in torch and float32, where the digits are there
        if F is not double:
            assert float(solver.cfl_number(at, DT)) == pytest.approx(
                float(_bound(_solver("torch", formulation), points).cfl_number(at, DT)), rel=1e-5
            )
    assert len(set(largest)) >= (3 if law == "hencky" else 4)  # its logarithms are linear in all that is crushed
    for k in range(48):  # each particle counts
        F = torch.eye(3).repeat(48, 1, 1)
        F[k] *= 0.5 if law == "hencky" else 2  # stiffer than the others
        at = state.replace(F_elastic=F.to(kernel_device), velocity=torch.zeros_like(state.velocity))
        if k in (0, 17, 47):
            wide = {n: getattr(at, n).double() for n in ("F_elastic", "F_total", "velocity", "position")}
            one = float(exact.bound.cells_per_second(at.replace(**wide)))
            assert float(measures.largest_speed(solver.bound, at)) == pytest.approx(one, rel=1e-5)
            # a network never stiffens by more than particles differ in density
            assert one > 1.2 * largest[0] or law == "springs" or formulation == "updated"


def _bound(solver, points):
    solver.init_state(points)
    return solver


@pytest.mark.parametrize("law", ["corotated", "springs", "sand"])
def test_elastic_energy(kernel_device, law):
    """For a batch, against float64, and from the kernel."""
    points = _points(kernel_device, (ELASTIC | PLASTIC)[law], batch=(2,))
    solver = _solver("triton")
    state = _start(solver, points)
    exact = _solver("torch")
    wide = _start(exact, points.map(torch.Tensor.double))
    wide = wide.replace(F_elastic=state.F_elastic.double(), F_total=state.F_total.double())
    expected = exact.energies(wide)["elastic"]
    solver.laws.energy = None
    found = solver.energies(state)["elastic"]
    assert found.shape == (2,)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("law", ["corotated", "springs", "hencky"])
def test_courant_number_of_what_is_broken_is_not_finite(kernel_device, law):
    points = _points(kernel_device, ELASTIC[law])
    solver = _bound(_solver("triton"), points)
    state = _start(solver, points)
    state.F_elastic[3, 1, 1] = math.nan
    assert not math.isfinite(float(solver.cfl_number(state, DT)))


# ---- buffers


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_one_solver_within_inference_mode_and_without(kernel_device, formulation):
    points = _points(kernel_device, count=12)
    solvers = [_solver(transfer, formulation) for transfer in ("torch", "triton")]
    load = _load(points)
    with torch.inference_mode():
        ends = [solver.rollout(_start(solver, points), DT, 1, load) for solver in solvers]
    _agree([solver.rollout(end, DT, 2, load) for solver, end in zip(solvers, ends, strict=True)])


def test_nothing_is_recorded_that_has_not_run(kernel_device):
    """A single substep of ``updated`` uses no kernel that ends one and starts another; recording would compile it."""
    points = _points(kernel_device, count=12)
    solver = _solver("triton")
    state = solver.rollout(_start(solver, points), DT, 1)
    assert not solver.fused().repeater._graphs
    solver.rollout(state, DT, 2)
    assert solver.fused().repeater._graphs


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_patches_that_change_in_place(kernel_device, formulation):
    points = _points(kernel_device, count=12)
    load = _load(points)
    solvers = [_solver(transfer, formulation) for transfer in ("torch", "triton")]
    states = [_start(solver, points) for solver in solvers]
    _agree([solver.rollout(state, DT, 1, load) for solver, state in zip(solvers, states, strict=True)])
    load.area.mul_(3.0)
    _agree([solver.rollout(state, DT, 1, load) for solver, state in zip(solvers, states, strict=True)])


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries_that_change(kernel_device, formulation):
    """A different window, a different buffer and a different object in it, without ``init_state``."""
    points = _points(kernel_device, count=12)
    ends = []
    for transfer in ("torch", "triton"):
        pin, plane = PinnedRegion(LEFT), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")
        box = VelocityBox(Box([0.0, 0.0, 0.2], [1.0] * 3), [0.0, 1.0, 0.0])
        solver = _solver(transfer, formulation, boundaries=[pin, plane, box])
        state = _start(solver, points)
        found = [solver.rollout(state, DT, 1)]
        pin.end = 0.5 * DT
        found.append(solver.rollout(found[-1], DT, 1))
        plane.point = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64, device=kernel_device)
        found.append(solver.rollout(found[-1], DT, 1))
        box.region = TOP
        found.append(solver.rollout(found[-1], DT, 1))
        ends.append(found)
    _agree(ends)
    assert not torch.allclose(ends[0][1].velocity, ends[0][2].velocity, rtol=1e-2)


def test_laws_that_change(kernel_device):
    ends = []
    for transfer in ("torch", "triton"):
        law = Metal(5e2, 1e3)
        points, solver = _points(kernel_device, law, count=12), _solver(transfer)
        state = _start(solver, points)
        solver.rollout(state, DT, 1)
        law.yield_stress = 2e3
        ends.append(solver.rollout(state, DT, 1))
    _agree(ends)


def test_a_pin_that_opens(kernel_device):
    """A single pin is applied in the kernels themselves, as long as it has no window."""
    ends = []
    for transfer in ("torch", "triton"):
        pin = PinnedRegion(LEFT)
        solver, points = _solver(transfer, "total", boundaries=[pin]), _points(kernel_device, count=12)
        state = solver.rollout(_start(solver, points), DT, 1)
        pin.end = 0.5 * DT
        ends.append(solver.rollout(state, DT, 1))
    _agree(ends)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_buffers_end_with_their_solver(kernel_device, formulation):
    """Immediately: a GPU may need their memory for the next one before Python collects cycles."""
    points = _points(kernel_device, count=12)
    solver = _solver("triton", formulation)
    solver.rollout(_start(solver, points), DT, 1)
    buffer = weakref.ref(solver.fused().load)
    gc.disable()
    try:
        del solver
        assert buffer() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_what_is_too_large_for_the_indices_is_refused(kernel_device, formulation, monkeypatch):
    points = _points(kernel_device, count=12)
    monkeypatch.setattr(fused, "MAX_INDEX", 700)
    solver = _solver("triton", formulation)
    state = solver.init_state(points)
    with pytest.raises(ValueError, match=r"set `solver\.transfer` to torch"):
        solver.rollout(state, DT, 1)


# ---- where the kernels are used


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_gradients_are_left_to_torch_or_to_their_kernels(kernel_device, formulation):
    points = _points(kernel_device)
    auto = _solver("auto", formulation)
    state = _start(auto, points)
    velocity = state.velocity.clone().requires_grad_()
    load = _load(points)
    name = "node_velocity" if formulation == "total" else "velocity"
    start = state.replace(**{name: getattr(state, name).clone().requires_grad_()})
    assert auto.rollout(start, DT, 2, load).position.requires_grad
    assert auto.step(state, DT, force=velocity).position.requires_grad
    area = load.area.clone().requires_grad_()
    assert auto.rollout(state, DT, 1, WindForce(load.aero, load.wind, load.normal, area)).position.requires_grad
    knock = Impulse(Everything(), [0.0, 0.0, 0.1], end=DT)
    knock.impulse.requires_grad_()
    pushed = _solver("auto", formulation, boundaries=[knock])
    assert pushed.rollout(_start(pushed, points), DT, 1).position.requires_grad
    only = _solver("triton", formulation)
    only.init_state(points)
    attempts = [
        lambda: only.step(state, DT, force=velocity),
        lambda: only.rollout(state, DT, 1, WindForce(load.aero, load.wind, load.normal, area)),
        lambda: only.rollout(start, DT, 1, [load, load]),
    ]
    if formulation == "total":  # these have kernels, see test_adjoint.py
        assert only.rollout(start, DT, 2, load).position.requires_grad
        assert only.step(start, DT).position.requires_grad
    else:
        attempts += [lambda: only.rollout(start, DT, 2, load), lambda: only.step(start, DT)]
    for attempt in attempts:
        with pytest.raises(ValueError, match="`transfer: triton` has no gradients here"):
            attempt()
    with torch.no_grad():
        assert not only.rollout(start, DT, 1, load).position.requires_grad


class OwnLaw(FixedCorotated):
    """A custom law, which may do anything."""


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda points: (points.map(torch.Tensor.double), {}), "computes in float32, but the material is float64"),
        (lambda points: (dataclasses.replace(points, laws=(OwnLaw(),)), {}), "the law OwnLaw has no Triton twin"),
        (lambda points: (points, {"formulation": "updated", "deterministic": True}), "sums have no fixed order"),
    ],
    ids=["float64", "custom law", "deterministic"],
)
def test_what_the_kernels_cannot_do(kernel_device, change, reason):
    """``auto`` uses torch, ``triton`` raises an error with the reason."""
    points, options = change(_points(kernel_device))
    solver = MPMSolver(dx=DX, transfer="auto", **options)
    state = solver.init_state(points)
    assert solver.fused() is None
    assert bool(torch.isfinite(solver.step(state, DT).position).all())
    if kernel_device.type == "cuda":
        assert reason in solver._fused_obstacle
    with pytest.raises(ValueError, match=reason):
        MPMSolver(dx=DX, transfer="triton", **options).init_state(points)


def test_auto_takes_the_kernels_on_a_gpu_only(kernel_device):
    solver = MPMSolver(dx=DX)
    solver.init_state(_points(kernel_device))
    assert (solver.fused() is not None) == (kernel_device.type == "cuda")
    assert solver.deterministic is False
    solver = MPMSolver(dx=DX, deterministic=True)
    solver.init_state(_points(kernel_device))
    assert (solver.fused() is not None) == (kernel_device.type == "cuda")


def test_torch_means_torch(kernel_device):
    solver = MPMSolver(dx=DX, transfer="torch")
    solver.init_state(_points(kernel_device))
    assert solver.fused() is None


def test_another_material_needs_other_buffers(kernel_device):
    solver = _solver("triton", "total")
    solver.init_state(_points(kernel_device))
    first = solver.fused()
    assert solver.fused() is first
    solver.init_state(_points(kernel_device, count=7))
    assert solver.fused().count == 7


def test_settings_that_contradict():
    with pytest.raises(ValueError, match=r"transfer.*tritn"):
        MPMSolver(transfer="tritn")


@pytest.mark.skipif(fused is not None and fused.INTERPRETED, reason="the kernels run here without one")
def test_triton_without_a_gpu_says_so():
    with pytest.raises(ValueError, match=r"needs a CUDA device|Triton cannot be imported"):
        MPMSolver(dx=DX, transfer="triton").init_state(_points("cpu"))


class _Waiting(Boundary):
    """A custom condition that makes the host wait: it cannot be recorded."""

    def forward(self, velocity, nodes):
        return velocity * (0.5 if float(nodes.time) > 2.5 * DT else 1.0)


@pytest.mark.gpu
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_condition_that_waits_is_asked_each_time(formulation):
    pytest.importorskip("triton")
    points = _points(torch.device("cuda"))
    ends = []
    for transfer in ("torch", "triton"):
        solver = MPMSolver(dx=DX, formulation=formulation, transfer=transfer, boundaries=[_Waiting()])
        state = _start(solver, points)
        for _ in range(3):
            state = solver.rollout(state, DT, 2)
        ends.append(state.velocity)
    assert float((ends[1] - ends[0]).abs().max()) < 6 * TOLERANCE * float(ends[0].abs().max())
