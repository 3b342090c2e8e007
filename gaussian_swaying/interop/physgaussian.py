"""PhysGaussian's JSON configurations as settings of this package, key by key.

``docs/physgaussian.md`` lists what each key becomes, and what it means in PhysGaussian and here.
"""

from __future__ import annotations

import difflib
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_frames, check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying._inputs import read_json
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.rendering.cameras.camera import NEAR, Camera, look_at_camera
from gaussian_swaying.rendering.cameras.camera_path import PinholePath
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

    def _typed(self, name: str, kind: Any, what: str, *default: Any) -> Any:
        value = self.get(name, *default)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"Expected `{name}` of {self._where} to be {what}, but got {value!r}.")
        return value

    def number(self, name: str, *default: float) -> float:
        return check_vector(name, [self._typed(name, (int, float), "a number", *default)], 1)[0]

    def positive(self, name: str, *default: float) -> float:
        value = self.number(name, *default)
        check_positive(name, value)
        return value

    def whole(self, name: str, *default: int, least: int = 1) -> int:
        value = self.number(name, *default)
        if value != int(value) or value < least:
            raise ValueError(
                f"Expected `{name}` of {self._where} to be a whole number of at least {least}, but got {value:g}."
            )
        return int(value)

    def flag(self, name: str) -> bool:
        return bool(self._typed(name, bool, "true or false", False))

    def list(self, name: str) -> Any:
        return list(self._typed(name, (list, tuple), "a list", []))

    def vector(self, name: str, *default: Sequence[float], length: int = 3) -> tuple[float, ...]:
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
_FLOW: dict[str, tuple[float, tuple[str, ...]]] = {
    "yield_stress": (0.0, ("metal", "foam", "plasticine")),
    "hardening": (0.0, ("metal", "plasticine")),
    "xi": (0.0, ("metal", "plasticine")),
    "friction_angle": (25.0, ("sand",)),
    "plastic_viscosity": (0.0, ("foam",)),
    "softening": (0.1, ("plasticine",)),
}
"""Default of each number of a flow, and the materials that it has an effect on."""


def material_settings(take: Fields) -> dict[str, Any]:
    """``material`` with its regions."""
    kind, flow = take.get("material", "jelly"), {}
    check_choice("material", kind, ("jelly", "metal", "sand", "foam", "snow", "plasticine"))
    for name, (default, kinds) in _FLOW.items():
        flow[name] = take.number(name, default)
        if take.get(name, None) is not None and kind not in kinds:
            take.notes.append(f"`{name}` has no effect on {kind}.")
    E, nu, density = take.positive("E", 1e5), _poisson_ratio(take, 0.4), take.positive("density", 200.0)
    law = _law(kind, flow, E, nu, take.notes)
    material: dict[str, Any] = {"E": E, "nu": nu, "density": density, "volume": "cell"}
    material |= {} if law is None else {"law": law}
    regions = []
    for k, entry in enumerate(take.list("additional_material_params")):
        given = Fields(entry, f"additional_material_params[{k}]", take.notes)
        region: dict[str, Any] = {"region": box_of(given), "E": given.positive("E"), "nu": _poisson_ratio(given)}
        region["density"] = given.positive("density", density)
        given.finish()
        own = _law(kind, flow, region["E"], region["nu"], take.notes)
        regions.append(region if own == law else region | {"law": own})
    if kind == "sand":
        take.notes.append(
            "`material`: PhysGaussian uses the mean volume of all particles for sand; here each cell has its own."
        )
    return material | ({"regions": regions} if regions else {})


