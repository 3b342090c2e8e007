import json
import math
import sys

import pytest
import torch
import yaml
from shared import beyond, double, up_to, value_error
from small_films import base

from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.player.session import Session, changed_settings
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.model import Copy, Edit, in_settings, names, number, of_settings
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.plan import parse_run, read_sweep
from gaussian_swaying.sweeps.run import grouped
from gaussian_swaying.wind.force import AeroForce

CONFIG = base(frames=3)
CONFIG["solver"]["damping"] = 0.5
CONFIG["wind"]["modulations"] = [{"class_path": name} for name in ("SineSway", "UniformGust", "GaussianGust")]
OTHERS = {"wind.flow": [1.0, 2.0, 0.5], "wind.seed": 7, "solver.gravity": [0.0, 0.0, -1.0], "material.nu": 0.1}
PLACES = {"amplitude": 0, "period": 0, "phase": 0, "delta": 1, "std": 2, "interval": 1}
NAMES = [name.replace("*", str(PLACES.get(name.split(".")[-1], 0))) for name in names()]


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "base.yaml"
    path.write_text(yaml.safe_dump(CONFIG))
    return path


@pytest.fixture
def breath(tmp_path, monkeypatch):
    """A configuration with a force from a module of the user's, whose class names its number."""
    code = (
        "import torch\n"
        "from gaussian_swaying import Force, Live\n\n"
        "class Breath(Force):\n"
        '    live = {"strength": Live(unit="N", low=0.0, high=9.0)}\n\n'
        "    def __init__(self, strength: float = 0.1) -> None:\n"
        "        super().__init__()\n"
        "        self.strength = strength\n\n"
        "    def forward(self, state):\n"
        "        return self.strength * state.position.new_tensor([0.0, 0.0, 1e-3]).expand_as(state.position)\n"
    )
    (tmp_path / "users_breath.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "breath.yaml"
    path.write_text(yaml.safe_dump(CONFIG | {"forces": [{"class_path": "users_breath.Breath"}]}))
    yield path
    sys.modules.pop("users_breath", None)


def _close(found, wanted):
    assert torch.allclose(torch.as_tensor(found).double(), torch.as_tensor(wanted).double(), rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_is_read_and_is_that_of_the_configuration(name, config, parser):
    simulation = Simulation.from_yaml(config, device="cpu")
    before = simulation.model
    old = before.value(name)
    value = OTHERS.get(name, 0.5 * old + 0.01 if not isinstance(old, list) else None)
    changed = before.at({name: value})
    _close(changed.value(name), value)
    _close(before.value(name), old)  # as it was
    simulation.advance(simulation.start())
    simulation.change(name, value)
    _close(simulation.model.value(name), value)
    settings = parser.parse_args(["--config", str(config), "--device=cpu"])
    _close(of_settings(settings, name), old)
    in_settings(settings, {name: value})
    _close(of_settings(settings, name), value)
    made = Simulation.from_settings(parser, settings)
    _close(made.model.value(name), value)
    for simulated in (simulation, made):  # also from rest, they are the same
        assert simulated.start().position.isfinite().all()
    ends = [simulated.advance(simulated.start())[0].position for simulated in (simulation, made)]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("material.E", 0.0, "from 0.001 to"),
        ("material.nu", 0.5, "from -0.999 to 0.499"),
        ("wind.speed", -1.0, "from 0 to 10000"),
        ("aero.C_L", math.nan, "from -10000 to 10000"),
        ("wind.flow", [1.0, 2.0], "wind.flow"),
        ("material.stiffness", 1.0, "no number"),
        ("wind.modulations.7.period", 1.0, "add the modulation"),
        ("forces.Nothing.strength", 1.0, "no number"),
        ("wind.seed", 1.5, "wind.seed"),
        ("material.E", "soft", "material.E"),
        ("material.E", True, "material.E"),
    ],
)
def test_what_is_out_of_range_or_not_there_is_refused_and_nothing_changes(name, value, words, config):
    simulation = Simulation.from_yaml(config, device="cpu")
    simulation.start()
    before = simulation.model
    with pytest.raises((ValueError, TypeError), match=words):
        simulation.change({"material.density": 30.0, name: value})
    after = simulation.model
    assert all(getattr(after, part) is getattr(before, part) for part in ("points", "wind", "aero", "solver"))


