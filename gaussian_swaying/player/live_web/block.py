"""The block of bytes that the solver in a browser needs, and the scenes that it cannot simulate.

The block is the length of its head (uint32, little-endian), the head in JSON, and the arrays that the head lists, in
planes of float32 or whole numbers, those of 16 bits folded. The solvers are ``solver.js``, ``webgpu.js`` and
``modal.js`` in ``tools/player/live_web``; their definitions are :mod:`~gaussian_swaying.mpm.total` and
:mod:`~gaussian_swaying.mpm.modes`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.modes import LONGEST, PER_PERIOD, SHORTEST, Modes
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.player.film.page import folded, message, planes
from gaussian_swaying.player.live_web.kernels import pack_modes, pack_total
from gaussian_swaying.player.live_web.longest import longest_courant
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.effects import Obstacle as Past
from gaussian_swaying.wind.field import GaussianGust, SineSway, UniformGust, WindField
from gaussian_swaying.wind.tables import CarriedField


def check(simulation: Simulation) -> None:
    """Check that a browser can simulate this."""
    solver, model = simulation.solver, simulation.model
    if not isinstance(solver, MPMSolver):
        raise _refused("`custom_solver`", "leave it out")
    sways = solver.formulation == "modes"
    if not sways and solver.formulation != "total":
        raise _refused(f"`solver.formulation: {solver.formulation}`", "set it to total")
    if simulation.stepper.copies is not None:
        raise _refused("`copies`", "leave them out")
    if simulation.editor.edits:
        raise _refused("`edits`", "leave them out")
    if simulation.stepper.joints:
        raise _refused("joints of `scene.parts`", "leave out `joint_stiffness` and `joint_turning` of its parts")
    if sways and model.aero.carried:
        raise _refused("the air that the material carries", "set `aero.added_mass` to 0")
    if model.air is not None:
        raise _refused("computed air", "set `air` to null")
    for force in model.forces:
        function = force.device_function()
        if sways or function is None or function.per_substep.count:
            raise _refused(f"the {type(force).__name__} in `forces`", "leave it out")
    wind = model.wind
    if type(wind) is not WindField:
        raise _refused(f"the {type(wind).__name__} in `wind`", "take a WindField")
    for effect in wind.effects:
        function = effect.device_function()  # type: ignore[operator]
        known = type(effect) is Past or (isinstance(effect, CarriedField) and type(effect).now is CarriedField.now)
        if function is None or (function.per_substep.count and not known):
            raise _refused(f"the {type(effect).__name__} in `wind.effects`", "leave it out")
    for modulation in wind.modulations:
        if type(modulation) not in (SineSway, UniformGust, GaussianGust):
            raise _refused(f"the {type(modulation).__name__} in `wind.modulations`", "leave it out")
    if not compiles("cpu") or model.points.position.dtype != torch.float32:
        raise _refused("what its kernels are not compiled for", "install llvmlite, and set `dtype` to float32")
    if sways:  # it checks the rest itself
        return
    for law in model.points.laws:
        if law.device is None:
            raise _refused(f"the law {type(law).__name__} in `material.law`", "take one with device functions")
    for boundary in solver.boundaries:
        _check_boundary(boundary)


def _check_boundary(boundary: Any) -> None:
    name = type(boundary).__name__
    if isinstance(boundary, Obstacle):
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
    settings, scene, stepper = bound.settings, simulation.scene, simulation.stepper
    force, wind = stepper.wind_force, simulation.wind
    assert isinstance(wind, WindField)
    head: dict[str, Any] = {
        "dx": settings.dx,
        "damping": settings.damping,
        "viscous": settings.stiffness_damping,
        "substep": solver.substep,
        "frameDt": simulation.frame_dt,
        "size": scene.size * scene.frame.metres_per_unit,
        "idle": stepper.idle,
    }
    if isinstance(bound, Modes):
        here = None if stepper.idle else force.on_sites(bound.site, bound.sites)
        more, arrays = pack_modes(bound, here, wind, len(nodes))
        head |= {"modes": True, "substeps": [LONGEST, SHORTEST, 2 * math.pi / bound.first / PER_PERIOD]}
        return _joined(head | more, arrays | _shapes(bound, nodes))
    more, arrays = pack_total(bound, stepper.forces, wind)
    mass = bound.points.mass
    explicit = not stepper.idle and force.aero.drag_step == "explicit"
    rate = force.aero.rate(torch.ones_like(mass), force.area, mass) if explicit else mass[:0]
    head |= {
        "cfl": solver.cfl,
        "longest": max(solver.cfl, longest_courant(bound)),
        "bending": float(bound.bending_rate) * settings.dx**2 / 6,
    }
    return _joined(head | more, arrays | {"mass": mass, "rate": rate, "followed": nodes})


def _shapes(bound: Modes, nodes: Tensor) -> dict[str, Tensor]:
    omega = bound.square.sqrt()
    every = [bound._everywhere(x.unflatten(-2, (-1, 3)).flatten(-2))[nodes] for x in (bound.shape, bound.turn)]
    shown = torch.cat([x.reshape(-1, len(omega)) for x in every])
    arrays = {"omega": omega, "mass": bound.site_mass, "sorted": torch.arange(bound.sites)}
    for name, shape in {"sites": bound.site_modes, "nodes": shown}.items():
        scaled = shape.double() / omega  # loads of one size move a mode by 1 / omega^2, at a rate of 1 / omega
        largest = scaled.abs().amax(-1, keepdim=True)  # that of a speck may be a hundred times the usual one
        step = (largest / 32767).clamp(min=float(largest[largest > 0].median()) / 256)
        arrays |= {name: (scaled / step).round().short(), f"{name}Step": step}
    return arrays


def _joined(head: dict[str, Any], arrays: dict[str, Tensor]) -> bytes:
    listed, blocks = [], []
    for name, values in arrays.items():
        kind = "f4" if values.is_floating_point() else {torch.int8: "i1", torch.int16: "i2"}.get(values.dtype, "i4")
        listed.append([name, kind, values.numel()])
        numbers = values.detach().cpu().contiguous().numpy().astype(np.dtype("<" + kind))
        blocks.append(planes(folded(numbers) if kind == "i2" else numbers))
    return message(head | {"arrays": listed}, *blocks)
