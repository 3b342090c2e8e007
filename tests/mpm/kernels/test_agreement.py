"""The fused substep against torch: scenes in which laws, boundaries, winds, damping and batches meet.

Each law, boundary, wind and damping is in one scene at least of each formulation that has it; on a GPU all boundaries
are in both.
"""

import dataclasses

import pytest
import torch
from catalogue import BOUNDARIES as KINDS
from catalogue import ELASTIC, MESH, PLASTIC, conditions, made
from shared import ZERO, in_both, normalized, peak, seeded

from gaussian_swaying import AeroForce, WindField, WindForce
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Box, Capsule, Everything, HalfSpace, Mesh, Sphere
from gaussian_swaying.kernels.launch import lanes
from gaussian_swaying.mpm import total
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.wind.patches import Patches

from .bodies import (
    DT,
    DX,
    FORMULATIONS,
    LEFT,
    TOLERANCE,
    TOP,
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

WINDOW = {"start": 0.5 * DT, "end": 1.5 * DT}  # of three substeps the first and the last lie outside
HANDLE = made("PinnedRegion", LEFT, velocity=[0.5, 0.0, 0.2], angular_velocity=[0.0, 30.0, 9.0], pivot=[0.1, 0.1, 0.1])
RELEASE = made("PinnedRegion", LEFT, front=[[0.0, 1.0, 0.0]], end=1.5 * DT)
HINGE, NODES = made("PinnedRegion", LEFT), made("PinnedRegion", LEFT, "nodes")
SLOPE = made("Wall", HalfSpace([0.0, 0.0, 0.13], [0.1, 0.0, 1.0]))
FLOOR = made("Wall", HalfSpace([0.0, 0.0, 0.13], [0.0, 0.0, 1.0]), "sticky")
BOX = made("Wall", Box([0.1, 0.1, 0.1], [0.2, 0.2, 0.2]), "slip", 0.2)
ONE = made("PinnedPoints", [[0.2, 0.1, 0.1]])
PATH = KeyedPath([DT, 30 * DT], [[0.0, 0.0, 0.0], [0.2, -0.1, 0.05]], [[0.0, 10.0, 20.0], [50.0, -20.0, 90.0]])


def sharper(pin, share):
    return changed(pin, pinned_share=share)


def top_nodes():
    return sharper(made("PinnedRegion", TOP, "nodes")(), 0.4)


BOUNDARIES = {
    "none": list,
    "pin": lambda: [NODES()],
    "hinge": lambda: [HINGE()],
    "two pins": lambda: [NODES(), top_nodes()],
    "pin for some time": lambda: [NODES(**WINDOW)],
    "hinge for some time": lambda: [HINGE(**WINDOW)],
    "handle": lambda: [HANDLE(kind="nodes", **WINDOW)],
    "hinged handle": lambda: [HANDLE(**WINDOW)],
    "release": lambda: [RELEASE(kind="nodes", start=0.5 * DT)],
    "release of points": lambda: [RELEASE(start=0.5 * DT)],
    "impulse": lambda: [made("Impulse", TOP, [0.01, 0.0, 0.02])(**WINDOW)],
    "plane": lambda: [SLOPE(kind="separate", friction=0.4, **WINDOW)],
    "box": lambda: [BOX()],
    "walls": lambda: [
        SLOPE(kind="sticky", **WINDOW),
        made("Wall", Box([0.11, 0.1, 0.1], [0.2, 0.2, 0.2]), "separate", 0.1, end=1.5 * DT)(),
    ],
    "velocity box": lambda: [conditions(TOP)["velocity"](**WINDOW)],
    "walls and pins": lambda: [
        SLOPE(kind="separate", friction=0.4),
        NODES(**WINDOW),
        BOX(),
        made("PinnedRegion", TOP, "nodes", start=0.5 * DT)(),
    ],
    "pin and plane": lambda: [NODES(), FLOOR()],
    "knock and release": lambda: [
        made("PinnedRegion", LEFT, front=[[0.0, 0.0, 1.0]], end=1.5 * DT)(),
        made("Impulse", Everything(), [0, 0, 0.02], end=DT)(),
    ],
    "release and plane": lambda: [RELEASE(), made("Wall", HalfSpace([0.0, 0.0, 0.13], [0.0, 0.0, 1.0]))()],
}
POINT_HOLDS = {  # for `total` alone
    "clamp": lambda: [HINGE(kind="clamp")],
    "points": lambda: [made("PinnedPoints", [[0.1, 0.12, 0.11], [0.2, 0.17, 0.13]])()],
    "hinge and nodes": lambda: [HINGE(), top_nodes()],
    "nodes, hinge and clamp": lambda: [HINGE(), top_nodes(), ONE(kind="clamp"), sharper(NODES(), 0.5)],
    "points and plane": lambda: [ONE(), FLOOR()],
    "points one after the other": lambda: [
        HINGE(end=1.5 * DT),
        ONE(kind="clamp", start=0.5 * DT),
        made(
            "PinnedRegion",
            TOP,
            "clamp",
            velocity=[0.5, 0.0, 0.2],
            angular_velocity=[0.0, 30.0, 9.0],
            pivot=[0.1, 0.1, 0.1],
            start=1.5 * DT,
        )(),
    ],
}
OTHERS = {  # obstacles for `updated` alone, where they stop nodes; wind on a rigid part differs
    "rigid part": lambda: [made("RigidRegion", TOP)(), NODES()],
    "obstacles": lambda: [
        made("Obstacle", Sphere([0.1, 0.1, 0.05], 0.06), 0.4)(),
        SLOPE(kind="separate", friction=0.2, end=1.5 * DT),
        made("Obstacle", Box([0.2, 0.05, 0.05], [0.3, 0.25, 0.15]), rotation=[0.0, 0.0, 20.0], friction=0.3)(),
    ],
    "moving obstacles": lambda: [
        made("Obstacle", Capsule([0.05, 0.05, 0.1], [0.1, 0.2, 0.1], 0.05), path=PATH, start=0.5 * DT)(),
        made("Obstacle", Mesh(MESH, 8, [0.25, 0.25, 0.1]), 0.5, path=PATH)(),
    ],
}
SEMI = {"drag_step": "semi_implicit"}
LOSSES = {"gravity": (1.0, 2.0, -9.8), "damping": 20.0, "stiffness_damping": 2e-3}
SCENES = [  # formulation, laws, boundaries, wind, other settings; `groups` are several patches on each point
    ("total", "corotated", "hinge", SEMI, {}),
    ("total", "neo-hookean", "hinged handle", {"law": "projected"}, LOSSES),
    ("total", "springs", "two pins", {"max_area_ratio": 0.9}, {}),
    ("total", "hencky", "plane", {"law": "linear", **SEMI}, {"damping": 20.0, "rates": True}),
    ("total", "corotated, neo-hookean", "box", {"law": "cross_flow", **SEMI}, {}),
    ("total", "neo-hookean, hencky", "clamp", {"law": "linear"}, {}),
    ("total", "corotated", "points", {"max_area_ratio": 0.9, **SEMI}, {"groups": True}),
    ("total", "corotated", "nodes, hinge and clamp", {"law": "projected"}, {"groups": True}),
    ("total", "springs", "points and plane", {"law": "linear", **SEMI}, {"groups": True}),
    ("total", "corotated", "points one after the other", {"law": "cross_flow"}, {"groups": True}),
    ("total", "corotated", "rigid part", None, {}),
    ("total", "springs", "clamp", {}, {"sheet": True}),
    ("total", "corotated", "none", {}, {"sheet": True, "batch": (2,), **LOSSES}),
    ("total", "hencky", "hinge", {}, {"sheet": True, "apart": True}),
    ("total", "corotated", "none", None, {"damping": 0.0}),
    ("total", "corotated", "release and plane", {}, {"batch": (2,)}),
    ("total", "corotated", "hinge and nodes", {}, {"batch": (2,)}),
    ("updated", "corotated", "handle", SEMI, {}),
    ("updated", "neo-hookean", "knock and release", {"law": "projected"}, LOSSES),
    ("updated", "hencky", "walls", {"max_area_ratio": 0.9}, LOSSES),
    ("updated", "sand", "box", {"law": "linear", **SEMI}, {"groups": True}),
    ("updated", "sand that swells", "two pins", {"law": "cross_flow", **SEMI}, {}),
    ("updated", "snow", "none", {"law": "linear"}, {}),
    ("updated", "fluid", "walls and pins", {"max_area_ratio": 0.9, **SEMI}, {"groups": True}),
    ("updated", ", ".join(ELASTIC), "none", {"law": "projected"}, {"groups": True}),
    ("updated", "neo-hookean, fluid, snow", "none", {}, {}),
    ("updated", "metal, foam, plasticine", "none", {}, {}),
    ("updated", "corotated", "obstacles", {"law": "cross_flow"}, {"groups": True}),
    ("updated", "corotated", "moving obstacles", None, {}),
    ("updated", "corotated", "rigid part", None, {}),
    ("updated", "corotated", "none", None, {"damping": 0.0}),
    ("updated", "corotated", "release and plane", {}, {"batch": (2,)}),
    ("updated", "corotated", "walls", None, {"batch": (3,)}),
]
ON_A_GPU = [
    ("total", ", ".join(ELASTIC), "none", {}, {}),
    ("updated", ", ".join(ELASTIC | PLASTIC), "none", {}, {"count": 60}),
    *((formulation, "corotated", name, {}, {}) for formulation in FORMULATIONS for name in BOUNDARIES),
    *(("updated", "corotated", name, None, {"batch": (3,)}) for name in ("pin and plane", "walls and pins")),
]


def _named(scenes, device, **more):
    return [pytest.param(device, scene, id=f"{device}: {', '.join(scene[:3])}", **more) for scene in scenes]


def _groups(points, count, aero):
    normal = normalized(noise(6, count, 3))
    area = 0.01 * torch.rand(count, generator=seeded(6))
    which = torch.randint(0, points.count - 3, (count,), generator=seeded(7))
    return WindForce(AeroForce(**{"C_L": 0.3, **aero}), WIND, Patches(normal, area, which, points.count))


def _settled(solver, points):
    return solver.rollout(set_going(solver, points), DT, 1)


@pytest.mark.parametrize(
    ("kernel_device", "scene"),
    _named(SCENES, "cpu") + _named(SCENES + ON_A_GPU, "cuda", marks=pytest.mark.gpu),
    indirect=["kernel_device"],
)
def test_kernels_do_what_torch_does(kernel_device, scene):
    formulation, names, boundaries, aero, more = scene
    more = dict(more)
    groups, batch, count = more.pop("groups", False), more.pop("batch", ()), more.pop("count", 24)
    laws = [(ELASTIC | PLASTIC)[law] for law in names.split(", ")]
    index = torch.randint(len(laws), (count,), generator=seeded(6)) if len(laws) > 1 else None
    rates = 40 * torch.rand(count, generator=seeded(1)) if more.pop("rates", False) else None
    bends = {}
    if more.pop("sheet", False):
        normal = torch.tensor([0.36, 0.48, 0.8]).expand(*batch, count, 3)
        bends = {"normal": normal.to(kernel_device), "bending": 1e-4 * (1 + noise(12, *batch, count).abs())}
    if more.pop("apart", False):
        bends["attached"] = torch.arange(count) % 2
    points = make_points(kernel_device, laws, count, batch, law_index=index, damping=rates, **bends)
    if kernel_device.type == "cpu":
        points = points.map(torch.Tensor.double)

    def load(patches):
        if aero is None:
            return None
        force = _groups(points, patches, aero) if groups else make_load(points, **aero)
        return force.to(kernel_device, points.position.dtype)

    def run(solver, state):
        state = solver.rollout(state, DT, 1, load(90))
        return [state, solver.rollout(state, DT, 1 if boundaries == "none" else 2, load(130))]

    make = (BOUNDARIES | POINT_HOLDS | OTHERS)[boundaries]
    start = _settled if bends or boundaries == "rigid part" else set_going
    ends = run_both(points, run, formulation, start, boundaries=make(), **more)
    # snow hardens by exp(10 (1 - J)); against double precision, torch's velocity is off by 1.1e-5, the kernels' by 2e-5
    single = 4e-5 if names == "snow" else TOLERANCE
    check_agreement(ends, single if kernel_device.type == "cuda" else 1e-8)
    if laws[0].plastic and boundaries == "none":
        assert peak(ends[1][1].F_elastic - ends[1][1].F_total) > 0.01
    if aero is None:
        assert not ends[1][1].work.any()
    if boundaries != "none":
        assert peak(ends[1][1].impulse) > 1e-4
        free = make_solver("torch", formulation, **more)
        with torch.no_grad():
            velocity = run(free, start(free, points))[1].velocity
        assert not torch.allclose(velocity, ends[0][1].velocity, rtol=1e-3)


def test_an_obstacle_of_a_user_runs_in_torch(kernel_device):
    class Bumpy(KINDS["Obstacle"]):
        def distance(self, place):
            distance, normal = super().distance(place)
            return distance - 0.01 * torch.sin(40 * place[..., 0]), normal

    def run(solver, state):
        assert solver.transfer == "torch" or solver.kernels.own_solids == []
        return solver.rollout(state, DT, 3)

    points = make_points(kernel_device, count=12)
    ends = run_both(points, run, boundaries=[Bumpy(Sphere([0.1, 0.1, 0.05], 0.06))])
    check_agreement(ends)
    assert peak(ends[1].impulse) > 1e-4


@in_both
def test_crushed_and_inverted_particles(kernel_device, formulation):
    def start(solver, points):
        if solver.neighbours_fixed:
            state = set_going(solver, points, strain=0.9)
            assert (torch.linalg.det(state.F_elastic) < 0).any()
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


@in_both
def test_wind_along_the_normal(kernel_device, formulation):
    points = make_points(kernel_device)
    up = torch.tensor([0.0, 0.0, 1.0], device=kernel_device).expand(*points.position.shape)
    wind = WindField([0.0, 0.0, -50.0]).to(kernel_device)
    load = WindForce(AeroForce().to(kernel_device), wind, up, 0.01 * torch.ones_like(points.mass))

    def run(solver, state):
        return solver.rollout(state, DT, 1, load)

    ends = run_both(points, run, formulation, start=lambda solver, points: solver.init_state(points))
    check_agreement(ends, names=["position", "velocity", "affine", "F_elastic"])


def test_patches_without_flow_and_flat_ones(kernel_device):
    def start(solver, points):
        state = set_going(solver, points)
        state.velocity[:4] = torch.tensor(WIND.flows[0].tolist(), device=kernel_device)
        F = state.F_total.clone()
        F[2] = F[5] = 0.0
        return state.replace(F_total=F)

    check_agreement(run_in_wind(make_points(kernel_device, PLASTIC["sand"]), "updated", start=start))


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    [
        *on_each(("total", [1]), ("updated", [1]), ("total", [1, 3, 0, 64, 65, 130]), cpu=[("updated", [3, 0, 64])]),
        pytest.param("cuda", ("updated", [1, 3, 0, 64, 65, 130]), marks=pytest.mark.gpu),
    ],
    indirect=["kernel_device"],
    ids=str,
)
@pytest.mark.parametrize("programs", [1, 2048])
def test_cells_of_any_size(kernel_device, case, programs, monkeypatch):
    formulation, sizes = case
    if programs > 1 and (formulation == "updated" or lanes(kernel_device, 64) < 64):
        pytest.skip("only `total` cuts cells, and only on a GPU")
    monkeypatch.setattr(total, "_PROGRAMS", programs)
    if len(sizes) > 2:
        monkeypatch.setattr(total, "_lanes", lambda sizes: 64)
    generator = seeded(7)
    cells = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    place = 0.52 + 0.96 * torch.rand(len(cells), 3, generator=generator)  # of a cell, from the first node
    place[:, 2] += cells
    place = place[torch.randperm(len(place), generator=generator)]
    check_agreement(run_in_wind(make_body((place * DX).to(kernel_device)), formulation))


