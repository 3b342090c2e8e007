"""PhysGaussian's JSON configurations as settings of this package, key by key.

See ``docs/physgaussian.md`` for what each key becomes and what it means there and here.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._inputs import read_json
from gaussian_swaying.simulation.physgaussian.space import CENTER, Normalisation, heading, tidy, up_direction

FOREVER = 999.0
"""End from which a condition of PhysGaussian is taken to last for ever [s]."""

PADDING = 3
"""Nodes that a bounding box of PhysGaussian keeps to at each side of its grid."""

RESET_SUBSTEPS = 15
"""Substeps for which ``reset`` of a cuboid keeps all nodes at rest after the end of the cuboid."""

_YIELD = math.sqrt(1.5)  # from a bound on |dev tau| to the yield stress in uniaxial tension


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a PhysGaussian configuration; ValueError if it is missing or no JSON object."""
    config = read_json(path, "PhysGaussian configuration")
    if not isinstance(config, dict):
        raise ValueError(f"The PhysGaussian configuration `{path}` is no JSON object: give one of its config/*.json.")
    return config


def convert(
    config: Mapping[str, Any], cameras: str | None = None, sticky_planes: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Settings of a simulation for a PhysGaussian configuration.

    Numbers stay as they are in the file: boxes and planes in the normalised space (:class:`Normalisation`), which is
    brought to the scene once its splat is known. Vectors turn with :func:`heading`.

    Args:
        config: The JSON object.
        cameras: ``cameras.json`` of the 3DGS model, for ``default_camera_index`` and the lens.
        sticky_planes: Make every plane stick, as PhysGaussian's code does whatever ``surface`` says.

    Returns:
        The settings, without a splat (``scene.ply`` is to be given), and sentences on what means something else here.

    Raises:
        ValueError: If a key is unknown, missing or out of range, or asks for what there is not; the message names it.
        TypeError: If a value has the wrong type.
    """
    take, notes = _Fields(config, "PhysGaussian's configuration"), _Notes()
    degrees = take.numbers("rotation_degree", [])
    axes = take.list("rotation_axis", [])
    normalisation = Normalisation(degrees, axes, take.number("scale", 1.0))
    turn = heading(normalisation.rotation)

    grid_lim, n_grid = take.positive("grid_lim", 2.0), take.whole("n_grid", 50)
    dx = grid_lim / n_grid
    substep, frame_dt = take.positive("substep_dt", 1e-4), take.positive("frame_dt", 1e-2)
    frames = take.whole("frame_num", 100)
    notes.add(
        f"`substep_dt`: the substep is adaptive instead of {substep:g} s, which only enters damping and impulses; "
        f"--solver.substep {substep:g} fixes it, and is refused where it is not surely stable."
    )

    scene: dict[str, Any] = {
        "ply": None,
        "up": up_direction(normalisation.rotation),
        "opacity_threshold": take.number("opacity_threshold", 0.02),
        "faint": "drop",
    }
    area = take.get("sim_area", None)
    if area is not None:
        bounds = check_vector("sim_area", area, 6)
        scene["region"] = _box(bounds[0::2], bounds[1::2])
    filling = take.get("particle_filling", None)
    if filling is not None:
        scene["filling"] = _filling(filling, n_grid, grid_lim, notes)

    material = _material(take, notes)
    solver: dict[str, Any] = {
        "formulation": "updated",
        "dx": dx,
        "gravity": _gravity(take, turn),
        "damping": _damping(take, substep, notes),
    }
    entries = take.list("boundary_conditions", [])
    solver["boundaries"] = [
        made
        for k, entry in enumerate(entries)
        for made in _boundary(k, entry, _Space(turn, dx, grid_lim, substep), sticky_planes, notes)
    ]
    camera = _camera(take, cameras, notes)
    take.finish()
    settings = {
        "frames": frames + 1,
        "frame_dt": frame_dt,
        "normalisation": dataclasses.asdict(normalisation),
        "scene": scene,
        "material": material,
        "solver": solver,
        "wind": {"flow": [0.0, 0.0, 0.0]},
        "aero": {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0},
        "camera": camera,
    }
    notes.add(
        "PhysGaussian has no wind: the coefficients of `aero` are zero; set `wind.flow` and C_D, C_F and C_L for some."
    )
    return settings, notes.sentences


def to_yaml(settings: Mapping[str, Any], notes: Iterable[str] = (), source: str | None = None) -> str:
    """Settings as a YAML file for ``--config``, with the notes as comments at its head.

    Args:
        settings: From :func:`convert`.
        notes: From :func:`convert`.
        source: Name of the file that was converted.

    Returns:
        The text.
    """
    import textwrap

    import yaml

    head = [f"PhysGaussian's {source or 'configuration'}, converted. Give the splat with --scene.ply PATH.", *notes]
    width = {"width": 118, "break_long_words": False, "break_on_hyphens": False}
    lines = [
        line
        for text in head
        for line in textwrap.wrap(text, initial_indent="# ", subsequent_indent="#   ", **width)  # type: ignore[arg-type]
    ]
    plain = json.loads(json.dumps(settings))  # no part twice, which YAML would only refer to
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return "\n".join(lines) + "\n" + body


class _Notes:
    """Sentences on differences, each once."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def add(self, sentence: str) -> None:
        if sentence not in self.sentences:
            self.sentences.append(sentence)


class _Fields:
    """The fields of a JSON object, each of which has to be asked for."""

    def __init__(self, fields: Any, where: str) -> None:
        if not isinstance(fields, Mapping):
            raise TypeError(f"Expected {where} to be a JSON object, but got {fields!r}.")
        self._fields, self._where, self._asked = fields, where, set[str]()

    def given(self, name: str) -> bool:
        return name in self._fields

    def get(self, name: str, *default: Any) -> Any:
        self._asked.add(name)
        if name in self._fields:
            return self._fields[name]
        if not default:
            raise ValueError(f"The key `{name}` of {self._where} is missing.")
        return default[0]

    def number(self, name: str, *default: float) -> float:
        value = self.get(name, *default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"Expected `{name}` of {self._where} to be a number, but got {value!r}.")
        return check_vector(name, [value], 1)[0]

    def positive(self, name: str, *default: float) -> float:
        value = self.number(name, *default)
        check_positive(name, value)
        return value

    def whole(self, name: str, *default: int, least: int = 1) -> int:
        value = self.number(name, *default)
        if value != int(value) or value < least:
            raise ValueError(
                f"Expected `{name}` of {self._where} to be a whole number from {least}, but got {value:g}."
            )
        return int(value)

    def flag(self, name: str, default: bool) -> bool:
        value = self.get(name, default)
        if not isinstance(value, bool):
            raise TypeError(f"Expected `{name}` of {self._where} to be true or false, but got {value!r}.")
        return value

    def list(self, name: str, *default: Any) -> Any:
        value = self.get(name, *default)
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"Expected `{name}` of {self._where} to be a list, but got {value!r}.")
        return list(value)

    def numbers(self, name: str, *default: Any) -> Any:
        value = self.list(name, *default)
        return list(check_vector(name, value, len(value)))

    def vector(self, name: str, *default: Sequence[float], length: int = 3) -> tuple[float, ...]:
        return check_vector(name, self.get(name, *default), length)

    def finish(self) -> None:
        for name in self._fields:
            if name not in self._asked:
                close = difflib.get_close_matches(name, sorted(self._asked), 1)
                hint = f"did you mean `{close[0]}`?" if close else f"known are {', '.join(sorted(self._asked))}."
                raise ValueError(f"Unknown key `{name}` in {self._where}: {hint}")


