"""One object, many copies: each as a simulation of its own in its own wind, drawn from one splat."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from shared import beyond, double, in_both, near, peak, seeded, turned_by, up_to, value_error
from small_scenes import together

from gaussian_swaying.cli.live import session_of
from gaussian_swaying.gaussians.harmonics import rotate_sh, sh_to_color
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.inverse.variants import check_variants
from gaussian_swaying.mpm.contact import Contact
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.model import Copy, Edit
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import GaussianGust, UniformGust, WindField
from gaussian_swaying.wind.tables import Shelter

POLE = up_to(x=0.11)
AXIS = FlagScene(spacing=0.1).generate().means[0]  # the middle of the particles that POLE holds; only x and y count
ROW = [Copy(), Copy([0.0, 1.5, 0.0], 90.0), Copy([0.5, 3.0, 0.2], 200.0, delay=0.1)]


class Push(Force):
    """A force of one's own."""

    def forward(self, state):
        return torch.ones_like(state.position), None


def _coloured(degree=1):
    """A flag of 96 Gaussians whose colours depend on the direction, and ten Gaussians far below that do not move."""
    flag, draw = FlagScene(spacing=0.1).generate(), seeded(0)
    still = flag.select(torch.arange(96) < 10)
    both = together(flag, replace(still, means=still.means - torch.tensor([0.0, 0.0, 5.0])))
    more = 0.3 * (torch.rand(106, (degree + 1) ** 2 - 1, 3, generator=draw) - 0.5)
    return replace(both, sh=torch.cat([both.sh, more], dim=1))


def _along(*borders):
    return torch.bucketize(_coloured().means[:, 0].contiguous(), torch.tensor(borders))


def _simulation(copies=(), wind=None, cloud=None, solver=None, scene=None, **more):
    solver = {"dx": 0.2, "boundaries": [PinnedRegion(POLE)], "gravity": (0.0, 0.0, 0.0)} | (solver or {})
    scene = {"region": beyond(z=-2.0), "points": "gaussian"} | (scene or {})
    settings = {"camera": OrbitCamera(width=48, height=27, azimuth=-70.0, radius=1.9), "device": "cpu"}
    return Simulation(
        Scene(generator=GivenScene(_coloured() if cloud is None else cloud), **scene),
        Material(E=3e3, density=30.0),
        solver=MPMSolver(**solver),
        wind=WindField([6.0, 1.5, 0.0]) if wind is None else wind,
        copies=list(copies),
        **(settings | more),
    )


def _end(simulation, frames=4):
    return list(simulation.frames(frames))[-1]


def _gusty(seed=5):
    return WindField([6.0, 1.5, 0.0], modulations=[UniformGust(0.5), GaussianGust(1.0)], seed=seed)


# ---- motion


@pytest.mark.parametrize("points", ["gaussian", "grid"])
@in_both
def test_a_copy_alone_is_the_object_to_the_bit(formulation, points):
    if points == "grid" and formulation == "updated":
        points = None
    more = {"solver": {"formulation": formulation}, "scene": {"points": points}, "wind": _gusty()}
    one, copy = (_end(_simulation(copies, **more)) for copies in ([], [Copy()]))
    assert torch.equal(copy.state.position[0], one.state.position)
    assert torch.equal(copy.render().color, one.render().color)
    assert peak(one.state.position - _simulation(**more).start().position) > 0.01


def test_all_take_the_substeps_of_the_fastest():
    """With the substep of a run of its own a copy is that run; otherwise they differ by the error of the time step."""
    copies, wind = [Copy(), Copy([0.0, 2.0, 0.0], 90.0)], WindField([6.0, 0.0, 0.0])
    fixed = {"solver": {"substep": 0.002}, "dtype": "float64"}
    both = _end(_simulation(copies, wind, **fixed)).state.position
    for own, flow in zip(both, ([6.0, 0.0, 0.0], [0.0, -6.0, 0.0]), strict=True):
        alone = _end(_simulation([], WindField(flow), **fixed)).state.position
        near(own, alone, 1e-9)
    assert peak(both[0] - both[1]) > 0.01
    free = _end(_simulation(copies, wind)).state.position
    near(free.double(), both, 0.01)


