"""PhysGaussian's JSON configurations as settings of this package, and the normalised space that their boxes are in.

See ``docs/physgaussian.md`` for what each key becomes and what it means there and here.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.mpm.boundary import Boundary, RegionInFrame
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.rendering.camera import Camera, CameraPath, look_at_camera, rotation_from_z
from gaussian_swaying.simulation.frame import SimFrame
from gaussian_swaying.simulation.scene import Material, Scene

CENTER = (1.0, 1.0, 1.0)
"""Where the simulated part is centred in the normalised space."""

FOREVER = 999.0
"""End from which a condition of PhysGaussian is taken to last for ever [s]."""

PADDING = 3
"""Nodes that a bounding box of PhysGaussian keeps to at each side of its grid."""

RESET_SUBSTEPS = 15
"""Substeps for which ``reset`` of a cuboid keeps all nodes at rest after the end of the cuboid."""

_YIELD = math.sqrt(1.5)  # from a bound on |dev tau| to the yield stress in uniaxial tension


# ---- the normalised space


def rotation_matrix(degrees: Sequence[float], axes: Sequence[int]) -> Tensor:
    """Rotation by each angle about its axis, one after the other.

    Args:
        degrees: Angles [degrees].
        axes: 0, 1 or 2 for x, y or z, as many as angles.

    Returns:
        Scene axes to turned axes in float64, shape (3, 3).

    Raises:
        ValueError: If there are not as many axes as angles, or an axis is none of 0, 1 and 2.
    """
    if len(degrees) != len(axes):
        raise ValueError(
            f"Expected as many entries of `rotation_degree` as of `rotation_axis`, but got {len(degrees)} and "
            f"{len(axes)}."
        )
    total = torch.eye(3, dtype=torch.float64)
    for angle, axis in zip(check_vector("rotation_degree", degrees, len(degrees)), axes, strict=True):
        if axis not in (0, 1, 2):
            raise ValueError(f"Expected `rotation_axis` to hold 0, 1 or 2 for x, y or z, but got {axis!r}.")
        i, j = ((1, 2), (2, 0), (0, 1))[int(axis)]
        quarters, rest = divmod(angle, 90.0)
        cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        if rest == 0:  # without round-off
            cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
        turn = torch.eye(3, dtype=torch.float64)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = cosine, -sine, sine, cosine
        total = turn @ total
    return total


def up_direction(rotation: Tensor) -> list[float]:
    """``scene.up`` whose z-up frame has the z axis of the turned axes; scene axes to turned ones (3, 3)."""
    return _tidy(rotation[2])


def heading(rotation: Tensor) -> Tensor:
    """Turned axes to the axes of the simulation, which may differ by a turn about z; shape (3, 3), float64."""
    return rotation_from_z(up_direction(rotation)).T @ rotation.T


@dataclass
class Normalisation:
    """PhysGaussian's normalised space, in which boundaries and regions of the material are then given.

    The scene is turned, and the simulated part scaled and centred at (1, 1, 1). A region of the scene itself is given
    in turned axes, but in the scene's units. The unit of the normalised space is a metre.

    Args:
        rotation_degree: Angles by which the scene is turned, one after the other [degrees].
        rotation_axis: Axis of each: 0, 1 or 2 for x, y or z.
        scale: Longest side of the simulated part along the turned axes [m].
    """

    rotation_degree: list[float] = field(default_factory=list)
    rotation_axis: list[int] = field(default_factory=list)
    scale: float = 1.0

    def __post_init__(self) -> None:
        check_positive("normalisation.scale", self.scale)
        rotation_matrix(self.rotation_degree, self.rotation_axis)

    @property
    def rotation(self) -> Tensor:
        """Scene axes to turned axes, shape (3, 3), float64."""
        return rotation_matrix(self.rotation_degree, self.rotation_axis)

    def fit(self, points: Tensor) -> SimFrame:
        """From the normalised space to a scene.

        Args:
            points: Points of the simulated part in scene units, shape (N, 3).

        Returns:
            A frame whose ``point_to_sim`` takes points of the normalised space to scene units, and whose
            ``point_to_scene`` takes them back.

        Raises:
            ValueError: If the points have no extent.
        """
        rotation = self.rotation
        turned = points.detach().cpu().double() @ rotation.T
        low, high = turned.amin(0), turned.amax(0)
        extent = float((high - low).amax())
        if extent <= 0:
            raise ValueError("The simulated part has no extent that `normalisation` could scale.")
        scale = self.scale / extent
        origin = torch.tensor(CENTER, dtype=torch.float64) - scale * 0.5 * (low + high)
        return SimFrame(origin, rotation.T.contiguous(), 1 / scale)

    def place(self, scene: Scene, material: Material, solver: MPMSolver, camera: CameraPath | None = None) -> SimFrame:
        """Bring regions, boundaries and camera to scene units, and give the scene its scale.

        Args:
            scene: Its region gets scene axes, and ``metres_per_unit`` is set; the splat is read.
            material: Its regions get scene units.
            solver: Its boundaries get scene units.
            camera: A :class:`PhysGaussianCamera` gets scene units; any other is left alone.

        Returns:
            The frame of :meth:`fit`.

        Raises:
            ValueError: If the scene has a scale of its own, or nothing is simulated.
        """
        if scene.longest_side is not None or scene.metres_per_unit is not None:
            raise ValueError(
                "`normalisation` sets the scale of the scene: leave out `scene.longest_side` and "
                "`scene.metres_per_unit`, or `normalisation`."
            )
        turned = SimFrame(torch.zeros(3, dtype=torch.float64), self.rotation.T.contiguous(), 1.0)
        scene.region = RegionInFrame(scene.region, turned)
        cloud = scene.cloud()
        chosen = select_simulated(cloud.means, torch.sigmoid(cloud.opacities), scene.region, scene.opacity_threshold)
        frame = self.fit(cloud.means[chosen])
        scene.metres_per_unit = 1 / frame.metres_per_unit
        material.regions = [
            dataclasses.replace(entry, region=RegionInFrame(entry.region, frame)) for entry in material.regions
        ]
        conditions = [b for b in solver.boundaries if isinstance(b, Boundary)]
        solver.boundaries = nn.ModuleList([b.in_frame(frame) for b in conditions])
        if isinstance(camera, PhysGaussianCamera):
            camera.frame = frame
        return frame


class PhysGaussianCamera(CameraPath):
    """Camera of a PhysGaussian configuration: one of its model's, or one that looks at a point from a sphere.

    Azimuth is counted as in PhysGaussian: from the horizontal part of (1, 1, 1) [of (0.72, 0.37, -0.67) if that is
    nearly across ``up``], clockwise about ``up`` as seen from above.

    Args:
        cameras: ``cameras.json`` of the model, for the lens and for ``index``; without it ``fov_y`` and the size count.
        index: Which of its cameras, from 0; -1 for the sphere.
        azimuth: Angle about ``up`` in the first moving frame [degrees].
        elevation: Angle above the horizontal plane [degrees].
        radius: Distance [scene units].
        delta_azimuth: Change per frame [degrees].
        delta_elevation: Change per frame [degrees].
        delta_radius: Change per frame [scene units].
        viewpoint: Point looked at, in the normalised space of ``normalisation``; in scene units if there is none.
        up: Direction seen upwards, likewise.
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
        near: Near plane [scene units].

    Raises:
        ValueError: If a number is out of range; at the first frame, if the file is bad.
    """

    def __init__(
        self,
        cameras: str | os.PathLike[str] | None = None,
        index: int = -1,
        azimuth: float = 0.0,
        elevation: float = 0.0,
        radius: float = 2.0,
        delta_azimuth: float = 0.0,
        delta_elevation: float = 0.0,
        delta_radius: float = 0.0,
        viewpoint: Sequence[float] = CENTER,
        up: Sequence[float] = (0.0, 0.0, 1.0),
        width: int = 960,
        height: int = 540,
        fov_y: float = 40.0,
        near: float = 0.01,
    ) -> None:
        check_positive("radius", radius)
        if index >= 0 and cameras is None:
            raise ValueError(f"The camera {index} is one of the model's: give its `cameras.json` as `cameras`.")
        self.cameras, self.index, self.radius = cameras, int(index), float(radius)
        self.azimuth, self.elevation = float(azimuth), float(elevation)
        self.delta = (float(delta_azimuth), float(delta_elevation), float(delta_radius))
        self.viewpoint, self.up = check_vector("viewpoint", viewpoint), check_vector("up", up)
        if not any(self.up):
            raise ValueError("Expected `up` to be a direction, but got zero.")
        check_positive("near", near)
        self.width, self.height, self.fov_y, self.near = width, height, float(fov_y), float(near)
        self.frame: SimFrame | None = None
        self._model: Camera | None = None

    def eye(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Where the sphere's camera stands in a frame, what it looks at, and up: scene units, shape (3,), float64."""
        moved = max(frame - 1, 0)  # the first frame here is the rest, which PhysGaussian does not draw
        azimuth = math.radians(self.azimuth + moved * self.delta[0])
        elevation = math.radians(self.elevation + moved * self.delta[1])
        radius = self.radius + moved * self.delta[2]
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
            self._model = read_model_camera(self.cameras, max(self.index, 0), self.near)
        if self._model is not None and self.index >= 0:
            return self._model.to(center.device, center.dtype)
        width, height = (self.width, self.height) if self._model is None else (self._model.width, self._model.height)
        camera = look_at_camera(*self.eye(frame), self.fov_y, width, height, self.near, dtype=torch.float64)
        if self._model is not None:
            camera = dataclasses.replace(camera, intrinsics=self._model.intrinsics)
        return camera.to(center.device, center.dtype)