@dataclass(frozen=True)
class _Space:
    """What boundaries need to know of the grid: turned axes to simulation axes, spacing, side, substep."""

    turn: Tensor
    dx: float
    grid_lim: float
    substep: float

    def vector(self, value: Sequence[float]) -> list[float]:
        return tidy(self.turn @ torch.tensor(value, dtype=torch.float64))


def _part(name: str, **arguments: Any) -> dict[str, Any]:
    return {"class_path": name, "init_args": arguments}


def _box(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    return _part("Box", min=[round(v, 12) for v in low], max=[round(v, 12) for v in high])


def _box_about(point: Sequence[float], size: Sequence[float]) -> dict[str, Any]:
    pairs = list(zip(point, size, strict=True))
    return _box([p - s for p, s in pairs], [p + s for p, s in pairs])


# ---- material


_MATERIALS = ("jelly", "metal", "sand", "foam", "snow", "plasticine")
_LAW_KEYS = {
    "yield_stress": ("metal", "foam", "plasticine"),
    "hardening": ("metal", "plasticine"),
    "xi": ("metal", "plasticine"),
    "friction_angle": ("sand",),
    "plastic_viscosity": ("foam",),
    "softening": ("plasticine",),
}


def _poisson(take: _Fields, *default: float) -> float:
    nu = take.number("nu", *default)
    if not 0 <= nu < 0.5:
        raise ValueError(
            f"Expected `nu` to lie from 0 to below 0.5, but got {nu}: at 0.5 the stress is infinite, use 0.49."
        )
    return nu


def _material(take: _Fields, notes: _Notes) -> dict[str, Any]:
    """``material`` with its regions."""
    kind = take.get("material", "jelly")
    if kind not in _MATERIALS:
        raise ValueError(f"Expected `material` to be one of {', '.join(_MATERIALS)}, but got {kind!r}.")
    for name, kinds in _LAW_KEYS.items():
        if take.given(name) and kind not in kinds:
            notes.add(f"`{name}` has no effect on {kind}.")
    flow = {name: take.number(name, default) for name, default in _FLOW_DEFAULTS.items()}
    E, nu = take.positive("E", 1e5), _poisson(take, 0.4)
    density = take.positive("density", 200.0)
    material: dict[str, Any] = {"E": E, "nu": nu, "density": density, "volume": "cell"}
    law = _law(kind, flow, E, nu, notes)
    if law is not None:
        material["law"] = law
    regions = []
    for k, entry in enumerate(take.list("additional_material_params", [])):
        part = _Fields(entry, f"additional_material_params[{k}]")
        box, own_E, own_nu = _box_about(part.vector("point"), part.vector("size")), part.positive("E"), _poisson(part)
        region = {"region": box, "E": own_E, "nu": own_nu, "density": part.positive("density", density)}
        part.finish()
        own = _law(kind, flow, own_E, own_nu, notes)
        if own != law:
            region["law"] = own
        regions.append(region)
    if regions:
        material["regions"] = regions
    if kind == "sand":
        notes.add("`material`: PhysGaussian gives sand the mean volume of all particles, here each cell has its own.")
    return material


_FLOW_DEFAULTS = {
    "yield_stress": 0.0,
    "hardening": 0.0,
    "xi": 0.0,
    "friction_angle": 25.0,
    "plastic_viscosity": 0.0,
    "softening": 0.1,
}


def _law(kind: str, flow: Mapping[str, float], E: float, nu: float, notes: _Notes) -> dict[str, Any] | None:
    """``material.law``; None for fixed corotated elasticity.

    PhysGaussian bounds ``|dev tau|`` by its yield stress, which grows by ``2 mu xi`` (with ``hardening`` = 1) and falls
    by ``softening`` times the flow of the logarithmic strain. In the stress and strain of uniaxial tension that is a
    yield stress ``sqrt(3/2)`` times as large, and 3/2 of the growth.
    """
    stress = flow["yield_stress"]
    growth = 2 * E / (2 * (1 + nu)) * flow["xi"] if flow["hardening"] == 1 else 0.0
    if kind == "jelly":
        return None
    if kind == "sand":
        return _part("Sand", friction_angle=flow["friction_angle"])
    if kind == "foam":
        notes.add(
            "`plastic_viscosity`: the overstress relaxes exactly here, and by one implicit step in PhysGaussian, whose "
            "shear modulus grows with the stretch meanwhile."
        )
        return _part("Foam", yield_stress=stress, viscosity=flow["plastic_viscosity"])
    if kind == "snow":
        notes.add("`material`: PhysGaussian computes no stress for snow; here it has that of Stomakhin et al. 2013.")
        return _part("Snow")
    if kind == "metal":
        if stress <= 0:
            raise ValueError(
                f"Expected `yield_stress` of metal to be positive, but got {stress:g}: without it nothing keeps its "
                "shape; give it, or use foam."
            )
        if growth < 0:
            raise ValueError(f"Expected `xi` of metal not to be negative, but got {flow['xi']:g}: use plasticine.")
        return _part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)
    if stress <= 0:
        notes.add("`yield_stress`: plasticine without any never flows in PhysGaussian, so it is elastic here.")
        return None
    notes.add(
        "`material`: plasticine has Hencky's stress here and the fixed corotated one in PhysGaussian, which takes all "
        "stress from a particle whose yield stress reaches zero; here it keeps its pressure."
    )
    growth -= flow["softening"]
    if growth > 0:
        return _part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)
    return _part("Plasticine", yield_stress=_YIELD * stress, softening=-1.5 * growth)


