"""A Mac: `--device mps` on a pretended device (tests/pretend_mps.py), and kernels for the CPU of one.

What is asked of the device is checked against what torch has there: no double precision, no operation without a kernel.
"""

import math

import imageio.v3 as iio
import llvmlite.binding as binding
import numpy as np
import pytest
import torch
from pretend_mps import pretended_mps
from shared import refused

from gaussian_swaying.aero.carried import Turbulence
from gaussian_swaying.aero.effects import LogProfile, PowerProfile
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.obstacles import CylinderObstacle, EllipsoidObstacle, SphereObstacle
from gaussian_swaying.aero.recorded import FrozenWind, RecordedWind
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.wind import FlowKey, GaussianGust, SineSway, UniformGust, WindField
from gaussian_swaying.cli.simulate import main
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.kernels import cpu
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.block import BoxObstacle
from gaussian_swaying.mpm.boundaries.capsule import CapsuleObstacle
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
from gaussian_swaying.mpm.boundaries.handle import Handle
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.sequential_release import SequentialRelease
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.contact.surface import Contact
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
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.rendering.shading import DiffuseShader, PhongShader
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.edits import Edit
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.scene import Scene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.pictures import under_cursor
from gaussian_swaying.viewer.session import Snapshot
from gaussian_swaying.viewer.states import drawable, scene_message, state_message

ALL = [None] * 3
LEFT, RIGHT = Box(ALL, [0.11, None, None]), Box([1.0, None, None], ALL)


def _grid(*boundaries, **options):
    return MPMSolver(dx=0.2, boundaries=list(boundaries), **options)


def _simulation(scene=None, device="mps", **options):
    """A flag that is held at its left edge, unless told otherwise."""
    known = {"solver": _grid(PinnedRegion(LEFT)), "wind": [3, 0, 0], "camera": OrbitCamera(width=64, height=48)}
    return Simulation(scene or FlagScene(spacing=0.1), device=device, **(known | options))


def _gusts():
    return WindField([4, 0, 0], modulations=[SineSway(), UniformGust(), GaussianGust()])


def _effects():
    wake = CylinderObstacle([-1, 0, 0], 0.3), EllipsoidObstacle([-1, 0, 0], [0.3, 0.2, 0.1])
    some = Turbulence(cells=(16, 16, 16)), SphereObstacle([-1, 0, 0], 0.3), *wake, Shelter(cells=8)
    return WindField([4, 0, 0], effects=[LogProfile(height=1.0), *some])


def _flow(kind):
    law = {Foam: (1e3, 10.0), Metal: (1e3,), Plasticine: (1e3, 1e2)}.get(kind, ())
    solver = _grid(Plane([0, 0, -0.1], [0, 0, 1]), formulation="updated")
    return {"material": Material(law=kind(*law)), "solver": solver}


CASES = {
    "gusts": lambda: {"wind": _gusts()},
    "schedule": lambda: {
        "wind": WindField(schedule=[FlowKey(0, [1, 0, 0]), FlowKey(0.03, [2, 1, 0])], interpolation="linear"),
        "aero": AeroForce(law="projected", drag_step="semi_implicit"),
    },
    "effects": lambda: {"wind": _effects()},
    "pins": lambda: {
        "solver": _grid(
            PinnedRegion(LEFT, kind="clamp"),
            PinnedPoints([[1.1, 0, 0.3]]),
            Handle(RIGHT, velocity=[0.1, 0, 0], angular_velocity=[0, 0, 1.0]),
        )
    },
    "release": lambda: {
        "solver": _grid(SequentialRelease(LEFT), Impulse(Box(ALL, ALL), [0, 0.1, 0]), VelocityBox(RIGHT, [0, 0.1, 0]))
    },
    "nodes": lambda: {
        "solver": _grid(
            PinnedRegion(LEFT, kind="nodes"),
            Plane([0, 0, -0.1], [0, 0, 1]),
            EnclosingBox([-3] * 3, [3] * 3),
            damping=0.1,
            stiffness_damping=1e-4,
        )
    },
    "contact": lambda: {
        "contact": Contact(),
        "solver": _grid(
            BallObstacle([0.5, 0, -0.2], 0.25),
            BoxObstacle([0, -1, -1], [1, 1, -0.05]),
            CapsuleObstacle([0, 0, -0.1], [1, 0, -0.1], 0.05, path=KeyedPath([0.0, 1.0], [[0, 0, 0], [0, 0, 0.3]])),
            HalfSpaceObstacle([0, 0, -0.1], [0, 0, 1]),
        ),
    },
    "edit": lambda: {"edits": [Edit(LEFT, 0.04, E=2e5, color=[1, 0, 0])], "shader": PhongShader()},
    "layers": lambda: {"scene": Scene(generator=FlagScene(spacing=0.1), points="gaussian", layers=3)},
    **{
        kind.__name__: lambda kind=kind: {"material": Material(law=kind())}
        for kind in (NeoHookean, StVKHencky, SpringNetwork)
    },
    **{kind.__name__: lambda kind=kind: _flow(kind) for kind in (Sand, Snow, Fluid, Foam, Metal, Plasticine)},
}


