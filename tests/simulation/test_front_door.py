"""Simulation as users meet it in Python and in a YAML: short forms, frames, what is given twice, custom forces."""

import copy
import dataclasses
import inspect
import subprocess
import sys
import threading
import warnings

import pytest
import torch
import yaml
from shared import advanced, peak, up_to, value_error
from small_films import base

from gaussian_swaying import (
    AeroForce,
    DiffuseShader,
    Edit,
    Frame,
    Material,
    MPMSolver,
    PinnedPoints,
    PinnedRegion,
    Recorder,
    Scene,
    Simulation,
    SineSway,
    WindField,
)
from gaussian_swaying.config.parser import CUSTOM, PYTHON_ONLY, arguments_of
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.pins import Impulse
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.draw import draw
from gaussian_swaying.simulation.model import Normalisation
from gaussian_swaying.simulation.step import start, step

POLE = up_to(x=0.11)
SMALL = {"hold": POLE, "material": Material(E=3e3, density=30.0), "wind": [6.0, 1.5, 0.0], "device": "cpu"}


def _flag(**changes):
    return Simulation(FlagScene(spacing=0.1), **(SMALL | changes))


# ---- Python


def test_a_frame_has_what_its_state_says():
    simulation = _flag()
    frames = list(simulation.frames(3))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.04, 0.08])
    last = frames[-1]
    assert isinstance(last, Frame)
    expected = simulation.scene.deformed(last.state)
    for name in ("means", "covariances", "normals"):
        assert torch.equal(getattr(last.gaussians, name), getattr(expected, name))
    camera = simulation.painter.camera_at(2)
    assert torch.equal(last.gaussians.colors, simulation.painter.colors(expected, camera))
    assert torch.equal(last.render().color, simulation.painter.render(last.state, 2).color)
    assert last.health.kinetic > 0


def test_a_model_is_advanced_and_drawn_by_functions():
    """As the simulation does it, whatever other model was advanced between two frames."""
    simulation = _flag()
    model = simulation.model
    other = model.at({"wind.speed": 9.0, "material.E": 9e3})
    state, mixed = start(model), start(other)
    expected, alone = simulation.start(), mixed
    for _ in range(3):
        state, mixed = step(model, state), step(other, mixed)
        expected, _ = simulation.advance(expected)
    for _ in range(3):
        alone = step(other, alone)
    assert torch.equal(state.position, expected.position)
    assert torch.equal(mixed.position, alone.position)
    assert peak(mixed.position - state.position) > 1e-3
    assert simulation.model.value("wind.speed") == model.value("wind.speed")
    camera = simulation.painter.camera_at(3)
    for shader in (None, DiffuseShader()):
        simulation.painter.shader = shader
        assert torch.equal(draw(model, state, camera, shader).color, simulation.painter.render(expected, 3).color)
    white = draw(model, state, camera, background=(1, 1, 1)).color
    assert white.amin(-1)[0, 0] == 1.0


def test_a_model_that_cannot_be_advanced_is_refused_each_time_and_others_go_on():
    solver = MPMSolver(0.2, gravity=(0, 0, 0), substep=2e-3, boundaries=[PinnedRegion(POLE)])
    model = _flag(solver=solver, hold=None).model
    simulation = _flag(solver=solver, hold=None)
    first = simulation.start()  # a state is that of any stepper
    stiff, expected = model.at("material.E", 3e7), step(model, first)
    assert torch.equal(expected.position, simulation.advance(first)[0].position)
    for _ in range(2):
        with value_error("substep"):
            step(stiff, first)
    assert torch.equal(step(model, first).position, expected.position)


