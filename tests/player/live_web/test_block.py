import hashlib
from dataclasses import replace

import pytest
import torch
from shared import longest, value_error
from small_scenes import GREEN, block, together

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.laws.elastic import NeoHookean
from gaussian_swaying.player.live_web.block import check
from gaussian_swaying.player.live_web.page import PAGE
from gaussian_swaying.scenes.demo import DemoScene
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import SIDE, apart, moved_means


def run(simulation, frames):
    state, steps = simulation.start(), 0
    for _ in range(frames):
        steps += simulation.stepper.substeps(state)
        state, _ = simulation.advance(state)
    return state, steps


def test_a_sheet_in_gusts_after_two_seconds(make, in_node):
    """The same kernels: only their rounding differs, and what gusts make of it."""
    simulation = make()
    state, steps = run(simulation, 50)
    told, moved = in_node(simulation, {"kind": "frames", "count": 50})
    error, motion = apart(simulation, state, moved)
    assert motion > 0.1
    assert error < 1e-4
    assert told[0]["substeps"] == steps


def test_longest_steps(make, in_node):
    """Where a page falls behind, it takes fewer substeps, and is still within 1 % of the motion after two seconds."""
    simulation = make()
    state, steps = run(simulation, 50)
    told, moved = in_node(simulation, {"kind": "frames", "count": 50, "hurried": True})
    assert apart(simulation, state, moved)[0] < 0.01
    assert told[0]["substeps"] < 0.75 * steps


BELOW = {"class_path": "HalfSpace", "init_args": {"point": [0, 0, -0.18], "normal": [0, 0.2, 1]}}
PLANE = {"class_path": "Wall", "init_args": {"shape": BELOW, "friction": 0.4}}
CLAMP = {"class_path": "PinnedRegion", "init_args": {"region": SIDE, "kind": "clamp"}}
NODES = {"class_path": "PinnedRegion", "init_args": {"region": SIDE, "kind": "nodes"}}
POINT = {"class_path": "PinnedPoints", "init_args": {"at": [[0.0, 0.0, 0.4]]}}
FLOWS = [{"time": 0.1, "flow": [1, 1, 0], "gusts": 0.5}, {"time": 0.3, "flow": [0, 3, 0]}, {"time": 0.4, "gusts": 3}]
SOFT = {"region": {"class_path": "Box", "init_args": {"min": [0.3, None, None], "max": [None] * 3}}, "E": 1e4}


ROD = {"center": [-0.3, 0.1, 0.2], "radii": [0.1, 0.1, None], "drag": 0.5}
EFFECTS = [{"class_path": f"gaussian_swaying.wind.{name}"} for name in ("turbulence.Turbulence", "effects.Profile")]
EFFECTS.append({"class_path": "gaussian_swaying.wind.effects.Obstacle", "init_args": ROD})


class Own(NeoHookean):
    """A law that only this file knows."""


def law(name):
    return {"class_path": name}


CASES = {
    "neo-hookean, paper": {"material": {"law": law("NeoHookean")}, "aero": {"law": "paper"}},
    "hencky, cross flow": {"material": {"law": law("StVKHencky")}, "aero": {"law": "cross_flow"}},
    "springs, viscous": {
        "material": {"law": law("SpringNetwork")},
        "solver": {"stiffness_damping": 2e-3, "damping": 0.0},
    },
    "two laws, schedule": {
        "material": {"regions": [SOFT | {"law": law("NeoHookean")}], "damping_ratio": 0.6},
        "wind": {"interpolation": "linear", "schedule": FLOWS},
    },
    "cross flow, fixed substep": {"solver": {"substep": 8e-4}, "aero": {"law": "cross_flow"}},
    "linear, semi-implicit": {"aero": {"law": "linear", "drag_step": "semi_implicit", "max_area_ratio": 1.01}},
    "one patch a point": {"scene": {"points": "gaussian"}, "aero": {"law": "linear", "max_area_ratio": 1.01}},
    "one patch, cross flow": {"scene": {"points": "gaussian"}, "aero": {"law": "cross_flow"}},
    "light and rough": {"material": {"density": 2.0, "E": 2e3}, "aero": {"C_F": 9.0}},
    "clamp": {"scene": {"layers": 3}, "solver": {"boundaries": [CLAMP]}},
    "bending": {"material": {"bending": "plate", "E": 1e5}},
    "a law of one's own": {"material": {"law": law(f"{__name__}.Own")}},
    "carried air, and its weight": {"aero": {"added_mass": 0.5}, "solver": {"gravity": [0.0, 1.0, -9.8]}},
    "effects": {"wind": {"effects": EFFECTS, "interpolation": "linear", "schedule": FLOWS}},
    "nodes and a point, still air": {
        "solver": {"boundaries": [NODES, POINT]},
        "aero": {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0},
    },
}