# ---- solver


def _gravity(take: _Fields, turn: Tensor) -> list[float]:
    value = take.get("g", 9.8)
    if not isinstance(value, (list, tuple)):
        raise ValueError(
            f"Expected `g` to be a list of 3 numbers, for example [0, 0, -9.8], but got {value!r}; PhysGaussian's own "
            "default, a single number, stops it too."
        )
    return tidy(turn @ torch.tensor(check_vector("g", value), dtype=torch.float64))


def _damping(take: _Fields, substep: float, notes: _Notes) -> float:
    """Decay rate [1/s] of the factor by which velocities are multiplied every substep."""
    rpic = take.number("rpic_damping", 0.0)
    if rpic != 0:
        notes.add(
            f"`rpic_damping` {rpic:g} has no counterpart: the transfer is APIC; --solver.damping and "
            "--solver.stiffness_damping take energy out."
        )
    if take.given("pic_damping"):
        take.number("pic_damping")
        notes.add("`pic_damping` has no effect in PhysGaussian, nor here.")
    factor = take.positive("grid_v_damping_scale", 1.1)
    return 0.0 if factor >= 1 else -math.log(factor) / substep


_TYPES = (
    "bounding_box",
    "cuboid",
    "enforce_particle_translation",
    "enforce_particle_velocity_rotation",
    "particle_impulse",
    "release_particles_sequentially",
    "surface_collider",
)