def _law(kind: str, flow: Mapping[str, float], E: float, nu: float, notes: list[str]) -> dict[str, Any] | None:
    """``material.law``; None for fixed corotated elasticity.

    PhysGaussian bounds ``|dev tau|`` by its yield stress, which grows by ``2 mu xi`` (with ``hardening`` = 1) and falls
    by ``softening`` times the plastic logarithmic strain. In terms of uniaxial tension the yield stress is
    ``sqrt(3/2)`` times and the growth 3/2 times as large.
    """
    stress = flow["yield_stress"]
    growth = 2 * E / (2 * (1 + nu)) * flow["xi"] if flow["hardening"] == 1 else 0.0
    if kind == "jelly":
        return None
    if kind == "sand":
        return part("Sand", friction_angle=flow["friction_angle"])
    if kind == "foam":
        notes.append(
            "`plastic_viscosity`: the overstress relaxes exactly here, but by one implicit step in PhysGaussian, where "
            "the shear modulus also grows with the stretch."
        )
        return part("Foam", yield_stress=stress, viscosity=flow["plastic_viscosity"])
    if kind == "snow":
        notes.append("`material`: PhysGaussian computes no stress for snow; here it is that of Stomakhin et al. 2013.")
        return part("Snow")
    if kind == "metal":
        if stress <= 0:
            raise ValueError(
                f"Expected `yield_stress` of metal to be positive, but got {stress:g}: without it nothing keeps its "
                "shape; set it, or use foam."
            )
        if growth < 0:
            raise ValueError(f"Expected `xi` of metal not to be negative, but got {flow['xi']:g}: use plasticine.")
    elif stress <= 0:
        notes.append("`yield_stress`: plasticine with zero never yields in PhysGaussian, so it is elastic here.")
        return None
    else:
        notes.append(
            "`material`: plasticine has Hencky's stress here and the fixed corotated one in PhysGaussian. There a "
            "particle loses all stress when its yield stress reaches zero; here it keeps its pressure."
        )
        growth -= flow["softening"]
        if growth <= 0:
            return part("Plasticine", yield_stress=_YIELD * stress, softening=-1.5 * growth)
    return part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)


def _poisson_ratio(take: Fields, *default: float) -> float:
    nu = take.number("nu", *default)
    if not 0 <= nu < 0.5:
        raise ValueError(
            f"Expected `nu` to be from 0 to below 0.5, but got {nu}: at 0.5 the stress is infinite, use 0.49."
        )
    return nu


# ---- boundary conditions

FOREVER = 999.0
"""A condition of PhysGaussian that ends at this time or later has no end here [s]."""

PADDING = 3
"""Margin of PhysGaussian's bounding box on each side of its grid [nodes]."""

RESET_SUBSTEPS = 15
"""Number of substeps after the end of a cuboid during which ``reset`` keeps all nodes at rest."""

_HOLDS = "holds the nodes that its particles touch; PhysGaussian only sets the velocities of the particles."


@dataclass(frozen=True)
class Turned:
    """The normalised space of a PhysGaussian configuration, as its boundaries need it.

    Args:
        turn: Rotation from turned to simulation axes, shape (3, 3).
        dx: Spacing of the grid.
        grid_lim: Its side.
        substep: PhysGaussian's substep [s].
        sticky: Whether all planes are sticky.
    """

    turn: Tensor
    dx: float
    grid_lim: float
    substep: float
    sticky: bool

    def vector(self, value: Sequence[float]) -> list[float]:
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
    take.notes.append(
        "`particle_impulse`: the total momentum is the same, but it is spread by mass; PhysGaussian gives each "
        "particle the same share, whatever its mass."
    )
    impulse = [round(f * seconds, 18) + 0.0 for f in space.vector(take.vector("force"))]
    region = box_of(take, CENTER)
    return [part("Impulse", region=region, impulse=impulse, start=start, end=start + seconds, per_particle=True)]


def _translation(take: Fields, space: Turned) -> list[dict[str, Any]]:
    velocity = space.vector(take.vector("velocity"))
    take.notes.append(f"`enforce_particle_translation`: {_HOLDS}")
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
    take.notes.append(f"`enforce_particle_velocity_rotation`: {_HOLDS}")
    moved: dict[str, Any] = {}
    if rate or speed:  # PhysGaussian turns clockwise about its normal
        moved = {"velocity": space.vector([speed * c for c in normal])}
        moved |= {"angular_velocity": space.vector([-rate * c for c in normal]), "pivot": list(point)}
    return [part("PinnedRegion", region=region, kind="nodes", **moved, **take.window())]


def _plane(take: Fields, space: Turned) -> list[dict[str, Any]]:
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
        take.notes.append(
            f"`surface` {surface!r} becomes separate, as in PhysGaussian, which treats unknown names like that."
        )
    if space.sticky and kind != "sticky":
        kind, friction = "sticky", 0.0
        take.notes.append(f"`surface`: the {surface} plane is sticky, as in PhysGaussian's code.")
    elif kind != "sticky":
        take.notes.append(f"`surface`: the plane is {kind} here; PhysGaussian's code makes every plane sticky.")
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
    take.whole("num_layers")
    take.notes.append(
        "`release_particles_sequentially`: a continuous front between the two positions. PhysGaussian has 50 "
        f"layers, whatever `num_layers` says, and as many mirrored beyond `end_position`. Here it {_HOLDS}"
    )

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


