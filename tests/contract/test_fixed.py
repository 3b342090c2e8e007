"""Components stay as they were made, a run's record says what ran, and a wrong argument is refused in a sentence."""

import copy
import inspect
import math
import traceback
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from shared import up_to

import gaussian_swaying
from gaussian_swaying import (
    AeroForce,
    Box,
    Contact,
    Copy,
    Cylinder,
    DiffuseShader,
    Edit,
    Force,
    GaussianGust,
    GaussianSurfaceModel,
    Live,
    LookAtCamera,
    Material,
    MaterialPoints,
    MPMSolver,
    OrbitCamera,
    PinnedPoints,
    PinnedRegion,
    Recorder,
    Scene,
    Simulation,
    SineSway,
    Sphere,
    SplatSkin,
    UniformGust,
    WindField,
    WindForce,
)
from gaussian_swaying._fixed import fields_of
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.pins import Impulse
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import MaterialRegion
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.tables import Shelter
from gaussian_swaying.wind.turbulence import Turbulence

POLE = up_to(x=0.11)
FLAG = FlagScene(spacing=0.1)
ZERO, UNIT = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
BOX, CLOUD = Box(ZERO, UNIT), FLAG.generate()
POINTS = {"position": torch.eye(3), "volume": 1.0, "density": 1.0, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
PATCH = {"aero": AeroForce(), "wind": WindField(), "normal": torch.eye(3)[2:], "area": torch.ones(1)}
GIVEN = [
    *((kind, {}) for kind in (Material, Copy, Recorder, Contact, WindField, SineSway, UniformGust, GaussianGust)),
    *((kind, {}) for kind in (AeroForce, MPMSolver, OrbitCamera, DiffuseShader, FlagScene, Sand, Turbulence)),
    *((kind, {"region": BOX}) for kind in (PinnedRegion, MaterialRegion)),
    (Box, {"min": ZERO, "max": UNIT}),
    (Sphere, {"center": ZERO, "radius": 1.0}),
    (Cylinder, {"center": ZERO, "axis": UNIT, "radius": 1.0, "height": 1.0}),
    (Edit, {"E": 1.0}),
    (Turbulence, {"cells": [8, 8, 8]}),
    (PinnedPoints, {"at": [ZERO]}),
    (LookAtCamera, {"eye": ZERO, "target": UNIT}),
    (Scene, {"generator": FLAG}),
    (Part, {"name": "leaf"}),
    (Parts, {"labels": [0] * 4, "parts": [Part("leaf")]}),
    (ComputedAir, {"low": ZERO, "high": UNIT}),
    (SimFrame.fit, {"points": torch.eye(3)}),
    (MaterialPoints.create, POINTS),
    (GaussianSurfaceModel, {"cloud": CLOUD}),
    (SplatSkin, {"gaussians": CLOUD, "points": torch.eye(3)}),
    (WindForce, PATCH),
    (Simulation, {"scene": FLAG, "device": "cpu"}),
]
APART = {"CaptureDataModule", "SimulationDiverged", "SpatialWind", "SplatTrainer"}
"""An abstract class, an error, and those that Lightning assigns to."""


def _simulation(**given):
    return Simulation(FLAG, hold=POLE, wind=[0.0, 4.0, 1.0], device="cpu", **given)


def _made():
    simulation = _simulation()
    parts = (simulation.painter, simulation.model, next(simulation.frames(1)), simulation.scene.frame, CLOUD)
    more = (simulation.start(), simulation.solver.points, Live(), InteriorFilling(0.1))
    return [simulation, *parts, *more, FLAG, POLE, *(make(**given) for make, given in GIVEN)]


def test_nothing_that_is_public_can_be_assigned_or_deleted():
    made = _made()
    public = {name for name in dir(gaussian_swaying) if inspect.isclass(getattr(gaussian_swaying, name))}
    assert public - {base.__name__ for thing in made for base in type(thing).__mro__} == APART
    for thing in made:
        kind = type(thing)
        free = {"training", *getattr(kind, "assignable", ())}
        free |= {name for name in dir(kind) if getattr(getattr(kind, name), "fset", None)}
        for name in ({name for name in dir(thing) if name[0] != "_"} | {*fields_of(kind), "mispelt"}) - free:
            with pytest.raises(AttributeError, match=f"`{name}` of {kind.__name__} cannot be assigned"):
                setattr(thing, name, object())
            with pytest.raises(AttributeError, match=f"`{name}`"):
                delattr(thing, name)
        assert not [
            name for name, value in getattr(thing, "__dict__", {}).items() if isinstance(value, list) and name[0] != "_"
        ]
    wind = WindField(modulations=[SineSway()])
    for change in (wind.modulations.append, lambda gust: wind.modulations.insert(0, gust)):
        with pytest.raises(AttributeError, match="cannot be assigned"):
            change(UniformGust())
    with pytest.raises(AttributeError, match="cannot be assigned"):
        wind.modulations.pop(0)


@pytest.mark.parametrize(
    ("assign", "remedy"),
    [
        (lambda s: setattr(s.material, "E", 3e4), r"Material\(E=\.\.\.\).*simulation\.change\('material.E', \.\.\.\)"),
        (lambda s: setattr(s.wind, "flow", [0.0, 9.0, 0.0]), r"WindField\(flow=\.\.\.\).*\('wind.flow', \.\.\.\)"),
        (lambda s: setattr(s.aero, "law", "projected"), r"make another AeroForce\(law=\.\.\.\)\."),
        (lambda s: setattr(s, "material", Material()), r"make another Simulation\(material=\.\.\.\)\."),
    ],
)
def test_the_error_names_the_call_that_works(assign, remedy):
    with pytest.raises(AttributeError, match=remedy):
        assign(_simulation())


@pytest.mark.parametrize("from_file", [True, False])
def test_the_record_says_what_runs(tmp_path, from_file):
    simulation = _simulation()
    if from_file:
        simulation.config = "frames: 250\n"
    before = simulation.config
    assert ("changed_in_python" in before, "made_in_python" in before) == (False, not from_file)
    simulation.aero = AeroForce(law="projected")
    simulation.painter.shader = DiffuseShader(ambient=0.25)
    simulation.frame_dt = 0.02
    with torch.no_grad():
        simulation.wind.flows.mul_(2.0)
    simulation.run(tmp_path / "run", 2, recorder=Recorder(video=False), progress=False)
    found = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    found = found["changed_in_python" if from_file else "made_in_python"]
    assert found["aero"]["law"] == "projected"
    assert found["shader"]["ambient"] == 0.25
    assert found["frame_dt"] == simulation.model.frame_dt == 0.02
    assert found["wind"]["flows"]["sha256"] != WindField([0.0, 4.0, 1.0]).flows
    assert set(found) >= {"aero", "shader", "wind"}
    assert ("material" in found, "camera" in found) == (not from_file, not from_file)


def test_a_class_of_ones_own_keeps_its_own_names():
    class Counting(Force):
        def __init__(self) -> None:
            super().__init__()
            self.calls = 0

        def forward(self, state):
            return torch.zeros_like(state.position)

    class Wide(OrbitCamera):
        def __init__(self, lens: str) -> None:
            super().__init__(fov_y=90.0)
            self.lens = lens

    force, camera = Counting(), Wide("fish")
    force.calls += 1
    camera.lens = "flat"
    assert (force.calls, camera.lens) == (1, "flat")
    with pytest.raises(AttributeError, match="`fov_y` of Wide cannot be assigned"):
        camera.fov_y = 30.0


def _turns(make, count=6):
    alone = [list(make(which).frames(count))[-1].state.position for which in (0, 1)]
    both = [make(which).frames(count) for which in (0, 1)]
    for _ in range(count):
        together = [next(frames).state.position for frames in both]
    return alone, together


def _with_solver(shared):
    return lambda which: Simulation(
        FlagScene(spacing=0.1 + 0.02 * which), Material(E=[3e3, 3e5][which]), solver=shared, wind=[0.0, 4.0, 1.0]
    )


def _with_effect(shared):
    winds = [WindField(flow, effects=[shared]) for flow in ([0.0, 4.0, 0.0], [0.0, 0.0, 4.0])]
    return lambda which: Simulation(FLAG, hold=POLE, wind=winds[which])


@pytest.mark.parametrize(
    ("make", "shared"),
    [
        (_with_solver, MPMSolver(0.2, boundaries=[PinnedRegion(POLE)])),
        (_with_solver, MPMSolver(0.2, boundaries=[Impulse(POLE, [0.0, 0.001, 0.0], end=0.1, per_particle=True)])),
        (_with_effect, Turbulence(0.5, 1.0, cells=[16, 16, 16])),
        (_with_effect, Shelter()),
    ],
)
def test_simulations_share_no_part(make, shared):
    alone, together = _turns(make(shared))
    fresh, _ = _turns(lambda which: make(copy.deepcopy(shared))(which))
    for first, other, third in zip(alone, together, fresh, strict=True):
        assert torch.equal(first, other)
        assert torch.equal(first, third)
    assert alone[0].shape != alone[1].shape or not torch.equal(*alone)


WRONG = [
    *(object(), "x", b"x", {}, [], [1, 2], [None] * 3, ["a", "b", "c"], [[0, 0, 0]], -1, math.nan, 1e30),
    *(torch.zeros(2), torch.zeros(5, 3), torch.zeros(3, 3, 3).double(), torch.zeros(3).long(), np.zeros(3), None),
]
PACKAGE = Path(gaussian_swaying.__file__).parent


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("make", "given"), GIVEN, ids=lambda value: getattr(value, "__qualname__", ""))
def test_a_wrong_argument_is_named(make, given):
    names = [name for name in inspect.signature(make).parameters if name not in ("renderer", "device", "requires_grad")]
    refused = [error for name in names for wrong in WRONG if (error := _error(make, given | {name: wrong})) is not None]
    assert len(refused) > len(names)
    for error in refused:
        assert isinstance(error, TypeError | ValueError | OSError), error
        assert Path(traceback.extract_tb(error.__traceback__)[-1].filename).is_relative_to(PACKAGE), error
        assert "\n" not in str(error)


def _error(make, given):
    try:
        make(**given)
    except Exception as error:
        return error
    return None