def _boundary(index: int, entry: Any, space: _Space, sticky: bool, notes: _Notes) -> list[dict[str, Any]]:
    """The boundaries that one entry of ``boundary_conditions`` becomes."""
    where = f"boundary_conditions[{index}]"
    take = _Fields(entry, where)
    kind = take.get("type")
    if kind not in _TYPES:
        raise ValueError(f"Expected `type` of {where} to be one of {', '.join(_TYPES)}, but got {kind!r}.")
    take = _Fields(entry, f"{where}, a {kind}")
    take.get("type")
    if kind == "bounding_box":
        made = _bounding_box(space)
    elif kind == "cuboid":
        made = _cuboid(take, space)
    elif kind == "particle_impulse":
        made = _impulse(take, space, notes)
    elif kind == "enforce_particle_translation":
        made = [_held(_box_about(take.vector("point"), take.vector("size")), take, space, notes)]
    elif kind == "enforce_particle_velocity_rotation":
        made = [_rotation(take, space, notes)]
    elif kind == "surface_collider":
        made = [_plane(take, sticky, notes)]
    else:
        made = [_release(take, notes)]
    take.finish()
    return made


def _window(take: _Fields, required: bool) -> dict[str, Any]:
    """``start`` and ``end`` of a boundary; those of PhysGaussian that end beyond any run have none."""
    start = take.number("start_time", *(() if required else (0.0,)))
    end = take.number("end_time", *(() if required else (1e3,)))
    return {"start": start, "end": None if end >= FOREVER else end}


def _bounding_box(space: _Space) -> list[dict[str, Any]]:
    # half a cell beyond the last node that is stopped, as faces on nodes would depend on round-off
    low, high = (PADDING - 0.5) * space.dx, space.grid_lim - (PADDING + 0.5) * space.dx
    return [_part("EnclosingBox", min=[round(low, 12)] * 3, max=[round(high, 12)] * 3, kind="separate")]


def _cuboid(take: _Fields, space: _Space) -> list[dict[str, Any]]:
    region = _box_about(take.vector("point"), take.vector("size"))
    velocity, window = space.vector(take.vector("velocity")), _window(take, required=False)
    moving = {"travels": True} if any(velocity) else {}
    made = [_part("VelocityBox", region=region, velocity=velocity, **moving, **window)]
    if take.number("reset", 0) == 1:
        rest = {"region": {"class_path": "Everything"}, "velocity": [0.0, 0.0, 0.0]}
        if window["start"] > 0:
            made.append(_part("VelocityBox", **rest, start=0.0, end=window["start"]))
        if window["end"] is not None:
            after = window["end"] + RESET_SUBSTEPS * space.substep
            made.append(_part("VelocityBox", **rest, start=window["end"], end=after))
    return made