@pytest.mark.parametrize("name", CASES)
def test_laws_forces_and_boundaries(make, in_node, name):
    simulation = make(**CASES[name])
    state, steps = run(simulation, 10)
    told, moved = in_node(simulation, {"kind": "frames", "count": 10})
    error, motion = apart(simulation, state, moved)
    assert motion > 5e-3
    assert error < 1e-4
    assert told[0]["substeps"] == steps


def obstacle(shape, gap=0.0, start=0.0, friction=0.4, path=None, **options):
    more = {"gap": gap, "start": start, "friction": friction, "rotation": options.pop("rotation", [0.0] * 3)}
    more |= {"path": path}
    made = {"class_path": shape, "init_args": options}
    return {"class_path": "Obstacle", "init_args": {"shape": made, **more}}


RISE = {"times": [0.3, 0.9], "moves": [[0, 0, 0], [0, 0, 0.3]], "turns": [[0, 0, 0], [60, 0, 90]]}
OBSTACLES = {
    "ground and ball": [
        obstacle("HalfSpace", point=[0, 0, -0.1], normal=[0, 0.1, 1]),
        obstacle("Sphere", center=[0.25, 0.15, 0.1], radius=0.1, gap=0.005),
    ],
    "box": [obstacle("Box", min=[0.2, 0.05, -0.2], max=[0.5, 0.2, 0.1], rotation=[0.0, 0.0, 20.0])],
    "box that rises and turns": [obstacle("Box", path=RISE, min=[0.15, 0.1, -0.5], max=[0.45, 0.4, -0.3])],
    "rod, later": [obstacle("Capsule", first=[0.25, -0.3, 0.0], second=[0.25, 0.4, 0.05], radius=0.04, start=0.1)],
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_contact_with_obstacles(make, in_node, name):
    pins = {"class_path": "PinnedRegion", "init_args": {"region": SIDE}}
    simulation = make(solver={"boundaries": [pins, *OBSTACLES[name]]})
    state, steps = run(simulation, 50)
    free, _ = run(make(), 50)
    stopped = longest(state.position - free.position)
    told, moved = in_node(simulation, {"kind": "frames", "count": 50})
    error, motion = apart(simulation, state, moved)
    assert motion > 0.05
    assert float(stopped) > 0.1 * motion
    assert error < 1e-4
    assert told[0]["substeps"] == steps


def test_a_rider_on_the_ground(make, in_node, tmp_path):
    write_ply(tmp_path / "box.ply", block([0.4, 0.4, 0.3], GREEN))
    scene = {"generator": None, "ply": str(tmp_path / "box.ply"), "metres_per_unit": 1.0}
    ground = obstacle("HalfSpace", point=[0, 0, 0], normal=[0, 0, 1], friction=0.1)
    solver = {"boundaries": [ground], "gravity": [0.0, 3.0, -9.0]}
    simulation = make(scene=scene, solver=solver, material={"E": 1e5})
    state, _ = run(simulation, 50)
    _, moved = in_node(simulation, {"kind": "frames", "count": 50})
    error, motion = apart(simulation, state, moved)
    assert motion > 0.1
    assert error < 1e-4


def box(low, high):
    return {"class_path": "Box", "init_args": {"min": low, "max": high}}


def test_a_ball_on_a_cloth(make, in_node, tmp_path):
    made = DemoScene("ball_on_cloth", spacing=0.04, size=0.8).generate()
    means = made.means.clone()
    means[:, 2] -= torch.where(means[:, 2] > 0.6, 0.13, 0.0)  # as low as it may be without sharing nodes
    write_ply(tmp_path / "ball.ply", replace(made, means=means))
    parts = [box([-0.39, -0.39, 0.495], [0.39, 0.39, 0.505]), box([-0.3, -0.3, 0.51], [0.3, 0.3, None])]
    region = {"class_path": "Union", "init_args": {"regions": parts}}
    scene = {"generator": None, "ply": str(tmp_path / "ball.ply"), "region": region, "filling": {"votes": 0.6}}
    rim = {"class_path": "Not", "init_args": {"region": box([-0.36, -0.36, None], [0.36, 0.36, None])}}
    pin = {"class_path": "PinnedRegion", "init_args": {"region": rim}}
    changes = {"scene": scene | {"metres_per_unit": 1.0}, "material": {"density": 50.0}}
    solver = {"boundaries": [pin], "dx": 0.05, "damping": 8.0, "gravity": [0.0, 0.0, -1.0]}
    changes |= {"solver": solver, "wind": {"flow": [0.3, 0.0, 0.0], "modulations": []}}
    simulation = make(**changes, contact={"thickness": 0.02})
    state, steps = run(simulation, 50)
    told, moved = in_node(simulation, {"kind": "frames", "count": 50})
    error, motion = apart(simulation, state, moved)
    print("ERR", error, motion)
    fallen, _ = run(make(**changes), 50)
    assert longest(fallen.position - state.position) > 0.1 * motion
    assert error < 1e-4
    assert told[0]["substeps"] == steps


ROUNDED = 2.5e-3
"""Of the motion: shapes are rounded to some thousandths, and turbulence to a sixteenth of its standard deviation."""


def test_the_starter_of_a_plant_by_its_modes(sway, in_node):
    simulation = sway()
    state, steps = run(simulation, 50)
    steady, _ = run(sway(wind={"effects": []}), 50)
    told, moved = in_node(simulation, {"kind": "frames", "count": 50})
    error, motion = apart(simulation, state, moved)
    assert motion > 0.05
    assert longest(state.position - steady.position) > 0.1 * motion
    assert error < ROUNDED
    assert told[0]["substeps"] == steps


def test_parts_with_nodes_of_their_own(make, in_node, tmp_path):
    sheet = FlagScene(spacing=0.05).generate()
    places = [sheet.means + torch.tensor([0.0, y, 0.0]) for y in (-0.045, 0.04)]
    write_ply(tmp_path / "two.ply", together(*(replace(sheet, means=place) for place in places)))
    scene = {"generator": None, "ply": str(tmp_path / "two.ply"), "connected": "surface", "metres_per_unit": 1.0}
    simulation = make(scene=scene)
    _, moved = in_node(simulation, {"kind": "frames", "count": 10})
    state, _ = run(simulation, 10)
    assert state.grid.virtual > 0
    assert apart(simulation, state, moved)[0] < 1e-4


def test_what_the_visitor_does(make, in_node):
    """Another wind and stiffness are those of another configuration; a pull moves the place towards its aim."""
    wind = {"kind": "wind", "flow": [0.0, -2.0, 0.0], "gusts": 0.0}
    frames = {"kind": "frames", "count": 10}
    _, moved = in_node(make(), wind, {"kind": "stiffness", "factor": 2.0}, frames)
    same = make(wind={"flow": [0.0, -2.0, 0.0], "modulations": []}, material={"E": 4e4})
    assert apart(same, run(same, 10)[0], moved)[0] < 1e-3
    _, again = in_node(make(), frames, wind, {"kind": "stiffness", "factor": 2.0}, {"kind": "reset"}, frames)
    assert torch.equal(again, moved)
    grab = {"kind": "grab", "token": 7, "eye": [0.2, 2.0, 0.0], "ray": [0.0, -1.0, 0.0], "wide": 0.01}
    aim = {"kind": "aim", "target": [0.2, -0.15, 0.0]}
    simulation = make()
    told, moved = in_node(simulation, grab, aim, frames)
    assert told[0]["token"] == 7
    assert abs(told[0]["place"][0] - 0.2) < 0.1
    state = simulation.start()
    pulled = moved_means(simulation, state, moved)[:, 1]
    free = moved_means(simulation, state, in_node(simulation, grab, aim, {"kind": "release"}, frames)[1])[:, 1]
    assert free.min() > -0.05
    assert -0.2 < pulled.min() < -0.1
    beside, _ = in_node(make(), grab | {"eye": [2.0, 2.0, 0.0]})
    assert beside[0]["place"] is None


def test_what_the_visitor_does_to_modes(sway, in_node):
    simulation = sway(solver={"gravity": [0.0, 0.0, -9.8]})
    wind = {"kind": "wind", "flow": [0.0, -2.0, 0.0], "gusts": 0.0}
    frames, stiffer = {"kind": "frames", "count": 10}, {"kind": "stiffness", "factor": 2.0}
    _, moved = in_node(simulation, frames, wind, stiffer, {"kind": "reset"}, frames)
    modulus = 2 * float(simulation.model.points.youngs_modulus[0])
    same = sway(
        solver={"gravity": [0.0, 0.0, -9.8]}, wind={"flow": wind["flow"], "effects": []}, material={"E": modulus}
    )
    assert apart(same, run(same, 10)[0], moved)[0] < ROUNDED
    simulation, calm = sway(), (wind | {"flow": [0.0, 0.0, 0.0]}, stiffer | {"factor": 0.125})
    grab = {"kind": "grab", "token": 7, "eye": [0.0, -3.0, 0.4], "ray": [0.0, 1.0, 0.0], "wide": 0.01}
    aim = {"kind": "aim", "target": [0.1, -0.24, 0.4]}
    told, moved = in_node(simulation, *calm, grab, aim, frames)
    assert told[0]["place"] == pytest.approx([0.0, -0.24, 0.4], abs=0.05)
    along = moved_means(simulation, simulation.start(), moved) - simulation.scene.rest().means
    assert 0.02 < along[:, 0].max() < 0.1
    _, free = in_node(simulation, *calm, grab, aim, {"kind": "release"}, frames)
    assert not free.any()


class Lift(Force):
    def forward(self, state):
        return state.velocity


REFUSED = {
    "solver.formulation": {"solver": {"formulation": "updated"}},
    "copies": {"copies": [{"shift": [0, 0, 0]}, {"shift": [0, 2, 0]}]},
    "edits": {"edits": [{"time": 1.0, "E": 1e4}]},
    "the Wall": {"solver": {"boundaries": [PLANE]}},
    "dtype": {"dtype": "float64"},
    "forces": {"forces": [{"class_path": f"{__name__}.Lift"}]},
    "wind.effects": {"wind": {"effects": [{"class_path": "gaussian_swaying.wind.tables.Shelter"}]}},
    "start": {"solver": {"boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": SIDE, "end": 1.0}}]}},
    "solver.boundaries": {
        "solver": {"boundaries": [{"class_path": "VelocityBox", "init_args": {"region": SIDE, "velocity": [1, 0, 0]}}]}
    },
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_browser_cannot_simulate_is_refused(make, name):
    with value_error(rf"^The page of --live-web cannot simulate .*{name}.*\.$"):
        check(make(**REFUSED[name]))


def test_the_worker_is_built_from_its_sources(request):
    player = request.config.rootpath / "tools/player"
    own = [
        "block.js",
        "body.js",
        "modal.js",
        "solver.js",
        "webgpu.js",
        "wind.js",
        "worker.js",
    ]
    names = ["build.js", "bundle.js", *(f"live_web/{name}" for name in own), "package-lock.json"]
    of_the_page = {"page.js"}
    assert {path.name for path in (player / "live_web").iterdir()} == {*own, *of_the_page, "run.js"}
    checksum = hashlib.sha256(b"".join((player / name).read_bytes() for name in names)).hexdigest()
    assert (PAGE / "worker.min.js").read_text().startswith(f"// Made by tools/player from {checksum}\n")