def read_model_camera(path: str | os.PathLike[str], index: int, near: float = 0.01) -> Camera:
    """Read a camera of the ``cameras.json`` that 3DGS keeps beside its model.

    Args:
        path: The file: a list of cameras with ``position``, ``rotation`` (camera to world, OpenCV axes), ``fx``, ``fy``
            [pixels], ``width`` and ``height``.
        index: Which of them, from 0.
        near: Near plane [scene units].

    Returns:
        The camera in float64; the principal point is the image's centre.

    Raises:
        ValueError: If the file cannot be read, has no such camera, or the camera lacks a field.
    """
    entries = _read_json(path, "camera file")
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


# ---- the configuration


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a PhysGaussian configuration; ValueError if it is missing or no JSON object."""
    config = _read_json(path, "PhysGaussian configuration")
    if not isinstance(config, dict):
        raise ValueError(f"The PhysGaussian configuration `{path}` is no JSON object: give one of its config/*.json.")
    return config


def _read_json(path: str | os.PathLike[str], what: str) -> Any:
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"Cannot read the {what} `{path}` ({error.strerror}): check the path.") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"The {what} `{path}` is not valid JSON ({error}).") from error


def convert(
    config: Mapping[str, Any], cameras: str | None = None, sticky_planes: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Settings of ``tools/sim.py`` for a PhysGaussian configuration.

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
    """Settings as a YAML file for ``tools/sim.py --config``, with the notes as comments at its head.

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
        return _tidy(self.turn @ torch.tensor(value, dtype=torch.float64))


def _tidy(vector: Tensor) -> list[float]:
    """Numbers without the round-off of a rotation, and without -0."""
    return [round(v, 12) + 0.0 for v in vector.tolist()]


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
    return _tidy(turn @ torch.tensor(check_vector("g", value), dtype=torch.float64))


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
    orbit = "gaussian_swaying.simulation.physgaussian.PhysGaussianCamera"
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


__all__ = [
    "Normalisation",
    "PhysGaussianCamera",
    "convert",
    "heading",
    "read_config",
    "read_model_camera",
    "rotation_matrix",
    "to_yaml",
    "up_direction",
]