@pytest.mark.parametrize("degrees", [37.0, 90.0, -120.0])
def test_a_turned_copy_in_a_turned_wind_moves_alike(degrees):
    flow = double([6.0, 1.5, 0.4])
    one, other = (
        _end(
            _simulation(
                [Copy([0.3, 0.2, 0.1], angle)],
                WindField(turned_by(angle) @ flow, modulations=[UniformGust(0.5)]),
                dtype="float64",
            )
        )
        for angle in (0.0, degrees)
    )
    near(other.state.position, one.state.position, 1e-9)
    A, shift = turned_by(degrees).float(), torch.tensor([0.3, 0.2, 0.1])
    a, b = one.gaussians, other.gaussians
    torch.testing.assert_close(b.means[:10], a.means[:10])  # what does not move
    moved = (a.means[10:] - AXIS - shift) @ A.T + AXIS + shift
    near(b.means[10:], moved, 1e-5)
    near(b.covariances[10:], A @ a.covariances[10:] @ A.T, 1e-6)
    near(b.normals[10:], a.normals[10:] @ A.T, 1e-5)


def test_each_has_gusts_of_its_own():
    copies = [Copy(), Copy(), Copy(seed=40), Copy(delay=0.5), Copy(delay=0.5, seed=7)]
    simulation = _simulation(copies, _gusty(5))
    assert simulation.stepper.wind_force.wind.seed.tolist() == [5, 6, 40, 5, 7]
    state = _end(simulation).state
    assert peak(state.position[0] - state.position[1]) > 0.001


def test_numbers_change_and_edits_act_on_all():
    simulation = _simulation(ROW, edits=[Edit(time=0.04, E=3e5, color=[1.0, 0.0, 0.0])])
    frames = simulation.frames(4)
    first = next(frames)
    drawn = first.gaussians.colors
    second = next(frames)
    assert [model.points.youngs_modulus[0] for model in simulation.stepper.models] == [3e5] * 3
    red = second.gaussians.colors
    assert torch.equal(first.gaussians.means[:106], _coloured().means.roll(10, 0))
    torch.testing.assert_close(red[10:], torch.tensor([1.0, 0.0, 0.0]).expand(3 * 96, 3))
    torch.testing.assert_close(red[:10], drawn[:10])
    simulation.wind = [0.0, 0.0, 0.0]
    assert all(float(peak(model.wind(torch.zeros(1)))) == 0 for model in simulation.stepper.models)
    other = _simulation(ROW)
    assert other.start().position.shape == (3, 96, 3)
    other.change("wind.speed", 1.0)
    assert float(other.stepper.models[1].wind(torch.zeros(1)).norm()) == pytest.approx(1.0)


# ---- places


@pytest.mark.parametrize(
    ("hold", "axis"),
    [
        (PinnedRegion(POLE, "nodes"), AXIS),
        (PinnedPoints([[1.1, 0.0, 0.2], [1.1, 0.0, 0.6]]), torch.tensor([1.1, 0.0, 0.0])),
        (None, torch.tensor([0.6, 0.0, 0.0])),
    ],
    ids=["region", "points", "free"],
)
def test_the_axis_of_a_turn(hold, axis):
    simulation = _simulation([Copy(), Copy(turn=180.0)], solver={"boundaries": [hold] if hold else []})
    means = next(simulation.frames(1)).gaussians.means[10:].reshape(2, 96, 3)
    near((means[0] + means[1])[:, :2], (2 * axis[:2]).expand(96, 2), 0.02)
    torch.testing.assert_close(means[0, :, 2], means[1, :, 2])


def test_metres_and_the_up_direction_of_the_scene():
    cloud = _coloured()
    cloud = replace(cloud, means=cloud.means[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0]))
    scene = {"up": [0.0, -1.0, 0.0], "metres_per_unit": 0.5, "region": up_to(y=2.0)}
    solver = {"dx": 0.1, "boundaries": []}
    simulation = _simulation([Copy([1.0, 2.0, 0.5]), Copy(turn=65.0)], cloud=cloud, scene=scene, solver=solver)
    frame, means = simulation.scene.frame, next(simulation.frames(1)).gaussians.means[10:].reshape(2, 96, 3)
    rest = simulation.scene.model.means[simulation.scene.moving]
    moved = frame.point_to_sim(means[0].double()) - frame.point_to_sim(rest.double())
    near(moved, torch.tensor([1.0, 2.0, 0.5]).double().expand(96, 3), 1e-5)
    near(means[1, :, 1], rest[:, 1], 1e-6)
    assert peak(means[1] - rest) > 0.4