@pytest.mark.parametrize("name", ["material.E", "material.nu"])
def test_what_says_where_the_layers_lie_is_not_changed(name):
    scene = Scene(generator=FlagScene(0.4, 0.3, 0.05), metres_per_unit=1.0, layers=3)
    model = Simulation(scene, Material(E=1e4, bending=1e-4), solver=MPMSolver(0.1), device="cpu").model
    with value_error(f"`{name}` is to change, but with `material.bending`"):
        model.at({name: 0.2})


def test_a_plate_of_one_layer_stiffens_with_what_changes():
    """By Kirchhoff's D = E h^3 / (12 (1 - nu^2)); a stiffness that was given as a number stays."""
    scene = Scene(generator=FlagScene(0.4, 0.3, 0.05), metres_per_unit=1.0)
    changes = {"material.E": 3e4, "material.nu": 0.0, "material.thickness": 0.02}
    for bending, factor in (("plate", 3 * (1 - 0.3**2) * 2**3), (1e-4, 1.0)):
        model = Simulation(scene, Material(E=1e4, bending=bending), solver=MPMSolver(0.1), device="cpu").model
        changed = model.at(changes)
        torch.testing.assert_close(changed.points.bending, factor * model.points.bending)


def test_material_that_a_region_gives_is_not_changed_everywhere(tmp_path):
    region = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.2, None, None]}}
    material = CONFIG["material"] | {"regions": [{"region": region, "E": 2e4}]}
    path = tmp_path / "regions.yaml"
    path.write_text(yaml.safe_dump(CONFIG | {"material": material}))
    model = Simulation.from_yaml(path, device="cpu").model
    with value_error(r"material\.regions"):
        model.at({"material.E": 1e3})
    assert model.at({"material.density": 30.0}).points is not model.points


@pytest.mark.parametrize("name", [name for name in NAMES if number(name).differentiable and name != "wind.flow"])
def test_gradients_are_kept(name, config):
    model = Simulation.from_yaml(config, device="cpu").model
    value = double(model.value(name)).requires_grad_()
    changed = model.at({name: value})
    points, aero = changed.points, changed.aero
    total = sum(part.double().sum() for part in (points.mass, points.volume, points.youngs_modulus))
    total = total + points.poisson_ratio.double().sum() + aero.C_D + aero.C_F + aero.C_L
    (slope,) = torch.autograd.grad(total, value)
    assert slope.abs() > 0


def _stiffened(monkeypatch, bound_anew, scene, **more):
    taken = []
    with monkeypatch.context() as patched:
        take = MPMSolver.init_state
        patched.setattr(MPMSolver, "init_state", lambda *args, **given: taken.append(1) or take(*args, **given))
        if bound_anew:
            patched.setattr(MPMSolver, "restiffen", lambda *_: False)
        simulation = Simulation(scene, wind=[4, 0, 0], device="cpu", **more)
        state, _ = simulation.advance(simulation.start())
        simulation.change({"material.E": 3e4, "material.nu": 0.1})
        for _ in range(2):
            state, _ = simulation.advance(state)
        simulation.change("material.E", 2e4)
        state, _ = simulation.advance(state)
    return state.position, len(taken)


@pytest.mark.parametrize(
    "kind",
    ["hinge", "clamp", "torch", "modes", "copies", "carried air", pytest.param("updated", id="updated: bound anew")],
)
def test_a_stiffness_that_changes_in_motion(kind, monkeypatch):
    """Bit by bit what a solver that takes the material anew does; and in ``total`` none has to."""
    kind_of_pin = {"clamp": "clamp", "modes": "clamp", "updated": "nodes"}.get(kind, "hinge")
    pin = PinnedRegion(up_to(x=-0.8 if kind == "modes" else 0.11), kind=kind_of_pin)
    formulation = kind if kind in ("modes", "updated") else "total"
    transfer = "torch" if kind == "torch" else "auto"
    scene = SolidScene("box", 2.0, spacing=0.1) if kind == "modes" else FlagScene(spacing=0.1)

    def found(anew):
        solver = MPMSolver(0.2, formulation, boundaries=[pin], transfer=transfer, gravity=(0, 0, 0))
        more = {"copies": [Copy(), Copy(shift=(2.0, 0.0, 0.0), delay=0.3)]} if kind == "copies" else {}
        more |= {"aero": AeroForce(added_mass=0.05)} if kind == "carried air" else {}
        return _stiffened(monkeypatch, anew, scene, solver=solver, **more)

    (expected, anew), (position, once) = found(True), found(False)
    assert torch.equal(position, expected)
    assert anew >= 3
    assert once == (3 if kind in ("updated", "carried air") else 1)