@pytest.mark.gpu
@pytest.mark.parametrize("number", [32, 128])
def test_every_number_of_lanes(number, monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.setattr(total, "_lanes", lambda sizes: number)
    check_agreement(run_in_wind(make_points("cuda", count=300), "total"))


def test_a_node_adds_only_the_cells_around_it(monkeypatch):
    """A sheet one cell thick has at most nine cells around a node, and each of a node's rows is that of its place."""
    cell = torch.full((27, 2), 5)
    cell[[3, 20], 0] = torch.tensor([4, 2])
    cell[26, 1] = 0
    assert total._sources(cell, 5).tolist() == [[3 * 6 + 4, 26 * 6], [20 * 6 + 2, 5]]


@in_both
def test_particles_on_the_borders_of_cells(kernel_device, formulation):
    steps = torch.tensor([0.05, 0.15, 0.1, 0.25])
    position = torch.cartesian_prod(steps, steps, steps)[:32]
    position = torch.cat([position, torch.nextafter(position, torch.zeros(()))[5:13]])
    check_agreement(run_in_wind(make_body(position.to(kernel_device)), formulation))


def test_what_leaves_the_grid_is_lost(kernel_device):
    points = make_points(kernel_device)
    outside = torch.tensor([[0.13, 0.14, 0.5], [0.5, 0.1, 0.1], [0.13, -0.4, 0.1], [0.15, 0.12, 0.349], [90.0, 0, 0]])
    count = len(outside)
    position = torch.cat([points.position[:-count], outside.to(kernel_device)])
    points = dataclasses.replace(points, position=position)
    grid = GridSpec(DX, (0, -1, 0), (5, 6, 5))

    def start(solver, points):
        state = set_going(solver, points).replace(grid=grid)
        state.velocity[-2, 2] = 60.0  # from within the grid
        return state

    def run(solver, state):
        states = [solver.rollout(state, DT, steps, check=False) for steps in (1, 4)]
        assert states[0].lost.tolist() == [False] * 19 + [True] * 3 + [False, True]
        assert states[1].lost.tolist() == [False] * 19 + [True] * 5
        assert float(peak(states[1].velocity[-1])) == 0.0
        assert torch.equal(states[1].position[-5:-2], state.position[-5:-2])
        roomy = states[1].replace(grid=GridSpec(DX, (-1, -6, -1), (9, 12, 9)))
        states.append(solver.rollout(roomy, DT, 1, check=False))
        assert torch.equal(states[2].lost, states[1].lost)  # though most are back
        return states

    check_agreement(run_both(points, run, start=start, gravity=ZERO))