# ---- pictures


@in_both
def test_a_rigid_part_is_a_body_of_each_copy(formulation):
    parts = Parts(_along(0.25, 0.75), [Part("pole", "held"), Part("cloth"), Part("board", "rigid", density=60.0)])
    more = {
        "scene": {"parts": parts},
        "solver": {"boundaries": [], "formulation": formulation, "substep": 0.002},
        "dtype": "float64",
    }
    one = _end(_simulation([], **more)).state.position
    copies = _end(_simulation([Copy(), Copy([0.0, 2.0, 0.0], 60.0)], **more)).state.position
    near(copies[0], one, 1e-9)
    rest = _simulation([], **more).start().position
    board = rest[:, 0] > torch.quantile(rest[:, 0], 0.7)
    for own in copies:
        near(torch.pdist(own[board]), torch.pdist(rest[board]), 1e-9)
    assert peak(copies[0] - copies[1]) > 0.01


def test_a_held_part_belongs_to_the_copy_and_a_still_one_does_not():
    labels = _along(0.25)
    labels[96:] = 2
    parts = Parts(labels, [Part("pole", "held"), Part("cloth"), Part("floor", "still")])
    more = {"scene": {"parts": parts, "region": None}, "solver": {"boundaries": []}}
    row = _simulation([Copy(), Copy([0.0, 2.0, 0.0], 180.0)], **more)
    one, copies = _end(_simulation([], **more)), _end(row)
    held, rest = labels == 0, _coloured().means
    means, colours = (getattr(copies.gaussians, name)[10:].reshape(2, 96, 3) for name in ("means", "colors"))
    assert torch.equal(copies.gaussians.means[:10], rest[96:])
    order = torch.cat([(labels == 1).nonzero()[:, 0], held.nonzero()[:, 0]])
    assert torch.equal(means[0, -int(held.sum()) :], rest[held])
    near(means[0], one.gaussians.means[order], 1e-3)
    assert peak(means[0, :72].sub(rest[labels == 1])) > 0.01
    middle = 0.5 * (rest[held].amin(0) + rest[held].amax(0))
    turned = (rest[held] - middle) * torch.tensor([-1.0, -1.0, 1.0]) + middle + torch.tensor([0.0, 2.0, 0.0])
    near(means[1, -int(held.sum()) :], turned, 1e-5)
    view = turned - row.painter.camera_at(0).position
    seen = sh_to_color(rotate_sh(_coloured().sh[held], turned_by(180.0).float()), view)
    near(colours[1, -int(held.sum()) :], seen, 2e-5)


@pytest.mark.parametrize("shader", [None, DiffuseShader([0.3, -0.5, 0.8], two_sided=True, ambient=0.4, relative=True)])
def test_harmonics_turn_with_the_copy(shader):
    simulation = _simulation([Copy(turn=90.0)], shader=shader)
    frame = next(simulation.frames(1))
    gaussians, painter, scene = frame.gaussians, simulation.painter, simulation.scene
    view = gaussians.means - painter.camera_at(0).position
    colours = sh_to_color(rotate_sh(scene.model.sh[:96], turned_by(90.0).float()), view[10:])
    if shader is not None:
        normals = scene.model.normals()[:96]
        colours = shader(colours, normals @ turned_by(90.0).float().T, rest_normal=normals)
    near(gaussians.colors[10:], colours, 2e-5)
    torch.testing.assert_close(gaussians.colors[:10], sh_to_color(scene.model.sh[96:], view[:10]))


def test_the_camera_sees_all_of_them():
    """Its target and distance are those of the row; between two copies it may stand, within one it may not."""
    alone, row = _simulation([]), _simulation([Copy(), Copy([0.0, 4.0, 0.0])])
    torch.testing.assert_close(row.painter.center - alone.painter.center, torch.tensor([0.0, 2.0, 0.0]).double())
    assert row.painter.size == pytest.approx(4.0, abs=0.2)
    assert alone.painter.size == _simulation([Copy()]).painter.size
    row.painter.camera = LookAtCamera(eye=[0.5, 2.0, 0.4], target=[0.5, 4.0, 0.4], width=16, height=9)
    row.painter.check_camera(0)
    row.painter.camera = LookAtCamera(eye=[0.5, 4.0, 0.4], target=[0.5, 2.0, 0.4], width=16, height=9)
    with value_error("lies inside the object"):
        row.painter.check_camera(0)