@pytest.mark.slow(gate=["gusts", "pins", "Snow"])
@pytest.mark.parametrize("case", CASES)
def test_a_simulation_asks_only_for_what_the_device_has(case):
    """And moves as torch moves it on a CPU; an edit acts on the second frame."""
    frames = 3 if case == "edit" else 2
    with pretended_mps() as mode:
        *_, frame = _simulation(**CASES[case]()).frames(frames)
        assert (frame.state.position.device.type, frame.state.time.device.type) == ("mps", "cpu")
        found = frame.state.position.cpu()
    assert sum(mode.seen.values()) > 1000
    solver = CASES[case]().get("solver", _grid(PinnedRegion(LEFT)))
    solver.transfer = "torch"
    on_cpu = _simulation(device="cpu", **(CASES[case]() | {"solver": solver}))
    start, *_, frame = on_cpu.frames(frames)
    assert float((frame.state.position - start.state.position).norm(dim=-1).max()) > 1e-4
    torch.testing.assert_close(found, frame.state.position, rtol=0, atol=2e-5)


def test_a_wind_and_an_obstacle_from_files(tmp_path):
    """A recorded wind, which changes with time, a frozen one, a profile and a mesh."""
    axis = np.linspace(-2, 2, 4)
    draw = np.random.default_rng(0)
    grid = {"x": axis, "y": axis, "z": axis}
    np.savez(tmp_path / "still.npz", **grid, velocity=draw.normal(size=(4, 4, 4, 3)))
    np.savez(tmp_path / "wind.npz", **grid, time=np.arange(3.0), velocity=draw.normal(size=(3, 4, 4, 4, 3)))
    (tmp_path / "mesh.obj").write_text("v 0 -1 -1\nv 1 -1 -1\nv 0 1 -1\nv 0 -1 0\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    recorded, frozen = RecordedWind(tmp_path / "wind.npz"), FrozenWind(tmp_path / "still.npz")
    wind = WindField([3, 0, 0], effects=[PowerProfile(height=1.0), recorded, frozen])
    with pretended_mps() as mode:
        solver = _grid(PinnedRegion(LEFT), MeshObstacle(str(tmp_path / "mesh.obj"), cells=8))
        *_, frame = _simulation(wind=wind, solver=solver).frames(2)
        assert frame.state.position.device.type == "mps"
    assert sum(mode.seen.values()) > 1000


@pytest.mark.slow(twin="test_a_run_is_recorded_and_continued")
def test_everything_is_drawn_and_written(tmp_path):
    """All pictures and files, in a wind with all effects, from a splat with colours that depend on the view."""
    renders = ("color", "depth", "normal", "force", "wind")
    with pretended_mps():
        simulation = _simulation(wind=_effects(), shader=DiffuseShader())
        simulation.recorder = Recorder(renders=renders, ply_every=1, video=False)
        simulation.run(tmp_path, frames=2)
    assert {path.name for path in tmp_path.iterdir()} >= {
        "depth_raw",
        "ply",
        "trajectory.npz",
        "nodes.npz",
        *renders[1:],
    }


def test_a_run_is_recorded_and_continued(tmp_path):
    """With the picture of the same frame on a CPU."""
    recorder = Recorder(ply_every=1, video=False)
    with pretended_mps():
        _simulation(wind=_gusts(), recorder=recorder).run(tmp_path / "run", frames=2)
        _simulation(wind=_gusts(), recorder=recorder).run(tmp_path / "run", frames=3, resume=True)
        snapshot = _simulation(wind=_gusts())
        *_, frame = snapshot.frames(3)
        picture = frame.render().color.cpu()
    written = iio.imread(tmp_path / "run" / "frames" / "00002.png")
    assert np.abs(written / 255 - picture.clamp(0, 1).numpy()).max() < 0.01
    *_, frame = _simulation(wind=_gusts(), device="cpu").frames(3)
    torch.testing.assert_close(picture, frame.render().color, rtol=0, atol=1e-3)


def test_a_gradient_of_a_run_reaches_the_material():
    def slope(device):
        E = torch.tensor(3e3, requires_grad=True)
        solver = _grid(PinnedRegion(LEFT), substep=4e-3)
        simulation = _simulation(device=device, solver=solver, material=Material(E=E, density=30.0))
        state, _ = simulation.advance(simulation.start())
        (state.position - simulation.scene.points.position).square().sum().backward()
        return float(E.grad)

    with pretended_mps():
        found = slope("mps")
    assert math.isclose(found, slope("cpu"), rel_tol=1e-2)


def test_the_live_page_shows_it():
    """What the browser gets to draw, and the place under the cursor."""
    with pretended_mps():
        simulation = _simulation()
        *_, frame = simulation.frames(2)
        snapshot = Snapshot(simulation, frame.state, frame.health, 1)
        assert drawable(snapshot)
        assert len(scene_message(snapshot, torch.eye(3, dtype=torch.float64))) > 1000
        assert len(state_message(snapshot, False)) > 100
        place = simulation.scene.model.means[0].tolist()
        found = under_cursor(snapshot, [place[0], -3.0, place[2]], [0.0, 1.0, 0.0])
    assert math.dist(found, place) < 0.05


# ---- the choice


def test_a_machine_without_one_says_so(tmp_path, capsys):
    refused(
        main,
        ["--config", "flag", "--device", "mps", "--output", str(tmp_path / "run")],
        capsys,
        "a Mac",
        "--device auto or cpu",
    )
    with pytest.raises(ValueError, match="dtype: float64"), pretended_mps():
        _simulation(dtype="float64")


def test_a_mac_computes_on_its_cpu_unless_asked(tmp_path, monkeypatch):
    """Its kernels are there. With no CUDA, torch looks for streams on MPS, which has none."""
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: True)
    simulation = _simulation(device="auto", recorder=Recorder(images=False, video=False))
    assert simulation.device.type == "cpu"
    simulation.run(tmp_path / "run", frames=2)


# ---- kernels for its CPU


@pytest.mark.parametrize(
    ("triple", "processor", "head"),
    [
        ("arm64-apple-macosx", "apple-m1", bytes.fromhex("cffaedfe0c000001")),  # Mach-O, arm64
        ("aarch64-linux-gnu", "generic", b"\x7fELF\x02\x01"),
    ],
    ids=["mac", "linux"],
)
def test_the_kernels_of_a_run_compile_for_arm64(triple, processor, head, tmp_path, monkeypatch):
    """All that LLVM has to know of another processor is its name."""
    texts, plain = [], cpu._compiled
    monkeypatch.setattr(cpu, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(cpu, "_COMPILED", {})
    monkeypatch.setattr(cpu, "_compiled", lambda text: texts.append(text) or plain(text))
    list(_simulation(device="cpu").frames(2))
    assert len(texts) > 5
    assert not any("x86" in text or "target-" in text for text in texts)
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    machine = cpu._machine_for(triple, processor)
    for text in sorted([*texts, cpu._RUN], key=len)[:5]:
        assert plain(text, machine).startswith(head)