def _impulse(take: _Fields, space: _Space, notes: _Notes) -> list[dict[str, Any]]:
    force = space.vector(take.vector("force"))
    start, seconds = take.number("start_time", 0.0), take.whole("num_dt", 1) * space.substep
    region = _box_about(take.vector("point", CENTER), take.vector("size", CENTER))
    notes.add(
        "`particle_impulse`: the same momentum in all, but spread by mass, where PhysGaussian gives each particle as "
        "much, whatever its mass."
    )
    impulse = [round(f * seconds, 18) + 0.0 for f in force]
    return [_part("Impulse", region=region, impulse=impulse, start=start, end=start + seconds, per_particle=True)]


_HOLDS = "holds the nodes that its particles touch, where PhysGaussian sets the particles' velocities only."


def _held(region: dict[str, Any], take: _Fields, space: _Space, notes: _Notes) -> dict[str, Any]:
    velocity, window = space.vector(take.vector("velocity")), _window(take, required=True)
    notes.add(f"`enforce_particle_translation`: {_HOLDS}")
    if any(velocity):
        return _part("Handle", region=region, velocity=velocity, **window)
    return _part("PinnedRegion", region=region, **window)


def _rotation(take: _Fields, space: _Space, notes: _Notes) -> dict[str, Any]:
    point, normal = take.vector("point"), take.vector("normal")
    length = math.hypot(*normal)
    if length == 0:
        raise ValueError("Expected `normal` of an enforce_particle_velocity_rotation not to be zero.")
    normal = tuple(c / length for c in normal)
    half_height, radius = take.vector("half_height_and_radius", length=2)
    region = _part("Cylinder", center=list(point), axis=list(normal), radius=radius, height=2 * half_height)
    rate, speed = take.number("rotation_scale"), take.number("translation_scale")
    window = _window(take, required=True)
    notes.add(f"`enforce_particle_velocity_rotation`: {_HOLDS}")
    if rate == 0 and speed == 0:
        return _part("PinnedRegion", region=region, **window)
    return _part(
        "Handle",
        region=region,
        velocity=space.vector([speed * c for c in normal]),
        angular_velocity=space.vector([-rate * c for c in normal]),  # PhysGaussian turns clockwise about its normal
        pivot=list(point),
        **window,
    )


def _plane(take: _Fields, sticky: bool, notes: _Notes) -> dict[str, Any]:
    point, normal = take.vector("point"), take.vector("normal")
    surface, friction = take.get("surface"), take.number("friction")
    if not isinstance(surface, str):
        raise TypeError(f"Expected `surface` of a surface_collider to be a name, but got {surface!r}.")
    if surface == "cut":
        raise ValueError(
            "The `surface` cut of a surface_collider has no counterpart, as it acts between two heights that are fixed "
            "in PhysGaussian's code: use sticky, slip or separate, and a cuboid for the rest."
        )
    if surface == "sticky" and friction != 0:
        raise ValueError(f"Expected `friction` of a sticky surface_collider to be 0, but got {friction:g}.")
    kind = surface if surface in ("sticky", "slip", "separate") else "separate"
    if kind != surface:
        notes.add(f"`surface` {surface!r} is taken for separate, as PhysGaussian takes what it does not know.")
    if sticky and kind != "sticky":
        kind, friction = "sticky", 0.0
        notes.add(f"`surface`: the {surface} plane sticks, as PhysGaussian's code makes it.")
    elif kind != "sticky":
        notes.add(f"`surface`: the plane is {kind} here; PhysGaussian's code makes every plane stick.")
    return _part("Plane", point=list(point), normal=list(normal), kind=kind, friction=friction, **_window(take, True))


def _release(take: _Fields, notes: _Notes) -> dict[str, Any]:
    normal = take.vector("normal")
    axes = [axis for axis, component in enumerate(normal) if component != 0]
    if len(axes) != 1:
        raise ValueError(
            "Expected `normal` of a release_particles_sequentially to lie along one axis, as PhysGaussian takes no "
            f"other, but got {list(normal)}."
        )
    axis = axes[0]
    first, last = take.number("start_position"), take.number("end_position")
    if first == last:
        raise ValueError(f"Expected `start_position` and `end_position` to differ, but both are {first:g}.")
    start, end = take.number("start_time"), take.positive("end_time")
    if start != 0:
        raise ValueError(
            f"Expected `start_time` of a release_particles_sequentially to be 0, but got {start:g}: a front that is on "
            "its way before anything is held has no counterpart."
        )
    take.whole("num_layers")
    notes.add(
        "`release_particles_sequentially`: a continuous front between the two positions, where PhysGaussian has 50 "
        f"layers whatever `num_layers` says, and as many mirrored beyond `end_position`; it {_HOLDS}"
    )
    low, high = [0.0] * 3, [2.0] * 3
    low[axis], high[axis] = min(first, last), max(first, last)
    direction = [0.0] * 3
    direction[axis] = 1.0 if last > first else -1.0
    ends = [[v if k == axis else 1.0 for k in range(3)] for v in (first, last)]
    return _part(
        "SequentialRelease",
        region=_box(low, high),
        direction=direction,
        start=0.0,
        end=end,
        first=ends[0],
        last=ends[1],
    )