# ---- cameras


@dataclass(eq=False)
class PhysGaussianCamera(PinholePath):
    """Camera of a PhysGaussian configuration: a camera of the model, or one on a sphere that looks at a point.

    Azimuth is defined as in PhysGaussian: from the horizontal part of (1, 1, 1), or of (0.72, 0.37, -0.67) if (1, 1, 1)
    is nearly perpendicular to ``up``, and clockwise about ``up`` as seen from above.

    Args:
        cameras: ``cameras.json`` of the model, for the lens and for ``index``; without it ``fov_y`` and the size are
            used.
        index: Index of the camera, from 0; -1 for the sphere.
        azimuth: Angle about ``up`` in the first moving frame [degrees].
        elevation: Angle above the horizontal plane [degrees].
        radius: Distance [scene units].
        delta_azimuth: Change per frame [degrees].
        delta_elevation: Change per frame [degrees].
        delta_radius: Change per frame [scene units].
        viewpoint: Target point, in the normalised space of ``normalisation``; in scene units without it.
        up: Direction seen upwards, in the same space.
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].

    Raises:
        ValueError: If a number is out of range; at the first frame, if the file is bad.
    """

    cameras: str | os.PathLike[str] | None = None
    index: int = -1
    _: KW_ONLY
    azimuth: float = 0.0
    elevation: float = 0.0
    radius: float = 2.0
    delta_azimuth: float = 0.0
    delta_elevation: float = 0.0
    delta_radius: float = 0.0
    viewpoint: Sequence[float] = (1.0, 1.0, 1.0)
    up: Sequence[float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("radius", self.radius)
        if self.index >= 0 and self.cameras is None:
            raise ValueError(f"Camera {self.index} is a camera of the model: set `cameras` to its `cameras.json`.")
        self.viewpoint, self.up = check_vector("viewpoint", self.viewpoint), check_vector("up", self.up)
        if not any(self.up):
            raise ValueError("Expected `up` to be a direction, but got zero.")
        self.frame: SimFrame | None = None
        self._model: Camera | None = None

    def in_space(self, frame: SimFrame) -> PhysGaussianCamera:
        return changed(self, frame=frame)

    def eye(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Position, target and up of the sphere's camera in a frame: scene units, shape (3,), float64."""
        moved = max(frame - 1, 0)  # the first frame here is at rest, and PhysGaussian does not draw it
        azimuth = math.radians(self.azimuth + moved * self.delta_azimuth)
        elevation = math.radians(self.elevation + moved * self.delta_elevation)
        radius = self.radius + moved * self.delta_radius
        check_positive("radius", radius)
        target, up = (torch.tensor(v, dtype=torch.float64) for v in (self.viewpoint, self.up))
        if self.frame is not None:
            target, up = self.frame.point_to_sim(target), self.frame.direction_to_sim(up)
        up = up / up.norm()
        ahead = torch.ones(3, dtype=torch.float64)
        if abs(float(ahead @ up)) < 0.01:
            ahead = torch.tensor([0.72, 0.37, -0.67], dtype=torch.float64)
        ahead = ahead - (ahead @ up) * up
        ahead = ahead / ahead.norm()
        aside = torch.linalg.cross(ahead, up)
        level = math.cos(azimuth) * ahead + math.sin(azimuth) * aside
        return target + radius * (math.cos(elevation) * level + math.sin(elevation) * up), target, up

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        if self._model is None and self.cameras is not None:
            self._model = read_model_camera(self.cameras, max(self.index, 0), NEAR * size)
        if self._model is not None and self.index >= 0:
            return self._model.to(center.device, center.dtype)
        width, height = (self.width, self.height) if self._model is None else (self._model.width, self._model.height)
        camera = look_at_camera(*self.eye(frame), self.fov_y, width, height, dtype=torch.float64)
        if self._model is not None:
            camera = replace(camera, intrinsics=self._model.intrinsics)
        return camera.to(center.device, center.dtype)


def read_model_camera(path: str | os.PathLike[str], index: int, near: float = 0.01) -> Camera:
    """Read a camera from the ``cameras.json`` of a 3DGS model.

    Args:
        path: The file: a list of cameras with ``position``, ``rotation`` (camera to world, OpenCV axes), ``fx``, ``fy``
            [pixels], ``width`` and ``height``.
        index: Index of the camera, from 0.
        near: Near plane [scene units]; a hundredth of the distance or of the object's size when None.

    Returns:
        The camera in float64; the principal point is the image's centre.
    """
    entries = read_json(path, "camera file")
    if not isinstance(entries, list) or not 0 <= index < len(entries):
        count = len(entries) if isinstance(entries, list) else 0
        raise ValueError(f"The camera file `{path}` has {count} cameras, and none with the index {index}.")
    try:
        entry = entries[index]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(entry["rotation"], dtype=torch.float64)
        pose[:3, 3] = torch.tensor(entry["position"], dtype=torch.float64)
        width, height = int(entry["width"]), int(entry["height"])
        rows = [[float(entry["fx"]), 0.0, 0.5 * width], [0.0, float(entry["fy"]), 0.5 * height], [0.0, 0.0, 1.0]]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"The camera {index} of `{path}` is not one of 3DGS ({error}): it needs position, rotation, fx, fy, width "
            "and height."
        ) from error
    return Camera(torch.linalg.inv(pose), torch.tensor(rows, dtype=torch.float64), width, height, near)


# ---- the whole configuration


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a PhysGaussian configuration; ValueError if it is missing or not a JSON object."""
    config = read_json(path, "PhysGaussian configuration")
    if not isinstance(config, dict):
        raise ValueError(f"The PhysGaussian configuration `{path}` is not a JSON object: use one of its config/*.json.")
    return config


def convert(
    config: Mapping[str, Any], cameras: str | None = None, sticky_planes: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Settings of a simulation for a PhysGaussian configuration.

    Numbers stay as in the file: boxes and planes are in the normalised space (``normalisation``), which is mapped
    to the scene once its splat is known. Vectors are rotated with :func:`heading`.

    Args:
        cameras: ``cameras.json`` of the 3DGS model, for ``default_camera_index`` and the lens.

    Returns:
        The settings, without a splat (``scene.ply`` must be set), and sentences about everything whose meaning differs.
    """
    notes: list[str] = []
    take = Fields(config, "PhysGaussian's configuration", notes)
    degrees, axes = take.list("rotation_degree"), take.list("rotation_axis")
    degrees = list(check_vector("rotation_degree", degrees, len(degrees)))
    rotation, scale = rotation_matrix(degrees, axes), take.positive("scale", 1.0)
    turn, grid_lim, n_grid = heading(rotation), take.positive("grid_lim", 2.0), take.whole("n_grid", 50)
    substep, frame_dt = take.positive("substep_dt", 1e-4), take.positive("frame_dt", 1e-2)
    frames = check_frames("frame_num", take.whole("frame_num", 100))
    notes.append(
        f"`substep_dt`: the substep is adaptive instead of {substep:g} s, which is only used for damping and impulses; "
        f"--solver.substep {substep:g} fixes it, and is refused unless it is stable."
    )
    scene: dict[str, Any] = {"ply": None, "up": tidy(rotation[2])}  # with which z up is the z axis of the turned axes
    scene |= {"opacity_threshold": take.number("opacity_threshold", 0.02), "faint": "drop"}
    area, filling = take.get("sim_area", None), take.get("particle_filling", None)
    if area is not None:
        bounds = check_vector("sim_area", area, 6)
        scene["region"] = box(bounds[0::2], bounds[1::2])
    if filling is not None:
        scene["filling"] = filling_settings(Fields(filling, "particle_filling", notes), n_grid, grid_lim)
    material = material_settings(take)
    space = Turned(turn, grid_lim / n_grid, grid_lim, substep, sticky_planes)
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
    camera = camera_settings(take, cameras)
    take.finish()
    notes.append(
        "PhysGaussian has no wind: the coefficients of `aero` are zero; for wind set `wind.flow` and C_D, C_F and C_L."
    )
    settings = {
        "frames": frames + 1,
        "frame_dt": frame_dt,
        "normalisation": {"rotation_degree": degrees, "rotation_axis": axes, "scale": scale},
        "scene": scene,
        "material": material,
        "solver": solver,
        "wind": {"flow": [0.0, 0.0, 0.0]},
        "aero": {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0},
        "camera": camera,
    }
    return settings, list(dict.fromkeys(notes))


def _damping(take: Fields, substep: float) -> float:
    """Decay rate [1/s] of the factor by which velocities are multiplied every substep."""
    rpic, pic = take.number("rpic_damping", 0.0), take.number("pic_damping", 0.0)
    if rpic != 0:
        take.notes.append(
            f"`rpic_damping` {rpic:g} is not supported: the transfer is APIC; for damping use --solver.damping and "
            "--solver.stiffness_damping."
        )
    if pic != 0:
        take.notes.append("`pic_damping` has no effect in PhysGaussian or here.")
    factor = take.positive("grid_v_damping_scale", 1.1)
    return 0.0 if factor >= 1 else -math.log(factor) / substep


_FILLING_NOTES = {
    "density_threshold": "has another definition here, so `scene.filling.threshold` keeps its default.",
    "search_threshold": "is not needed: cells are enclosed by the vote of 26 rays (`scene.filling.votes`).",
    "search_exclude_direction": "is not supported: rays go in all directions, and an open side is outvoted.",
    "ray_cast_direction": "is not supported: all rays count crossings, not one.",
    "max_particles_num": "is not supported: the number of points follows from the volume.",
    "boundary": "is not supported: everything enclosed is filled, within `scene.region`.",
    "smooth": "is not supported: the density is blurred by half a cell.",
    "visualize": "is not supported: filled points are never drawn.",
}


def filling_settings(take: Fields, n_grid: int, grid_lim: float) -> dict[str, Any]:
    """``scene.filling`` for PhysGaussian's particle filling: another method, on a grid with the same spacing."""
    spacing = grid_lim / take.whole("n_grid", 4 * n_grid)
    wanted = take.whole("max_partciels_per_cell", 1)
    count = next((n for n in (1, 8) if wanted <= n), 27)
    if count != wanted:
        take.notes.append(f"`particle_filling.max_partciels_per_cell` {wanted} becomes {count}: a cell has 1, 8 or 27.")
    for name, sentence in _FILLING_NOTES.items():
        if take.get(name, None) not in (None, False):
            take.notes.append(f"`particle_filling.{name}` {sentence}")
    take.finish()
    return {"spacing": spacing, "particles_per_cell": count}


def camera_settings(take: Fields, cameras: str | None) -> dict[str, Any]:
    """``camera``: a camera of the model, the moving camera, or our orbit camera if the file of cameras is missing."""
    seen = {"viewpoint": list(take.vector("mpm_space_viewpoint_center", CENTER))}
    seen["up"] = list(take.vector("mpm_space_vertical_upward_axis", (0.0, 0.0, 1.0)))
    index, moves = take.whole("default_camera_index", 0, least=-1), take.flag("move_camera")
    keys = {"azimuth": "init_azimuthm", "elevation": "init_elevation", "radius": "init_radius"}
    deltas = {"delta_azimuth": "delta_a", "delta_elevation": "delta_e", "delta_radius": "delta_r"}
    given = {name: take.get(key, None) for name, key in (keys | deltas).items()}
    if take.flag("show_hint"):
        take.notes.append("`show_hint` has no effect: PhysGaussian prints the camera's angles and stops.")
    orbit = "gaussian_swaying.interop.physgaussian.PhysGaussianCamera"
    if index >= 0 and cameras is None:
        take.notes.append(
            f"`default_camera_index` {index} is a camera of the 3DGS model, whose cameras.json was not given, so it is "
            f"an orbit here; --camera {orbit} --camera.cameras PATH --camera.index {index} uses the model's."
        )
        return part("OrbitCamera", width=960, height=540)
    if index >= 0:
        return part(orbit, cameras=cameras, index=index)
    for name, key in (keys | deltas if moves else keys).items():
        if given[name] is None:
            raise ValueError(f"The key `{key}` is missing, but `default_camera_index` -1 needs it.")
        given[name] = take.number(key)
    if cameras is None:
        take.notes.append(
            "`default_camera_index` -1: PhysGaussian takes lens and size of the picture from the model's cameras.json; "
            "here they are those of `camera`."
        )
    still = {} if moves else dict.fromkeys(deltas, 0.0)
    return part(orbit, cameras=cameras, **given | still, **seen)


def to_yaml(settings: Mapping[str, Any], notes: Iterable[str] = (), source: str | None = None) -> str:
    """Settings as a YAML file for ``--config``, with the notes as comments at the top."""
    import textwrap

    import yaml

    head = [f"PhysGaussian's {source or 'configuration'}, converted. Give the splat with --scene.ply PATH.", *notes]
    width = {"width": 118, "break_long_words": False, "break_on_hyphens": False}
    lines = [
        line
        for text in head
        for line in textwrap.wrap(text, initial_indent="# ", subsequent_indent="#   ", **width)  # type: ignore[arg-type]
    ]
    plain = json.loads(json.dumps(settings))  # copies, since YAML would write repeated parts as references
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return "\n".join(lines) + "\n" + body
