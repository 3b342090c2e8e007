"""PhysGaussian's JSON configurations as settings of this package, key by key.

``docs/physgaussian.md`` lists what each key becomes, and what it means in PhysGaussian and here.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._arguments import is_number
from gaussian_swaying._checks import check_choice, check_frames, check_positive, check_vector
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.simulation.model import CENTER, rotation_matrix


def tidy(vector: Tensor) -> list[float]:
    """Round numbers from a rotation, without -0."""
    return [round(v, 12) + 0.0 for v in vector.tolist()]


def heading(rotation: Tensor) -> Tensor:
    """Rotation about z from turned axes to those of the simulation; shape (3, 3), float64."""
    return rotation_from_z(tidy(rotation[2])).T @ rotation.T


class Fields:
    """The fields of a JSON object; a field that is never read is an error.

    Args:
        fields: The object.
        where: Its name, for messages.
        notes: Sentences on differences.
    """

    def __init__(self, fields: Any, where: str, notes: list[str]) -> None:
        if not isinstance(fields, Mapping):
            raise TypeError(f"Expected {where} to be a JSON object, but got {fields!r}.")
        self._fields, self._where, self._asked, self.notes = fields, where, set[str](), notes

    def get(self, name: str, *default: Any) -> Any:
        """The value of a key, or the default; ValueError if there is neither."""
        self._asked.add(name)
        if name not in self._fields and not default:
            raise ValueError(f"The key `{name}` of {self._where} is missing.")
        return self._fields.get(name, *default)

    def number(self, name: str, *default: float) -> float:
        value = self.get(name, *default)
        if not is_number(value):
            raise TypeError(f"Expected `{name}` of {self._where} to be a number, but got {value!r}.")
        return check_vector(name, [value], 1)[0]

    def positive(self, name: str, *default: float) -> float:
        value = self.number(name, *default)
        check_positive(name, value)
        return value

    def whole(self, name: str, default: int) -> int:
        value = self.number(name, default)
        if value != int(value) or value < 1:
            raise ValueError(f"Expected `{name}` of {self._where} to be a whole number of at least 1, but got {value}.")
        return int(value)

    def list(self, name: str) -> Any:
        value = self.get(name, [])
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"Expected `{name}` of {self._where} to be a list, but got {value!r}.")
        return list(value)

    def vector(self, name: str, *default: Sequence[float], length: int = 3) -> tuple[float, ...]:
        """A list of ``length`` finite numbers."""
        return check_vector(name, self.get(name, *default), length)

    def window(self, required: bool = True) -> dict[str, Any]:
        """``start`` and ``end`` of a boundary; an end far beyond any run becomes null."""
        start, end = (self.number(f"{n}_time", *(() if required else (v,))) for n, v in (("start", 0.0), ("end", 1e3)))
        return {"start": start, "end": None if end >= FOREVER else end}

    def finish(self) -> None:
        """Raise ValueError, with a suggestion, if a key was never read."""
        for name in self._fields:
            if name not in self._asked:
                close = difflib.get_close_matches(name, sorted(self._asked), 1)
                hint = f"did you mean `{close[0]}`?" if close else f"known are {', '.join(sorted(self._asked))}."
                raise ValueError(f"Unknown key `{name}` in {self._where}: {hint}")


def part(name: str, **arguments: Any) -> dict[str, Any]:
    """The dict for a class and its arguments."""
    return {"class_path": name, "init_args": arguments}


def box(low: Iterable[float], high: Iterable[float]) -> dict[str, Any]:
    """A box between two corners."""
    return part("Box", min=[round(v, 12) for v in low], max=[round(v, 12) for v in high])


def box_of(take: Fields, *default: Sequence[float]) -> dict[str, Any]:
    """The box of ``point`` and ``size``, half of its sides."""
    pairs = list(zip(take.vector("point", *default), take.vector("size", *default), strict=True))
    return box((p - s for p, s in pairs), (p + s for p, s in pairs))


# ---- materials

_YIELD = math.sqrt(1.5)  # from a bound on |dev tau| to the yield stress in uniaxial tension


def material_settings(take: Fields) -> dict[str, Any]:
    """``material`` with its regions."""
    kind = take.get("material", "jelly")
    check_choice("material", kind, ("jelly", "metal", "sand", "foam", "snow", "plasticine"))
    names = {"yield_stress": 0, "hardening": 0, "xi": 0, "friction_angle": 25, "plastic_viscosity": 0, "softening": 0.1}
    flow = {name: take.number(name, default) for name, default in names.items()}
    E, nu, density = take.positive("E", 1e5), take.number("nu", 0.4), take.positive("density", 200.0)
    law = _law(kind, flow, E, nu)
    material: dict[str, Any] = {"E": E, "nu": nu, "density": density, "volume": "cell"}
    material |= {} if law is None else {"law": law}
    regions = []
    for k, entry in enumerate(take.list("additional_material_params")):
        given = Fields(entry, f"additional_material_params[{k}]", take.notes)
        region: dict[str, Any] = {"region": box_of(given), "E": given.positive("E"), "nu": given.number("nu")}
        region["density"] = given.positive("density", density)
        given.finish()
        own = _law(kind, flow, region["E"], region["nu"])
        regions.append(region if own == law else region | {"law": own})
    return material | ({"regions": regions} if regions else {})


def _law(kind: str, flow: Mapping[str, float], E: float, nu: float) -> dict[str, Any] | None:
    """``material.law``; None for fixed corotated elasticity.

    PhysGaussian bounds ``|dev tau|`` by its yield stress, which grows by ``2 mu xi`` (with ``hardening`` = 1) and falls
    by ``softening`` times the plastic logarithmic strain. In terms of uniaxial tension the yield stress is
    ``sqrt(3/2)`` times and the growth 3/2 times as large.
    """
    stress, growth = flow["yield_stress"], E / (1 + nu) * flow["xi"] if flow["hardening"] == 1 else 0.0
    if kind == "jelly" or (kind == "plasticine" and stress <= 0):  # which never yields there
        return None
    if kind == "sand":
        return part("Sand", friction_angle=flow["friction_angle"])
    if kind == "foam":
        return part("Foam", yield_stress=stress, viscosity=flow["plastic_viscosity"])
    if kind == "snow":
        return part("Snow")
    if kind == "plasticine":
        growth -= flow["softening"]
        if growth <= 0:
            return part("Plasticine", yield_stress=_YIELD * stress, softening=-1.5 * growth)
    elif stress <= 0:
        raise ValueError(
            f"Expected `yield_stress` of metal to be positive, but got {stress:g}: without it nothing keeps its "
            "shape; set it, or use foam."
        )
    return part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)


# ---- boundary conditions

FOREVER = 999.0
"""A condition of PhysGaussian that ends at this time or later has no end here [s]."""

PADDING = 3
"""Margin of PhysGaussian's bounding box on each side of its grid [nodes]."""

