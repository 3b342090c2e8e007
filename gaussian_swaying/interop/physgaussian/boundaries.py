"""The boundary conditions of a PhysGaussian configuration: ``solver.boundaries``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.interop.physgaussian.fields import Fields, Notes, box, box_about, part
from gaussian_swaying.interop.physgaussian.space import CENTER, tidy

FOREVER = 999.0
"""A condition of PhysGaussian that ends at this time or later has no end here [s]."""

PADDING = 3
"""Margin of PhysGaussian's bounding box on each side of its grid [nodes]."""

RESET_SUBSTEPS = 15
"""Number of substeps after the end of a cuboid during which ``reset`` keeps all nodes at rest."""

_TYPES = (
    "bounding_box",
    "cuboid",
    "enforce_particle_translation",
    "enforce_particle_velocity_rotation",
    "particle_impulse",
    "release_particles_sequentially",
    "surface_collider",
)

_HOLDS = "holds the nodes that its particles touch; PhysGaussian only sets the velocities of the particles."


@dataclass(frozen=True)
class Turned:
    """Values of the grid that boundaries need: rotation from turned to simulation axes, spacing, side and substep."""

    turn: Tensor
    dx: float
    grid_lim: float
    substep: float

    def vector(self, value: Sequence[float]) -> list[float]:
        """A vector of turned axes in the axes of the simulation."""
        return tidy(self.turn @ torch.tensor(value, dtype=torch.float64))


def boundary_settings(index: int, entry: Any, space: Turned, sticky: bool, notes: Notes) -> list[dict[str, Any]]:
    """The boundaries for one entry of ``boundary_conditions``."""
    where = f"boundary_conditions[{index}]"
    take = Fields(entry, where)
    kind = take.get("type")
    if kind not in _TYPES:
        raise ValueError(f"Expected `type` of {where} to be one of {', '.join(_TYPES)}, but got {kind!r}.")
    take = Fields(entry, f"{where}, a {kind}")
    take.get("type")
    if kind == "bounding_box":
        made = _bounding_box(space)
    elif kind == "cuboid":
        made = _cuboid(take, space)
    elif kind == "particle_impulse":
        made = _impulse(take, space, notes)
    elif kind == "enforce_particle_translation":
        made = [_held(box_about(take.vector("point"), take.vector("size")), take, space, notes)]
    elif kind == "enforce_particle_velocity_rotation":
        made = [_rotation(take, space, notes)]
    elif kind == "surface_collider":
        made = [_plane(take, sticky, notes)]
    else:
        made = [_release(take, notes)]
    take.finish()
    return made


def _window(take: Fields, required: bool) -> dict[str, Any]:
    """``start`` and ``end`` of a boundary; an end far beyond any run becomes null."""
    start = take.number("start_time", *(() if required else (0.0,)))
    end = take.number("end_time", *(() if required else (1e3,)))
    return {"start": start, "end": None if end >= FOREVER else end}


def _bounding_box(space: Turned) -> list[dict[str, Any]]:
    # half a cell beyond the last stopped node, since faces exactly on nodes would depend on round-off
    low, high = (PADDING - 0.5) * space.dx, space.grid_lim - (PADDING + 0.5) * space.dx
    return [part("EnclosingBox", min=[round(low, 12)] * 3, max=[round(high, 12)] * 3, kind="separate")]


def _cuboid(take: Fields, space: Turned) -> list[dict[str, Any]]:
    region = box_about(take.vector("point"), take.vector("size"))
    velocity, window = space.vector(take.vector("velocity")), _window(take, required=False)
    moving = {"travels": True} if any(velocity) else {}
    made = [part("VelocityBox", region=region, velocity=velocity, **moving, **window)]
    if take.number("reset", 0) == 1:
        rest = {"region": {"class_path": "Everything"}, "velocity": [0.0, 0.0, 0.0]}
        if window["start"] > 0:
            made.append(part("VelocityBox", **rest, start=0.0, end=window["start"]))
        if window["end"] is not None:
            after = window["end"] + RESET_SUBSTEPS * space.substep
            made.append(part("VelocityBox", **rest, start=window["end"], end=after))
    return made


def _impulse(take: Fields, space: Turned, notes: Notes) -> list[dict[str, Any]]:
    force = space.vector(take.vector("force"))
    start, seconds = take.number("start_time", 0.0), take.whole("num_dt", 1) * space.substep
    region = box_about(take.vector("point", CENTER), take.vector("size", CENTER))
    notes.add(
        "`particle_impulse`: the total momentum is the same, but it is spread by mass; PhysGaussian gives each "
        "particle the same share, whatever its mass."
    )
    impulse = [round(f * seconds, 18) + 0.0 for f in force]
    return [part("Impulse", region=region, impulse=impulse, start=start, end=start + seconds, per_particle=True)]


