"""The block of bytes that the solver in a browser needs, and the scenes that it cannot simulate.

The block is the length of its head (uint32, little-endian), the head in JSON, and the arrays that the head lists, in
float32 or whole numbers. The solvers are ``kernels.js``, ``webgpu.js`` and ``modal.js`` in ``tools/player/live_web``;
their definitions are :mod:`~gaussian_swaying.mpm.total` and :mod:`~gaussian_swaying.mpm.modes`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.modes import Modes
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import message
from gaussian_swaying.viewer.live_web.kernels import pack_kernels
from gaussian_swaying.viewer.live_web.longest import longest_courant
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.field import GaussianGust, SineSway, UniformGust, WindField, stream_start
from gaussian_swaying.wind.force import LAWS as AERO_LAWS
from gaussian_swaying.wind.force import WindForce
from gaussian_swaying.wind.turbulence import Turbulence


def check(simulation: Simulation) -> None:
    """Check that a browser can simulate this.

    Args:
        simulation: The simulation, not started.
    """
    solver, model = simulation.solver, simulation.model
    if not isinstance(solver, MPMSolver):
        raise _refused("`custom_solver`", "leave it out")
    sways = solver.formulation == "modes"
    if not sways and solver.formulation != "total":
        raise _refused(f"`solver.formulation: {solver.formulation}`", "set it to total")
    if model.scene.surface_places is not None and model.scene.surface_places.contact is not None:
        raise _refused("`contact` of the material with itself", "set `contact` to null")
    if simulation.stepper.copies is not None:
        raise _refused("`copies`", "leave them out")
    if simulation.editor.edits:
        raise _refused("`edits`", "leave them out")
    if simulation.stepper.joints:
        raise _refused("joints of `scene.parts`", "leave out `joint_stiffness` and `joint_turning` of its parts")
    if model.aero.carried:
        raise _refused("the air that the material carries", "set `aero.added_mass` to 0")
    if model.air is not None:
        raise _refused("computed air", "set `air` to null")
    if model.forces:
        raise _refused("`forces` of your own", "leave them out")
    wind = model.wind
    stirred = sways and isinstance(wind, WindField) and list(map(type, wind.effects)) == [Turbulence]
    if type(wind) is not WindField or not (wind.uniform or stirred):
        remedy = "leave out `wind.effects`, of which `solver.formulation: modes` takes one Turbulence"
        raise _refused("a wind that differs from place to place", remedy)
    for modulation in wind.modulations:
        if type(modulation) not in (SineSway, UniformGust, GaussianGust):
            raise _refused(f"the {type(modulation).__name__} in `wind.modulations`", "leave it out")
    if sways:  # it checks the rest itself
        return
    if not compiles("cpu") or model.points.position.dtype != torch.float32:
        raise _refused("what its kernels are not compiled for", "install llvmlite, and set `dtype` to float32")
    for law in model.points.laws:
        if law.device is None:
            raise _refused(f"the law {type(law).__name__} in `material.law`", "take one with device functions")
    for boundary in solver.boundaries:
        _check_boundary(boundary)


def _check_boundary(boundary: Any) -> None:
    name = type(boundary).__name__
    if isinstance(boundary, Obstacle):
        if not boundary.still:
            raise _refused(f"the `path` of the {type(boundary.shape).__name__}", "leave it out")
        return
    if type(boundary) not in (PinnedRegion, PinnedPoints):
        raise _refused(f"the {name} in `solver.boundaries`", "take a PinnedRegion, PinnedPoints or Obstacle")
    if boundary.moves:
        raise _refused(f"the `velocity` of the {name}", "leave it out")
    if not boundary.always:
        raise _refused(f"`start` and `end` of the {name}", "leave them out")


def _refused(what: str, remedy: str) -> ValueError:
    return ValueError(f"The page of --live-web cannot simulate {what}: {remedy}.")


def pack_solver(simulation: Simulation, nodes: Tensor) -> bytes:
    """The block of a simulation that is at rest.

    Args:
        simulation: The simulation, after its ``start``; see :func:`check`.
        nodes: The nodes that the Gaussians follow, as flat indices, shape (M,).
    """
    solver = simulation.solver
    assert isinstance(solver, MPMSolver)
    bound = solver.bound
    assert isinstance(bound, Total)
    settings, scene = bound.settings, simulation.scene
    head = {
        "dx": settings.dx,
        "gravity": list(settings.gravity),
        "damping": settings.damping,
        "viscous": settings.stiffness_damping,
        "substep": solver.substep,
        "frameDt": simulation.frame_dt,
        "size": scene.size * scene.frame.metres_per_unit,
        "idle": simulation.stepper.idle,
        "wind": _wind(simulation.wind),
    }
    if isinstance(bound, Modes):
        return _pack_modes(head, simulation, bound, nodes)
    force = simulation.stepper.wind_force
    head |= {"cfl": solver.cfl, "longest": max(solver.cfl, longest_courant(bound))}
    kernels, more = pack_kernels(bound, None if head["idle"] else force)
    head |= {"kernels": kernels, "bending": float(bound.bending_rate) * settings.dx**2 / 6}
    mass = bound.points.mass
    explicit = not head["idle"] and force.aero.drag_step == "explicit"
    rate = force.aero.rate(torch.ones_like(mass), force.area, mass) if explicit else mass[:0]
    arrays = {"mass": mass, "rate": rate, "followed": nodes}
    return _joined(head, arrays | more)


def _pack_modes(head: dict[str, Any], simulation: Simulation, bound: Modes, nodes: Tensor) -> bytes:
    """The block of a body that sways by its modes, with shapes in small whole numbers."""
    force = simulation.stepper.wind_force.on_sites(bound.site, bound.sites)
    omega = bound.square.sqrt()
    every = [bound._everywhere(x.unflatten(-2, (-1, 3)).flatten(-2))[nodes] for x in (bound.shape, bound.turn)]
    shapes = dict(zip(("siteShape", "siteTurn"), bound.site_modes.chunk(2, -2), strict=True))
    shapes |= dict(zip(("nodeShape", "nodeTurn"), (x.reshape(-1, len(omega)) for x in every), strict=True))
    arrays = {
        "omega": omega,
        "ratio": bound.ratio - (head["damping"] / omega + head["viscous"] * omega) / 2,  # that of the material
        "rest": bound.site_rest,
        "mass": bound.site_mass,
        **_wind_arrays(force),
    }
    for name, shape in shapes.items():  # loads of one size move a mode by 1 / omega^2, at a rate of 1 / omega
        scaled = shape.double() / omega
        largest = scaled.abs().amax(-1, keepdim=True)  # that of a speck may be a hundred times the usual one
        step = (largest / 32767).clamp(min=float(largest[largest > 0].median()) / 256)
        arrays |= {name: (scaled / step).round().short(), f"{name}Step": step}
    wind = simulation.wind
    assert isinstance(wind, WindField)
    for effect in wind.effects:
        assert isinstance(effect, Turbulence)
        unit = float(effect.table.abs().max()) / 64
        arrays["turbulence"] = (effect.table / unit).round().char()
        head["wind"]["turbulence"] = {
            "cells": list(effect.table.shape[:3]),
            "axes": effect.axes.tolist(),
            "side": effect.spacing[0],
            "offset": effect.now(Moment(*torch.zeros(3, 1, 3, dtype=torch.float64)))[0, :3].tolist(),
            "scale": effect.scale * unit,
        }
    return _joined(head | {"modes": list(shapes), "period": 2 * math.pi / bound.first, "aero": _aero(force)}, arrays)


def _joined(head: dict[str, Any], arrays: dict[str, Tensor]) -> bytes:
    listed, blocks = [], []
    for name, values in arrays.items():
        kind = "f4" if values.is_floating_point() else {torch.int8: "i1", torch.int16: "i2"}.get(values.dtype, "i4")
        listed.append([name, kind, values.numel()])
        blocks.append(values.detach().cpu().contiguous().numpy().astype(np.dtype("<" + kind)).tobytes())
    return message(head | {"arrays": listed}, *blocks)


def _aero(force: WindForce) -> dict[str, Any]:
    aero = force.aero
    return {
        "drag": float(aero.C_D),
        "friction": float(aero.C_F),
        "lift": float(aero.C_L),
        "airDensity": aero.air_density,
        "law": AERO_LAWS.index(aero.law),
        "implicit": aero.drag_step == "semi_implicit",
        "maxAreaRatio": None if aero.max_area_ratio == math.inf else aero.max_area_ratio,
    }


def _wind_arrays(force: WindForce) -> dict[str, Tensor]:
    """The patches of each site: area vectors and the sum of A N N^T."""
    sums = force.sums
    assert sums is not None
    ends = sums.point.bincount(minlength=len(force.area)).cumsum(0)
    upper = sums.tensor[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    first = torch.cat([ends.new_zeros(1), ends])
    return {"area": force.area, "tensor": upper, "firstVector": first, "vectors": sums.vector}


def _wind(wind: Any) -> dict[str, Any]:
    parts: list[dict[str, Any]] = []
    for stream, part in enumerate(wind.modulations):
        start = str(int(stream_start(wind.seed, stream)))  # of 64 bits
        if isinstance(part, SineSway):
            parts.append({"kind": "sway", "amplitude": part.amplitude, "period": part.period, "phase": part.phase})
        elif isinstance(part, UniformGust):
            parts.append({"kind": "uniform", "delta": part.delta, "interval": part.interval, "start": start})
        else:
            parts.append({"kind": "gaussian", "std": part.std, "interval": part.interval, "start": start})
    linear = wind.interpolation == "linear"
    return {"times": wind.times.tolist(), "flows": wind.flows.tolist(), "linear": linear, "modulations": parts}