def test_a_gradient_that_would_be_lost_is_refused(config):
    model = Simulation.from_yaml(config, device="cpu").model
    with value_error("lose its gradient"):
        model.at({"wind.speed": torch.tensor(1.0, requires_grad=True)})


def test_angles_are_set_together(config):
    model = Simulation.from_yaml(config, device="cpu").model
    found = model.at({"wind.speed": 2.0, "wind.azimuth": 90.0, "wind.elevation": 30.0})
    _close(found.value("wind.flow"), [0.0, math.sqrt(3), 1.0])


def test_a_number_of_a_users_force_is_live_without_a_parse(breath, parser, monkeypatch):
    settings = parser.parse_args(["--config", str(breath), "--device=cpu"])
    session = Session(parser, settings)
    assert session.simulation.model.numbers("forces.") == ["forces.Breath.strength"]
    for name in ("parse_object", "dump", "instantiate"):
        monkeypatch.setattr(parser, name, lambda *_, **__: pytest.fail("parsed"))
    session._change({"forces.Breath.strength": 3.0, "material.E": 2e4, "wind.flow": [1.0, 0.0, 0.0]})
    assert session.problem is None
    assert session.simulation.custom_forces[0].strength == 3.0
    assert settings.forces[0].init_args.strength == 0.1  # those before the change, for undo
    session._undo()
    assert session.simulation.custom_forces[0].strength == 0.1
    _close(session.simulation.model.value("material.E"), 1e4)
    with value_error("from 0 to 9"):
        changed_settings(parser, settings, {"forces.Breath.strength": 10.0})


@pytest.mark.parametrize("backwards", [False, True])
def test_parameters_that_are_no_options_are_swept_too(backwards, config, parser, tmp_path):
    still = CONFIG | {"wind": CONFIG["wind"] | {"flow": [0.0, 0.0, 0.0]}}
    (tmp_path / "still.yaml").write_text(yaml.safe_dump(still))
    axes = {"wind.speed": [2.0, 3.0], "wind.azimuth": [90.0], "wind.modulations.0.period": [1.5]}
    axes = dict(reversed(axes.items())) if backwards else axes
    (tmp_path / "sweep.yaml").write_text(json.dumps({"base": str(tmp_path / "still.yaml"), "axes": axes}))
    plan = read_sweep(tmp_path / "sweep.yaml", parser=parser)
    found = [parse_run(parser, plan.config, 2, run) for run in plan.runs]
    _close([list(one.wind.flow) for one in found], [[0.0, 2.0, 0.0], [0.0, 3.0, 0.0]])
    assert [one.wind.modulations[0].init_args.period for one in found] == [1.5, 1.5]
    assert len(grouped(plan.runs, 8)) == 2
    settings = parser.parse_args(["--config", str(tmp_path / "still.yaml"), "--device=cpu"])
    changed = changed_settings(parser, settings, {"wind.azimuth": 90.0, "wind.speed": 2.0})
    _close(changed.wind.flow, [0.0, 2.0, 0.0])


def test_a_variant_is_a_simulation_of_its_own(tmp_path):
    edits = [Edit(region=beyond(x=0.5), color=[1.0, 0.0, 0.0], detail=0.5)]

    def made(**material):
        return Simulation(
            FlagScene(spacing=0.1), Material(**material), wind=[4, 0, 0], edits=edits, device="cpu",
            hold=up_to(x=0.11),
        )  # fmt: skip

    first, expected = made(E=1e4, density=50.0), made(E=3e4, density=80.0)
    first.start()
    other = first.variant({"material.E": 3e4, "material.density": 80.0}, config="frames: 3\n")
    *_, end = other.frames(3)
    *_, base = first.frames(3)
    *_, wanted = expected.frames(3)
    assert torch.equal(end.state.position, wanted.state.position)
    assert not torch.equal(base.state.position, wanted.state.position)
    assert torch.equal(other.scene.model.sh0, expected.scene.model.sh0)
    assert torch.equal(first.scene.model.sh0, expected.scene.model.sh0)
    assert other.painter.scene is other.scene is not first.scene
    assert other.config == "frames: 3\n"