# ---- filling and camera


_FILLING_NOTES = {
    "density_threshold": "is counted otherwise here, so `scene.filling.threshold` keeps its default.",
    "search_threshold": "is not needed: cells are enclosed by the vote of 26 rays (`scene.filling.votes`).",
    "search_exclude_direction": "has no counterpart: rays go to all sides, and are outvoted where a side is open.",
    "ray_cast_direction": "has no counterpart: all rays count crossings, not one.",
    "max_particles_num": "has no counterpart: the number of points follows from the volume.",
    "boundary": "has no counterpart: all that is enclosed is filled; `scene.region` bounds it.",
    "smooth": "has no counterpart: the density is blurred by half a cell.",
    "visualize": "has no counterpart: filled points are never drawn.",
}


def _filling(fields: Any, n_grid: int, grid_lim: float, notes: _Notes) -> dict[str, Any]:
    """``scene.filling``: another method for the same purpose, on a grid of the same spacing."""
    take = _Fields(fields, "particle_filling")
    spacing = grid_lim / take.whole("n_grid", 4 * n_grid)
    wanted = take.whole("max_partciels_per_cell", 1)
    count = next((n for n in (1, 8) if wanted <= n), 27)
    if count != wanted:
        notes.add(f"`particle_filling.max_partciels_per_cell` {wanted} becomes {count}, as a cell has 1, 8 or 27.")
    for name, sentence in _FILLING_NOTES.items():
        value = take.get(name, None)
        if value is not None and value is not False:
            notes.add(f"`particle_filling.{name}` {sentence}")
    take.finish()
    return {"spacing": spacing, "particles_per_cell": count}


def _camera(take: _Fields, cameras: str | None, notes: _Notes) -> dict[str, Any]:
    """``camera``: one of the model's, the moving one, or our own where the file of cameras is missing."""
    viewpoint = list(take.vector("mpm_space_viewpoint_center", CENTER))
    up = list(take.vector("mpm_space_vertical_upward_axis", (0.0, 0.0, 1.0)))
    index = take.whole("default_camera_index", 0, least=-1)
    names = ("init_azimuthm", "init_elevation", "init_radius")
    start = {name: take.get(name, None) for name in names}
    deltas = {name: take.get(name, None) for name in ("delta_a", "delta_e", "delta_r")}
    moves = take.flag("move_camera", False)
    if take.flag("show_hint", False):
        notes.add("`show_hint` has no effect: PhysGaussian prints the camera's angles and stops.")
    orbit = "gaussian_swaying.simulation.physgaussian.camera.PhysGaussianCamera"
    if index >= 0 and cameras is None:
        notes.add(
            f"`default_camera_index` {index} is a camera of the 3DGS model, whose cameras.json was not given, so it is "
            f"an orbit here; --camera {orbit} --camera.cameras PATH --camera.index {index} takes the model's."
        )
        return _part("OrbitCamera", width=960, height=540)
    if index >= 0:
        return _part(orbit, cameras=cameras, index=index)
    wanted = [*start, *deltas] if moves else list(start)
    for name in wanted:
        if (start | deltas)[name] is None:
            raise ValueError(f"The key `{name}` is missing, which `default_camera_index` -1 needs.")
        take.number(name)
    if cameras is None:
        notes.add(
            "`default_camera_index` -1: PhysGaussian takes lens and size of the picture from the model's cameras.json; "
            "here they are those of `camera`."
        )
    change = [float(d) for d in deltas.values()] if moves else [0.0] * 3
    return _part(
        orbit,
        cameras=cameras,
        azimuth=float(start["init_azimuthm"]),
        elevation=float(start["init_elevation"]),
        radius=float(start["init_radius"]),
        delta_azimuth=change[0],
        delta_elevation=change[1],
        delta_radius=change[2],
        viewpoint=viewpoint,
        up=up,
    )


__all__ = ["convert", "read_config", "to_yaml"]