RESET_SUBSTEPS = 15
"""Number of substeps after the end of a cuboid during which ``reset`` keeps all nodes at rest."""


@dataclass(frozen=True)
class Turned:
    """The normalised space of a PhysGaussian configuration, as its boundaries need it.

    Args:
        turn: Rotation from turned to simulation axes, shape (3, 3).
        dx: Spacing of the grid.
        grid_lim: Its side.
        substep: PhysGaussian's substep [s].
    """

    turn: Tensor
    dx: float
    grid_lim: float
    substep: float

    def vector(self, value: Sequence[float]) -> list[float]:
        """A vector of turned axes in the axes of the simulation."""
        return tidy(self.turn @ torch.tensor(value, dtype=torch.float64))


def boundary_settings(index: int, entry: Any, space: Turned, notes: list[str]) -> list[dict[str, Any]]:
    """The boundaries for one entry of ``boundary_conditions``."""
    where = f"boundary_conditions[{index}]"
    kind = Fields(entry, where, notes).get("type")
    check_choice(f"type` of `{where}", kind, tuple(_BOUNDARIES))
    take = Fields(entry, f"{where}, a {kind}", notes)
    take.get("type")
    made = _BOUNDARIES[kind](take, space)
    take.finish()
    return list(made)


def _bounding_box(take: Fields, space: Turned) -> list[dict[str, Any]]:
    # half a cell beyond the last stopped node, since faces exactly on nodes would depend on round-off
    low, high = (PADDING - 0.5) * space.dx, space.grid_lim - (PADDING + 0.5) * space.dx
    return [part("Wall", shape=box([low] * 3, [high] * 3), kind="separate")]


def _cuboid(take: Fields, space: Turned) -> list[dict[str, Any]]:
    region, velocity = box_of(take), space.vector(take.vector("velocity"))
    window = take.window(required=False)
    made = [part("VelocityBox", region=region, velocity=velocity, **window)]
    if take.number("reset", 0) == 1:
        rest = {"region": {"class_path": "Everything"}, "velocity": [0.0, 0.0, 0.0]}
        if window["start"] > 0:
            made.append(part("VelocityBox", **rest, start=0.0, end=window["start"]))
        if window["end"] is not None:
            after = window["end"] + RESET_SUBSTEPS * space.substep
            made.append(part("VelocityBox", **rest, start=window["end"], end=after))
    return made