# ---- runs


def test_a_run(tmp_path):
    recorder = Recorder(trajectory=False, nodes=False, renders=("color", "depth", "normal"))
    whole = _simulation(ROW, _gusty()).run(tmp_path / "whole", 4, progress=False, recorder=recorder)
    assert (whole["copies"], whole["particles"], whole["gaussians"]) == (3, 96, 106)
    for name in ("frames/00003.png", "depth/00003.png", "normal/00003.png", "video.mp4"):
        assert (tmp_path / "whole" / name).exists()
    assert _simulation([]).run(tmp_path / "one", 1, progress=False)["copies"] == 1


def test_from_a_configuration():
    parser = Simulation.parser()
    copies = [{"shift": [1, 0, 0], "turn": 90}, {"delay": 0.5}, {"turn": 0}]
    flag = {"class_path": "gaussian_swaying.scenes.procedural.FlagScene", "init_args": {"spacing": 0.1}}
    text = yaml.safe_dump({"scene": {"generator": flag}, "solver": {"dx": 0.2}, "device": "cpu", "copies": copies})
    settings = parser.parse_string(text)
    simulation = Simulation.from_settings(parser, settings)
    assert simulation.stepper.copies.copies == (Copy([1.0, 0.0, 0.0], 90.0), Copy(delay=0.5), Copy())
    stored = yaml.safe_load(simulation.config)
    assert stored["copies"][0]["turn"] == 90
    with value_error("live page shows one object: leave out `copies`"):
        session_of(parser, settings, real_time=False)


def test_the_example_of_the_page(capsys):
    page = (Path(__file__).parents[2] / "docs" / "many.md").read_text()
    example, output = re.search(
        r"```python\n(from gaussian_swaying import Box, Copy.*?)```\n\n```text\n(.*?)```", page, re.S
    ).groups()
    exec(compile(example, "docs/many.md", "exec"), {})
    assert capsys.readouterr().out == output


@pytest.mark.gpu
def test_on_a_gpu():
    frames = []
    for device in ("cpu", "cuda"):
        frames.append(_end(_simulation(ROW, _gusty(), device=device), 6))
    one, two = (frame.state.position.cpu() for frame in frames)
    near(two, one, 1e-4)
    one, two = (frame.render().color.cpu() for frame in frames)
    near(two, one, 0.03)


# ---- what is refused


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"contact": Contact()}, "touches itself or an obstacle; set `contact` to null"),
        ({"forces": [Push()]}, "`copies` cannot have `forces` yet"),
        ({"wind": WindField([1.0, 0.0, 0.0], effects=[Shelter()])}, "a Shelter.*`wind.effects`"),
        ({"solver": {"gravity": (1.0, 0.0, -9.8)}}, "`solver.gravity` along z"),
    ],
    ids=["contact", "forces", "shelter", "gravity"],
)
def test_what_copies_cannot_have(changes, words):
    with value_error(words):
        _simulation(ROW, **changes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"nodes": False}, "`copies` are recorded as pictures only: leave out `recorder.trajectory`\\."),
        ({"trajectory": False, "renders": ("color", "force")}, "`recorder.nodes`, force in `recorder.renders`\\."),
    ],
)
def test_what_is_not_recorded(options, words, tmp_path):
    with value_error(words):
        _simulation(ROW).run(tmp_path / "out", 1, progress=False, recorder=Recorder(**options))
    assert not (tmp_path / "out").exists()


def test_other_places_where_copies_are_refused(tmp_path):
    simulation = _simulation(ROW)
    with value_error("`copies` cannot be written as a splat yet"):
        next(simulation.frames(1)).save(tmp_path / "a.ply")
    with value_error("they have `copies`, which are one already"):
        simulation.batch([simulation.model])
    with value_error("it has `copies`, and a video shows one object; remove them"):
        check_variants(simulation, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "values", [{"shift": [1.0, 2.0]}, {"turn": float("nan")}, {"delay": float("inf")}, {"seed": -1}, {"seed": 1.5}]
)
def test_bad_values_are_named(values):
    with pytest.raises((ValueError, TypeError), match=rf"`(copies\.)?{next(iter(values))}`"):
        Copy(**values)
