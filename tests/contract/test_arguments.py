"""What people pass by mistake is refused in a sentence of the package, not in one of torch, numpy or Python."""

import inspect
import math
import traceback
from pathlib import Path

import numpy as np
import pytest
import torch

import gaussian_swaying
from gaussian_swaying import (
    AeroForce,
    Box,
    Contact,
    Copy,
    Cylinder,
    DiffuseShader,
    Edit,
    GaussianGust,
    GaussianSurfaceModel,
    LookAtCamera,
    Material,
    MaterialPoints,
    MPMSolver,
    OrbitCamera,
    PhongShader,
    PinnedPoints,
    PinnedRegion,
    Recorder,
    Scene,
    SimFrame,
    Simulation,
    SineSway,
    Sphere,
    UniformGust,
    WindField,
    WindForce,
)
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import MaterialRegion
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.turbulence import Turbulence

FLAG, ZERO, UNIT = FlagScene(spacing=0.1), [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
BOX, CLOUD = Box(ZERO, UNIT), FLAG.generate()
POINTS = {"position": torch.eye(3), "volume": 1.0, "density": 1.0, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
PATCH = {"aero": AeroForce(), "wind": WindField(), "normal": torch.eye(3)[2:], "area": torch.ones(1)}
GIVEN = [
    *((kind, {}) for kind in (Material, Copy, Recorder, Contact, WindField, SineSway, UniformGust, GaussianGust)),
    *(
        (kind, {})
        for kind in (AeroForce, MPMSolver, OrbitCamera, DiffuseShader, PhongShader, FlagScene, Sand, Turbulence)
    ),
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
    (WindForce, PATCH),
    (Simulation, {"scene": FLAG, "device": "cpu"}),
]
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