def _impulse(take: Fields, space: Turned) -> list[dict[str, Any]]:
    start, seconds = take.number("start_time", 0.0), take.whole("num_dt", 1) * space.substep
    impulse = [round(f * seconds, 18) + 0.0 for f in space.vector(take.vector("force"))]
    region = box_of(take, CENTER)
    return [part("Impulse", region=region, impulse=impulse, start=start, end=start + seconds, per_particle=True)]


def _translation(take: Fields, space: Turned) -> list[dict[str, Any]]:
    velocity = space.vector(take.vector("velocity"))
    moved = {"velocity": velocity} if any(velocity) else {}
    return [part("PinnedRegion", region=box_of(take), kind="nodes", **moved, **take.window())]


def _rotation(take: Fields, space: Turned) -> list[dict[str, Any]]:
    point, normal = take.vector("point"), take.vector("normal")
    length = math.hypot(*normal)
    if length == 0:
        raise ValueError("Expected `normal` of an enforce_particle_velocity_rotation not to be zero.")
    normal = tuple(c / length for c in normal)
    half_height, radius = take.vector("half_height_and_radius", length=2)
    region = part("Cylinder", center=list(point), axis=list(normal), radius=radius, height=2 * half_height)
    rate, speed = take.number("rotation_scale"), take.number("translation_scale")
    moved: dict[str, Any] = {}
    if rate or speed:  # PhysGaussian turns clockwise about its normal
        moved = {"velocity": space.vector([speed * c for c in normal])}
        moved |= {"angular_velocity": space.vector([-rate * c for c in normal]), "pivot": list(point)}
    return [part("PinnedRegion", region=region, kind="nodes", **moved, **take.window())]


def _plane(take: Fields, space: Turned) -> list[dict[str, Any]]:
    point, normal = take.vector("point"), take.vector("normal")
    surface, friction = take.get("surface"), take.number("friction")
    if surface == "cut":
        raise ValueError(
            "The `surface` cut of a surface_collider is not supported, as it acts between two heights that are fixed "
            "in PhysGaussian's code: use sticky, slip or separate, and a cuboid for the rest."
        )
    kind = surface if surface in ("sticky", "slip") else "separate"
    if kind != "sticky":
        take.notes.append(f"`surface`: the plane is {kind}; PhysGaussian's code makes every plane sticky.")
    shape = part("HalfSpace", point=list(point), normal=list(normal))
    return [part("Wall", shape=shape, kind=kind, friction=friction, **take.window())]


def _release(take: Fields, space: Turned) -> list[dict[str, Any]]:
    normal = take.vector("normal")
    axes = [axis for axis, component in enumerate(normal) if component != 0]
    if len(axes) != 1:
        raise ValueError(
            "Expected `normal` of a release_particles_sequentially to be along one axis, as PhysGaussian supports no "
            f"other, but got {list(normal)}."
        )
    first, last = take.number("start_position"), take.number("end_position")
    if first == last:
        raise ValueError(f"Expected `start_position` and `end_position` to differ, but both are {first:g}.")
    start, end = take.number("start_time"), take.positive("end_time")
    if start != 0:
        raise ValueError(
            f"Expected `start_time` of a release_particles_sequentially to be 0, but got {start:g}: a front that moves "
            "before anything is held is not supported."
        )
    take.get("num_layers", None)  # it has 50

    def at(value: float, rest: float) -> list[float]:
        return [value if axis == axes[0] else rest for axis in range(3)]

    region = box(at(min(first, last), 0.0), at(max(first, last), 2.0))
    front = [at(first, 1.0), at(last, 1.0)]
    return [part("PinnedRegion", region=region, kind="nodes", front=front, start=0.0, end=end)]


_BOUNDARIES = {
    "bounding_box": _bounding_box,
    "cuboid": _cuboid,
    "enforce_particle_translation": _translation,
    "enforce_particle_velocity_rotation": _rotation,
    "particle_impulse": _impulse,
    "release_particles_sequentially": _release,
    "surface_collider": _plane,
}


# ---- the whole configuration


