r"""Fabrics, whose stiffness in bending is far below that of a plate that stretches as they do.

Wang, O'Brien & Ramamoorthi (2011), "Data-driven elastic models for cloth: modeling and measurement", ACM Transactions
on Graphics 30 (4), measured both.
"""

from __future__ import annotations

import math

import torch

from bench.problems.beams import elastica
from bench.problems.settings import Axial, Result, Settings, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.simulation import Simulation

FABRICS = {"interlock": (0.187, 23e-6), "rib": (0.276, 46e-6), "ponte": (0.284, 36e-6), "denim": (0.324, 64e-6)}
"""Mass [kg/m²] and bending stiffness [N m] of four fabrics, as measured."""
GRAVITY, THICK, HELD = 9.81, 0.5e-3, 2  # m/s²; m, which only shares E h and density h; held cells


def hanging_strip(
    fabric: str,
    cells: int = 16,
    stretch: float = 1000.0,
    length: float = 0.04,
    settle: float = 12.0,
    settings: Settings | None = None,
    layers: int = 3,
) -> Result:
    r"""A strip of a fabric that hangs over an edge under its weight, from a scene as a user makes it.

    It is clamped level at one end, in plane strain with :math:`\nu = 0.3`, and damped until it rests. A sheet of one
    layer has :math:`\nu = 0`: plane strain would not keep it from curving across. The elastica of
    :math:`b = \rho h g L^3 / D` is the exact shape of a strip that does not stretch. The free length begins halfway
    between the last held and the first free points.

    Units: ``stretch`` [N/m]; ``length`` [m].

    Returns:
        ``error`` (of the drop of the tip, relative), ``drop`` and ``exact`` (over the length), ``b``, ``span`` (of
        the outer layers [cells]), ``grams`` (mass [g/m²]), ``micro`` (D [µN m]), ``residual`` (speed of the tip,
        relative to its drop and frequency) and the common quantities.
    """
    settings = Settings(dtype=torch.float32) if settings is None else settings
    mass, stiffness = FABRICS[fabric]
    dx = length / cells
    flag = FlagScene(width=length + HELD * dx, height=2 * dx, spacing=0.25 * dx, ripple=0.0)
    pin = PinnedRegion(Box([None] * 3, [HELD * dx, None, None]), "clamp")
    omega = 3.516015 / length**2 * math.sqrt(stiffness / mass)
    boundaries = [Axial((2,)), pin]
    hanging = settings.solver(dx, gravity=(0.0, -GRAVITY, 0.0), boundaries=boundaries, damping=2 * omega)
    material = Material(
        E=stretch / THICK, nu=0.3 if layers == 3 else 0.0, density=mass / THICK, thickness=THICK, bending=stiffness
    )
    scene = Scene(generator=flag, metres_per_unit=1.0, layers=layers)
    simulation = Simulation(scene, material, solver=hanging, device="cpu")
    points, solver = simulation.scene.points, simulation.solver
    assert isinstance(solver, MPMSolver)
    start = solver.init_state(points, frame=simulation.scene.frame)
    place = simulation.scene.frame.point_to_scene(points.position.double())
    held = place[:, 0] < HELD * dx
    edge = 0.5 * float(place[held, 0].max() + place[~held, 0].min())
    true = flag.width - edge
    last = (place[:, 0] > place[:, 0].max() - 0.1 * dx) & (place[:, 1].abs() < 1e-6)
    run = follow(solver, start, settle / omega / 64, 64, lambda s: s.position[last].mean(0))
    b = mass * GRAVITY * true**3 / stiffness
    exact, _, slope = elastica(b)
    gap = flag.width - float(place[last, 0].mean())
    drop = (float(run.series[0, 1] - run.series[-1, 1]) + gap * math.sin(slope)) / true
    speed = float((run.series[-1] - run.series[-2]).norm()) * omega * 64 / settle
    span = 2 * float(place[:, 1].abs().max()) / dx
    return run.result(
        drop / exact - 1,
        drop=drop,
        exact=exact,
        b=b,
        span=span,
        grams=1e3 * mass,
        micro=1e6 * stiffness,
        residual=speed / (omega * true * drop),
    )