# ---- nothing is said twice


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"up": [0, 0, 1], "scene": Scene(generator=FlagScene(spacing=0.1))}, "`up`"),
        ({"hold": POLE, "solver": MPMSolver(0.2)}, "`hold`"),
        ({"hold": POLE, "normalisation": Normalisation()}, "`hold`"),
        ({"wind": [1.0, 2.0]}, "`wind`"),
        ({"wind": "north"}, "`wind`"),
        ({"up": [0, 1]}, "`up`"),
        ({"background": [0, 0, 255]}, "`background` within"),
        ({"device": "cuda:7"}, "cuda"),
        ({"frame_dt": 0.0}, "`frame_dt`"),
        ({"frame_dt": float("nan")}, "`frame_dt`"),
        *(
            ({name: value}, f"Expected `{name}`")
            for name, value in {
                "scene": 5, "material": {}, "solver": MPMSolver, "aero": {}, "camera": "orbit", "recorder": "x",
                "hold": [0, 1], "edits": Edit(E=1e4), "forces": [3], "dtype": "float16",
            }.items()
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_or_said_twice_is_refused(given, words):
    if "device" in given and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises((ValueError, TypeError), match=words):
        Simulation(**({"scene": FlagScene(spacing=0.1), "device": "cpu"} | given))


def test_the_grid_is_that_of_the_solver_everywhere():
    scene = Scene(generator=FlagScene(spacing=0.05), points="grid")
    counts = []
    for dx in (0.1, 0.2):
        solver = MPMSolver(dx, boundaries=[PinnedRegion(POLE)])
        simulation = Simulation(scene, Material(volume="cell"), solver=solver, device="cpu")
        counts.append(simulation.scene.points.count)
        cell = torch.unique(torch.floor(simulation.scene.points.position / dx).long(), dim=0)
        assert float(simulation.scene.points.volume.sum()) == pytest.approx(len(cell) * dx**3, rel=1e-5)
    assert counts[0] > counts[1]


# ---- the YAML


def test_the_constructor_is_the_schema():
    parser = Simulation.parser()
    options = {name.split(".")[0] for name in parser.get_defaults().keys(branches=True)}
    names = set(arguments_of(Simulation))
    assert options - names == {"config", "output", "frames", "resume", "certify", "slow", "loop", *CUSTOM}
    assert names - options == set()
    assert set(inspect.signature(Simulation).parameters) - names == set(PYTHON_ONLY)


def test_a_file_and_what_takes_the_place_of_it(tmp_path):
    config = tmp_path / "scene.yaml"
    config.write_text(yaml.safe_dump(base()))
    plain, changed = (Simulation.from_yaml(config, device="cpu", **more) for more in ({}, {"wind": [0, 9, 0]}))
    assert plain.wind.flows.tolist() == [[4.0, 3.0, 0.0]]
    assert changed.wind.flows.tolist() == [[0.0, 9.0, 0.0]]
    assert changed.config.endswith("changed_in_python:\n  wind:\n  - 0\n  - 9\n  - 0\n")
    _record(changed, tmp_path / "run", 2)
    assert (tmp_path / "run/config.yaml").read_text() == changed.config
    with value_error(r"The configuration differs .*changed_in_python"):
        _record(plain, tmp_path / "run", 3, resume=True)
    with pytest.raises(TypeError, match="windd"):
        Simulation.from_yaml(config, windd=[0, 9, 0])


# ---- what may not go wrong silently


QUIET = Recorder(renders=())


def _record(simulation, folder, frames, resume=False):
    return simulation.run(folder, frames, resume=resume, progress=False, recorder=copy.copy(QUIET))


def test_a_run_made_in_python_is_continued_with_the_same_arguments_only(tmp_path):
    _record(_flag(), tmp_path / "run", 2)
    for change in (
        {"wind": [0.0, 9.0, 0.0]},
        {"wind": WindField([6.0, 1.5, 0.0], modulations=[SineSway()])},
        {"material": Material(E=9e4, density=30.0)},
        {"hold": up_to(x=0.21)},
        {"aero": AeroForce(C_D=0.1)},
        {"edits": [Edit(time=1.0, E=1e4)]},
        {"frame_dt": 0.02},
    ):
        with value_error(r"configuration differs .*made_in_python"):
            _record(_flag(**change), tmp_path / "run", 3, resume=True)
    assert _record(_flag(), tmp_path / "run", 3, resume=True)["frames"] == 3


def test_equal_arguments_are_described_alike_in_another_process(capsys):
    code = (
        "from gaussian_swaying import Box, MPMSolver, OrbitCamera, PinnedRegion, Recorder, Simulation, WindField\n"
        "from gaussian_swaying.scenes import FlagScene\n"
        "s = Simulation(FlagScene(spacing=0.1), camera=OrbitCamera(width=8, height=8), solver=MPMSolver(dx=0.2,"
        " boundaries=[PinnedRegion(Box([None, None, None], [0.11, None, None]))]), wind=WindField([1, 0, 0]),"
        " device='cpu', recorder=Recorder(video=False))\nprint(s.config)"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert other.returncode == 0, other.stderr
    exec(compile(code, "the same here", "exec"), {})
    assert capsys.readouterr().out == other.stdout
    assert "recorder" not in other.stdout
    assert " at 0x" not in other.stdout
    assert "OrbitCamera" in other.stdout


def test_a_frame_is_read_before_an_edit_changes_its_colours():
    simulation = _flag(edits=[Edit(time=0.08, color=[1.0, 0.0, 0.0])])
    frames = list(simulation.frames(4))
    assert frames[-1].gaussians.colors[:, 1].max() < 1e-6
    with pytest.raises(RuntimeError, match="since frame 0: read `gaussians`"):
        _ = frames[0].gaussians


def _in_four_threads(work):
    begin, found, before = threading.Barrier(4), [None] * 4, sys.getswitchinterval()

    def one(k):
        begin.wait()
        try:
            found[k] = work(k)
        except Exception as error:
            found[k] = error

    threads = [threading.Thread(target=one, args=(k,)) for k in range(4)]
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    return found


def test_four_threads_that_step_a_new_simulation_take_turns():
    """Each has a state of its own; all end where one thread alone does, to the bit."""

    def march(simulation):
        state, _ = advanced(simulation, 2)
        return state.position, simulation.painter.render(state, 2).color

    expected = march(_flag())
    for _ in range(3):
        simulation = _flag()
        for position, picture in _in_four_threads(lambda _, simulation=simulation: march(simulation)):
            assert torch.equal(position, expected[0])
            assert torch.equal(picture, expected[1])


def test_of_four_threads_that_loop_over_frames_one_goes_on():
    """The others are told so: a loop that was started later ended theirs."""
    simulation, started = _flag(), threading.Barrier(4)

    def last_picture(_):
        frames = simulation.frames(3)
        started.wait(60)
        return [frame.render().color for frame in frames][-1]

    found = _in_four_threads(last_picture)
    refused = [error for error in found if isinstance(error, RuntimeError)]
    assert len(refused) == 3
    assert all("was started again" in str(error) for error in refused)
    (picture,) = (one for one in found if isinstance(one, torch.Tensor))
    *_, last = _flag().frames(3)
    assert torch.equal(picture, last.render().color)


def test_four_threads_that_run_a_simulation_take_turns(tmp_path):
    simulation = _flag(recorder=copy.copy(QUIET))
    found = _in_four_threads(lambda k: simulation.run(tmp_path / str(k), 2, progress=False))
    assert [summary["status"] for summary in found] == ["complete"] * 4
    assert len({(tmp_path / f"{k}/diagnostics.csv").read_bytes() for k in range(4)}) == 1


def test_a_coefficient_changed_in_place_is_felt():
    simulation = _flag(aero=AeroForce(C_D=0.0, C_F=0.0, C_L=0.0))
    state = simulation.start()
    assert simulation.forces == []
    simulation.aero.C_D.fill_(1.2)
    state, _ = simulation.advance(state)
    assert peak(state.position - simulation.scene.points.position) > 1e-3


@pytest.mark.parametrize(
    ("hold", "kind"),
    [
        (POLE, "hinge"),
        (PinnedRegion(POLE, kind="clamp"), "face"),
        (PinnedRegion(POLE, kind="nodes"), "nodes"),
        (PinnedPoints([[0.05, 0.0, 0.75], [0.05, 0.0, 0.05]]), "hinge"),
    ],
)
def test_what_is_held_has_a_kind(hold, kind):
    simulation = _flag(hold=hold)
    simulation.start()
    assert list(simulation.solver.bound.kinds) == [kind]
    assert tuple(simulation.solver.gravity) == (0.0, 0.0, 0.0)
    assert ("clamp" in simulation.config) == (kind == "face")  # a run is resumed with the same pins


FALLS = "Nothing holds the object"


@pytest.mark.parametrize(
    ("given", "down", "told"),
    [
        ({"hold": POLE}, 0.0, 0),
        ({"held": True}, 0.0, 0),  # by a part
        ({}, -9.8, 1),
        ({"solver": MPMSolver(0.2, boundaries=[Impulse(POLE, [0.0, 0.0, 1.0])])}, -9.8, 1),
        ({"solver": MPMSolver(0.2, gravity=[0.0, 0.0, 0.0])}, 0.0, 0),
        ({"solver": MPMSolver(0.2, boundaries=[Obstacle(HalfSpace([0.0] * 3, [0.0, 0.0, 1.0]))])}, -9.8, 0),
    ],
)
def test_gravity_of_what_is_held_and_of_what_falls(given, down, told):
    flag = FlagScene(spacing=0.1)
    given = dict(given)
    held = given.pop("held", False)
    labels = (flag.generate().means[:, 0] < 0.11).long()
    parts = Parts(labels, [Part("cloth"), Part("pole", "held")]) if held else None
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        simulation = Simulation(Scene(generator=flag, parts=parts), device="cpu", **given)
        simulation.start()
    assert tuple(simulation.solver.gravity) == (0.0, 0.0, down)
    assert sum(FALLS in str(one.message) for one in found) == told


def test_a_copy_goes_its_own_way(tmp_path):
    simulation = _flag(recorder=copy.copy(QUIET))
    simulation.run(tmp_path / "run", 2, progress=False)
    other = copy.deepcopy(simulation)
    other.wind = [0.0, 9.0, 0.0]
    other.aero.C_D.mul_(2.0)
    *_, blown = other.frames(3)
    *_, last = simulation.frames(3)
    *_, expected = _flag().frames(3)
    assert torch.equal(last.state.position, expected.state.position)
    assert peak(blown.state.position - expected.state.position) > 1e-3
    other.run(tmp_path / "other", 2, progress=False)
    assert other.recorder.folder == tmp_path / "other"
    assert simulation.recorder.folder == tmp_path / "run"
    assert (tmp_path / "other/trajectory.npz").exists()


def test_the_length_of_a_frame_can_be_assigned():
    """Two frames of half the length end where one does, to the order of the substep."""
    simulation = _flag()
    (_, frame) = simulation.frames(2)
    end = frame.state.position
    frames = simulation.frames(3)
    next(frames)
    simulation.frame_dt = 0.5 * simulation.frame_dt
    *_, last = frames
    assert last.time == pytest.approx(frame.time)
    rest = simulation.scene.points.position
    assert (last.state.position - end).norm() < 0.05 * (end - rest).norm()
    with value_error("`frame_dt`"):
        simulation.frame_dt = 0.0


def test_wind_is_assigned_as_it_is_given():
    simulation = _flag()
    simulation.wind = [8, 0, 0]
    assert simulation.wind.flows.tolist() == [[8.0, 0.0, 0.0]]
    simulation.wind = None
    assert simulation.wind.flows.tolist() == [[0.0, 0.0, 0.0]]
    for wrong in ([1, 2], "north"):
        with pytest.raises((ValueError, TypeError), match="`wind`"):
            simulation.wind = wrong


def test_an_edit_that_is_refused_changes_nothing():
    simulation = _flag()
    state = simulation.start()
    with value_error(r"`solver\.formulation`"):
        simulation.edit(state, Edit(E=9e4, color=[1.0, 0.0, 0.0]), Edit(law=Sand()))
    assert float(simulation.scene.points.youngs_modulus.max()) == 3e3
    one, _ = simulation.advance(simulation.edit(state, Edit(E=1e4)))
    other = _flag()
    two, _ = other.advance(other.edit(other.start(), Edit(E=1e4)))
    assert torch.equal(one.position, two.position)


def test_what_a_simulation_does_not_take_while_it_runs():
    simulation = _flag()
    for count in (0, -1, 2.5, True, 10**30):
        with value_error("`count`"):
            simulation.frames(count)
    for name in ("camera", "material", "solver", "scene", "forces", "hold", "device"):
        with pytest.raises(AttributeError, match=name):
            setattr(simulation, name, None)
    (frame,) = simulation.frames(1)
    with value_error("no camera 'side'"):
        frame.render("side")


def test_a_normalisation_leaves_the_components_as_they_are():
    scene, material = Scene(generator=FlagScene(spacing=0.1)), Material(E=3e3)
    solver = MPMSolver(0.1, boundaries=[PinnedRegion(up_to(x=0.6))])
    given = vars(scene).copy(), dataclasses.asdict(material), list(solver.boundaries)
    for _ in range(2):
        Simulation(scene, material, solver=solver, normalisation=Normalisation(scale=1.0), device="cpu").start()
        assert (vars(scene), dataclasses.asdict(material), list(solver.boundaries)) == given


def test_an_error_of_a_custom_force_stays_what_it_is():
    def broken(state):
        raise ValueError("no such table")

    simulation = _flag(forces=[broken])
    with value_error("no such table") as caught:
        list(simulation.frames(2))
    assert caught.type is ValueError


class Counted(FlagScene):
    count = 0

    def generate(self):
        Counted.count += 1
        return super().generate()


@pytest.mark.parametrize("more", [{}, {"normalisation": Normalisation()}])
def test_a_splat_is_read_once(more, monkeypatch):
    monkeypatch.setattr(Counted, "count", 0)
    Simulation(Scene(generator=Counted(spacing=0.1)), device="cpu", **more)
    assert Counted.count == 1


def test_what_a_run_was_made_from_is_described_once(tmp_path, monkeypatch):
    described = []
    monkeypatch.setattr(
        "gaussian_swaying.simulation.simulation.python_text", lambda *a: described.append(a) or "a: 1\n"
    )
    _record(_flag(), tmp_path / "run", 4)
    assert len(described) == 1