def convert(config: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Settings of a simulation for a PhysGaussian configuration.

    Numbers stay as in the file: boxes and planes are in the normalised space (``normalisation``), which is mapped
    to the scene once its splat is known. Vectors are rotated with :func:`heading`.

    Returns:
        The settings, without a splat (``scene.ply`` must be set), and sentences about what is left out.
    """
    notes: list[str] = []
    take = Fields(config, "PhysGaussian's configuration", notes)
    degrees, axes = take.list("rotation_degree"), take.list("rotation_axis")
    degrees = list(check_vector("rotation_degree", degrees, len(degrees)))
    rotation, scale = rotation_matrix(degrees, axes), take.positive("scale", 1.0)
    turn, grid_lim, n_grid = heading(rotation), take.positive("grid_lim", 2.0), take.whole("n_grid", 50)
    substep, frame_dt = take.positive("substep_dt", 1e-4), take.positive("frame_dt", 1e-2)
    frames = check_frames("frame_num", take.whole("frame_num", 100))
    scene: dict[str, Any] = {"ply": None, "up": tidy(rotation[2])}  # with which z up is the z axis of the turned axes
    scene |= {"opacity_threshold": take.number("opacity_threshold", 0.02), "faint": "drop"}
    area, filling = take.get("sim_area", None), take.get("particle_filling", None)
    if area is not None:
        bounds = check_vector("sim_area", area, 6)
        scene["region"] = box(bounds[0::2], bounds[1::2])
    if filling is not None:
        scene["filling"] = filling_settings(Fields(filling, "particle_filling", notes), n_grid, grid_lim)
    material = material_settings(take)
    space = Turned(turn, grid_lim / n_grid, grid_lim, substep)
    gravity = take.get("g", 9.8)
    if not isinstance(gravity, (list, tuple)):
        raise ValueError(
            f"Expected `g` to be a list of 3 numbers, for example [0, 0, -9.8], but got {gravity!r}; PhysGaussian's "
            "default, a single number, does not work there either."
        )
    solver: dict[str, Any] = {"formulation": "updated", "dx": space.dx}
    solver |= {"gravity": space.vector(check_vector("g", gravity)), "damping": _damping(take, substep)}
    entries = enumerate(take.list("boundary_conditions"))
    solver["boundaries"] = [made for k, entry in entries for made in boundary_settings(k, entry, space, notes)]
    if [name for name in CAMERA if take.get(name, None) is not None]:
        notes.append("PhysGaussian's camera is left out: set `camera`.")
    take.finish()
    settings = {
        "frames": frames + 1,
        "frame_dt": frame_dt,
        "normalisation": {"rotation_degree": degrees, "rotation_axis": axes, "scale": scale},
        "scene": scene,
        "material": material,
        "solver": solver,
        "wind": {"flow": [0.0, 0.0, 0.0]},
        "aero": {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0},
        "camera": part("OrbitCamera", width=960, height=540),
    }
    return settings, list(dict.fromkeys(notes))


def _damping(take: Fields, substep: float) -> float:
    """Decay rate [1/s] of the factor by which velocities are multiplied every substep."""
    if take.number("rpic_damping", 0.0):
        take.notes.append("`rpic_damping` is left out, as the transfer is APIC: use `solver.damping`.")
    take.get("pic_damping", None)  # has no effect there either
    factor = take.positive("grid_v_damping_scale", 1.1)
    return 0.0 if factor >= 1 else -math.log(factor) / substep


CAMERA = (
    "mpm_space_viewpoint_center", "mpm_space_vertical_upward_axis", "default_camera_index", "show_hint",
    "init_azimuthm", "init_elevation", "init_radius", "move_camera", "delta_a", "delta_e", "delta_r",
)  # fmt: skip
FILLING = (
    "density_threshold", "search_threshold", "search_exclude_direction", "ray_cast_direction", "max_particles_num",
    "boundary", "smooth", "visualize",
)  # fmt: skip


def filling_settings(take: Fields, n_grid: int, grid_lim: float) -> dict[str, Any]:
    """``scene.filling`` for PhysGaussian's particle filling: another method, on a grid with the same spacing."""
    spacing, wanted = grid_lim / take.whole("n_grid", 4 * n_grid), take.whole("max_partciels_per_cell", 1)
    unused = [name for name in FILLING if take.get(name, None) not in (None, False)]
    if unused:
        take.notes.append(f"`particle_filling`: {', '.join(unused)} are left out, as another method fills.")
    take.finish()
    return {"spacing": spacing, "particles_per_cell": next((n for n in (1, 8) if wanted <= n), 27)}


def to_yaml(settings: Mapping[str, Any], notes: Iterable[str] = (), source: str | None = None) -> str:
    """Settings as a YAML file for ``--config``, with the notes as comments at the top.

    Returns:
        The text.
    """
    import yaml

    head = [f"PhysGaussian's {source or 'configuration'}, converted. Give the splat with --scene.ply PATH.", *notes]
    plain = json.loads(json.dumps(settings))  # copies, since YAML would write repeated parts as references
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return "".join(f"# {line}\n" for line in head) + body
