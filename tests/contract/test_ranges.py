"""Numbers beyond sense, and settings that would have no effect, are refused by their names; what people use is not."""

import math

import numpy as np
import pytest
from shared import value_error

from gaussian_swaying import (
    AeroForce,
    Copy,
    Edit,
    GaussianGust,
    Material,
    MPMSolver,
    OrbitCamera,
    Recorder,
    Scene,
    SineSway,
    Sphere,
    WindField,
)
from gaussian_swaying._numbers import SENSE
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.wind.computed_air import ComputedAir

FAR, NEAR = [0.0] * 3, [1.0] * 3


@pytest.mark.parametrize(
    ("make", "name", "values"),
    [
        (lambda v: Material(E=v), "material.E", (1e30, 1e-30)),
        (lambda v: Material(density=v), "material.density", (1e12, 1e-9)),
        (lambda v: Material(thickness=v), "material.thickness", (1e-30, 1e9)),
        (lambda v: Material(damping_ratio=v), "material.damping_ratio", (1e30, 1e3)),
        (lambda v: Part("leaf", E=v), "E of the part 'leaf'", (1e30,)),
        (lambda v: Edit(time=v, E=1e3), "edits.time", (1e12,)),
        (lambda v: Copy([v, 0.0, 0.0]), "copies.shift", (1e7, -1e30)),
        (lambda v: Copy(delay=v), "copies.delay", (1e12, -1e12)),
        (lambda v: WindField([0.0, v, 0.0]), "flow", (1e8, -1e8)),
        (lambda v: SineSway(period=v), "period", (1e-9, 1e12)),
        (lambda v: SineSway(phase=v), "phase", (math.nan, 1e30)),
        (lambda v: GaussianGust(std=v), "std", (1e9,)),
        (lambda v: AeroForce(C_D=v), "C_D", (1e9,)),
        (lambda v: AeroForce(C_L=v), "C_L", (1e9, math.nan)),
        (lambda v: MPMSolver(v), "dx", (1e9, 1e-9)),
        (lambda v: MPMSolver(0.1, gravity=[0.0, 0.0, v]), "gravity", (-1e6,)),
        (lambda v: MPMSolver(0.1, substep=v), "substep", (1e-15, 1e3)),
        (lambda v: Recorder(fps=v), "recorder.fps", (1e9, 1e-9)),
        (lambda v: OrbitCamera(radius=v), "radius", (1e30, 1e-30)),
        (lambda v: Sphere(FAR, v), "radius", (1e30, 1e-30)),
        (lambda v: ComputedAir(FAR, NEAR, speed=v), "air.speed", (1e-9, 1e9)),
        (lambda v: ComputedAir(FAR, NEAR, v), "air.cells", (10**6, 10**12)),
    ],
)
def test_numbers_beyond_sense_are_refused(make, name, values):
    for value in values:
        with value_error(f"`{name}`") as error:
            make(value)
        assert str(error.value).count(".\n") == 0


def test_what_people_use_is_not_refused():
    for E, density, thickness in ((1e2, 1.0, 1e-6), (2.1e11, 2e4, 5.0), (1.4e5, 400.0, 0.5)):
        assert Material(E=E, density=density, thickness=thickness, damping_ratio=0.0).E == E
    for speed in (0.0, 0.1, 140.0):
        assert float(WindField([speed, 0.0, 0.0]).flows[0, 0]) == speed
    assert (MPMSolver(1e-4).dx, MPMSolver(10.0).dx) == (1e-4, 10.0)
    assert Copy([2000.0, -500.0, 30.0], turn=-720.0, delay=86400.0).delay == 86400.0
    assert all(sense.low < sense.high for sense in SENSE.values())


def test_parts_without_effect_are_refused(tmp_path):
    flag = FlagScene(spacing=0.1)
    labels = [0] * 50 + [1] * (len(flag.generate().means) - 50)
    parts = Parts(labels, [Part("cloth"), Part("pole", attached="cloth")])
    with value_error(r"`attached`.*no effect.*`scene.connected: grid`"):
        Scene(generator=flag, parts=parts)
    path = parts.save(tmp_path / "parts.npz")
    assert Scene(generator=flag, parts=path, connected="surface").parts.digest() == parts.digest()
    with np.load(path) as found:
        np.savez(path, **found, damping=np.zeros(2))
    with value_error(r"array `damping`.*remove or rename"):
        Parts.load(path)