def _held(region: dict[str, Any], take: Fields, space: Turned, notes: Notes) -> dict[str, Any]:
    velocity, window = space.vector(take.vector("velocity")), _window(take, required=True)
    notes.add(f"`enforce_particle_translation`: {_HOLDS}")
    if any(velocity):
        return part("Handle", region=region, velocity=velocity, kind="nodes", **window)
    return part("PinnedRegion", region=region, kind="nodes", **window)


def _rotation(take: Fields, space: Turned, notes: Notes) -> dict[str, Any]:
    point, normal = take.vector("point"), take.vector("normal")
    length = math.hypot(*normal)
    if length == 0:
        raise ValueError("Expected `normal` of an enforce_particle_velocity_rotation not to be zero.")
    normal = tuple(c / length for c in normal)
    half_height, radius = take.vector("half_height_and_radius", length=2)
    region = part("Cylinder", center=list(point), axis=list(normal), radius=radius, height=2 * half_height)
    rate, speed = take.number("rotation_scale"), take.number("translation_scale")
    window = _window(take, required=True)
    notes.add(f"`enforce_particle_velocity_rotation`: {_HOLDS}")
    if rate == 0 and speed == 0:
        return part("PinnedRegion", region=region, kind="nodes", **window)
    return part(
        "Handle",
        region=region,
        velocity=space.vector([speed * c for c in normal]),
        angular_velocity=space.vector([-rate * c for c in normal]),  # PhysGaussian turns clockwise about its normal
        pivot=list(point),
        kind="nodes",
        **window,
    )


def _plane(take: Fields, sticky: bool, notes: Notes) -> dict[str, Any]:
    point, normal = take.vector("point"), take.vector("normal")
    surface, friction = take.get("surface"), take.number("friction")
    if not isinstance(surface, str):
        raise TypeError(f"Expected `surface` of a surface_collider to be a name, but got {surface!r}.")
    if surface == "cut":
        raise ValueError(
            "The `surface` cut of a surface_collider is not supported, as it acts between two heights that are fixed "
            "in PhysGaussian's code: use sticky, slip or separate, and a cuboid for the rest."
        )
    if surface == "sticky" and friction != 0:
        raise ValueError(f"Expected `friction` of a sticky surface_collider to be 0, but got {friction:g}.")
    kind = surface if surface in ("sticky", "slip", "separate") else "separate"
    if kind != surface:
        notes.add(f"`surface` {surface!r} becomes separate, as in PhysGaussian, which treats unknown names like that.")
    if sticky and kind != "sticky":
        kind, friction = "sticky", 0.0
        notes.add(f"`surface`: the {surface} plane is sticky, as in PhysGaussian's code.")
    elif kind != "sticky":
        notes.add(f"`surface`: the plane is {kind} here; PhysGaussian's code makes every plane sticky.")
    return part("Plane", point=list(point), normal=list(normal), kind=kind, friction=friction, **_window(take, True))


def _release(take: Fields, notes: Notes) -> dict[str, Any]:
    normal = take.vector("normal")
    axes = [axis for axis, component in enumerate(normal) if component != 0]
    if len(axes) != 1:
        raise ValueError(
            "Expected `normal` of a release_particles_sequentially to be along one axis, as PhysGaussian supports no "
            f"other, but got {list(normal)}."
        )
    axis = axes[0]
    first, last = take.number("start_position"), take.number("end_position")
    if first == last:
        raise ValueError(f"Expected `start_position` and `end_position` to differ, but both are {first:g}.")
    start, end = take.number("start_time"), take.positive("end_time")
    if start != 0:
        raise ValueError(
            f"Expected `start_time` of a release_particles_sequentially to be 0, but got {start:g}: a front that moves "
            "before anything is held is not supported."
        )
    take.whole("num_layers")
    notes.add(
        "`release_particles_sequentially`: a continuous front between the two positions. PhysGaussian has 50 "
        f"layers, whatever `num_layers` says, and as many mirrored beyond `end_position`. Here it {_HOLDS}"
    )
    low, high = [0.0] * 3, [2.0] * 3
    low[axis], high[axis] = min(first, last), max(first, last)
    direction = [0.0] * 3
    direction[axis] = 1.0 if last > first else -1.0
    ends = [[v if k == axis else 1.0 for k in range(3)] for v in (first, last)]
    return part(
        "SequentialRelease",
        region=box(low, high),
        kind="nodes",
        direction=direction,
        start=0.0,
        end=end,
        first=ends[0],
        last=ends[1],
    )
