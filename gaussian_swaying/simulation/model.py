"""The numbers of a simulation, those that may change, edits, and the short forms that its constructor accepts."""

from __future__ import annotations

import copy
import dataclasses
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from gaussian_swaying._checks import (
    VectorLike,
    check_choice,
    check_plain,
    check_positive,
    check_vector,
    check_whole,
    number_of,
)
from gaussian_swaying._fixed import FixedList, changed, fixed
from gaussian_swaying._live import SIZE, Live, live_numbers
from gaussian_swaying.captures.capture_camera import CaptureCamera, photo_azimuth, read_views
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.hold import end_region, guess_hold
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.regions import Region, RegionInFrame
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.rendering.cameras.camera import azimuth_beside
from gaussian_swaying.rendering.cameras.camera_path import CameraPath, OrbitCamera
from gaussian_swaying.scenes.procedural import GivenScene, ProceduralScene
from gaussian_swaying.simulation.body import PLATE, Material, Scene, SimulatedScene, suggest_spacing
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.field import Modulation, SpatialWind, WindField, angles_of, flow_of, flow_rows
from gaussian_swaying.wind.force import AeroForce
from gaussian_swaying.wind.turbulence import LOOKS, look

if TYPE_CHECKING:
    from jsonargparse import Namespace

POLAR = ("wind.speed", "wind.azimuth", "wind.elevation")
"""Three numbers that together are ``wind.flow``."""


def _with_numbers() -> list[type]:
    """All kinds of components whose numbers may change, those of a user's own too."""
    found: list[type] = [WindField, Modulation, Material, AeroForce, MPMSolver, Model, Force]
    for kind in found:
        found += kind.__subclasses__() if issubclass(kind, Modulation | Force) else []
    return found


def _all() -> dict[str, Live]:
    return {
        f"{kind.live_as.replace('forces.*', f'forces.{kind.__name__}')}.{name}".lstrip("."): value  # type: ignore[attr-defined]
        for kind in _with_numbers()
        for name, value in kind.live.items()  # type: ignore[attr-defined]
    }


def names() -> list[str]:
    """Names of all numbers that may change; ``*`` stands for the index of a modulation."""
    return list(_all())


def find(name: str) -> Live | None:
    """The number with a name, or None. ``wind.modulations.0.FIELD`` is a number of a modulation."""
    parts = name.split(".")
    if parts[:2] == ["wind", "modulations"] and len(parts) == 4 and parts[2].isdecimal():
        return _all().get(f"wind.modulations.*.{parts[3]}", Live(batched=True))
    return _all().get(name)


def number(name: str) -> Live:
    """The number with a name.

    Raises:
        ValueError: If there is none; the message lists the names.
    """
    found = find(name)
    if found is None:
        raise ValueError(f"`{name}` is no number that may change: use one of {', '.join(names())}.")
    return found


@fixed
@dataclass(frozen=True, eq=False)
class Model:
    """All that decides how a scene moves. Never changed in place: another value makes another model.

    Attributes:
        scene: The scene at rest, with the material of its points.
        material: The material that was given.
        aero: The force of the wind on patches.
        solver: Numbers of the solver.
        method: The solver that was given, without a material: formulation, pins and obstacles.
        air: The box of computed air; None if the wind is given everywhere.
        frame_dt: Time between frames [s].
        shared: What ``step`` and ``draw`` keep of this model and of those that are made from it.
    """

    live_as, live = "", live_numbers(frame_dt=SIZE)

    scene: SimulatedScene
    material: Material
    wind: WindField | SpatialWind
    aero: AeroForce
    forces: tuple[Force, ...]
    solver: Any
    method: Solver
    air: ComputedAir | None = None
    frame_dt: float = 0.04
    shared: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def points(self) -> MaterialPoints:
        """The material of the points."""
        return self.scene.points

    def replace(self, *, points: MaterialPoints | None = None, **parts: Any) -> Model:
        """A model with other parts; ``points`` are those of its scene."""
        scene = parts.pop("scene", self.scene)
        return replace(self, scene=scene if points is None else changed(scene, points=points), **parts)

    def at(self, name: str | Mapping[str, Any], value: Any = None) -> Model:
        """A model with another value of a number, ``model.at("material.E", 2e5)``, or of several by their names.

        Tensors keep their gradient where the number is differentiable.
        """
        given = {name: value} if isinstance(name, str) else name
        values = {name: number(name).check(name, value) for name, value in given.items()}
        angles = {name: values.pop(name) for name in POLAR if name in values}
        material = {name[9:]: values.pop(name) for name in list(values) if name.startswith("material.")}
        found = _with_material(self, material) if material else self
        for name, value in values.items():
            found = found._with(name, value)
        if angles:
            base = found._flow(next(iter(angles))).tolist()
            if not any(base) and len(angles) < 2:
                raise ValueError("The base has no `wind.flow`: give one, or seek `wind.speed` and `wind.azimuth`.")
            found = found._with("wind.flow", flow_of(base, angles))
        return found

    def value(self, name: str) -> Any:
        """The value of a number; ValueError if there is none."""
        number(name)
        if name == "wind.flow" or name in POLAR:
            flow = self._flow(name).tolist()
            return flow if name == "wind.flow" else angles_of(flow)[POLAR.index(name)]
        if name == "material.thickness":
            _check_one_layer(self)
        found = getattr(self._owner(name), name.rpartition(".")[2], None)
        if not isinstance(found, int | float | tuple | Tensor):
            raise ValueError(f"There is no `{name}`: add the modulation or the force that has it.")
        return list(found) if isinstance(found, tuple) else number_of(found)

    def numbers(self, start: str = "") -> list[str]:
        """The names of its numbers that begin with a prefix."""
        found = []
        for name in names():
            if name.startswith(start) and "*" not in name:
                with suppress(ValueError):
                    self.value(name)
                    found.append(name)
        return found

    def _owner(self, name: str) -> Any:
        head, *path = name.split(".")[:-1] or [""]
        if head == "forces":
            return next((force for force in self.forces if type(force).__name__ == path[0]), None)
        if head == "wind":
            wind = self._uniform_wind()
            return next(iter(wind.modulations[int(path[1]) :]), None) if path else wind
        return getattr(self, head) if head else self

    def _with(self, name: str, value: Any) -> Model:
        head, last = name.split(".")[0], name.rpartition(".")[2]
        if name == "wind.flow":
            return replace(self, wind=self._uniform_wind().with_flow(value))
        self.value(name)  # it is there
        owner = self._owner(name)
        if is_dataclass(owner):
            new: Any = replace(owner, **{last: tuple(value) if isinstance(value, list) else value})  # type: ignore[type-var]
            return new if owner is self else replace(self, **{head: new})
        new = changed(owner, **{last: value})
        if head == "forces":
            new = tuple(new if force is owner else force for force in self.forces)
        elif owner is not getattr(self, head):
            rest = FixedList(new if one is owner else one for one in self._uniform_wind().modulations)
            new = changed(self.wind, modulations=rest)
        return replace(self, **{head: new})

    def _uniform_wind(self) -> WindField:
        if not isinstance(self.wind, WindField):
            raise ValueError("Expected `wind` to be a WindField: a custom wind has no numbers that could be changed.")
        return self.wind

    def _flow(self, name: str) -> Tensor:
        flow = self._uniform_wind().flow
        if flow is None:
            raise ValueError(f"`wind.schedule` gives the flow: remove it, or do not change `{name}`.")
        return flow


def _with_material(model: Model, numbers: Mapping[str, Any]) -> Model:
    points, material = model.points, model.material
    bends = material.bending is not None or any(part.bending is not None for part in material.regions)
    for name in numbers:
        if any(getattr(part, name) is not None for part in (*material.regions, model.scene.field) if part is not None):
            raise ValueError(
                f"`material.{name}` is to change, but `material.regions`, `scene.parts` or `scene.materials` gives it "
                "too: remove it there."
            )
        if bends and points.bending is None and name in ("E", "nu"):
            raise ValueError(
                f"`material.{name}` is to change, but with `material.bending` it says where the layers lie: make "
                "another simulation, or leave `material.bending` out."
            )
    ratio: Any = 1.0
    if "thickness" in numbers:
        _check_one_layer(model)
        ratio = numbers["thickness"] / number_of(material.thickness)
        points = replace(points, mass=points.mass * ratio, volume=points.volume * ratio)
    if points.bending is not None and material.bending == PLATE:  # Kirchhoff's D
        stiffer = ratio**3
        if "E" in numbers:
            stiffer = stiffer * numbers["E"] / points.youngs_modulus
        if "nu" in numbers:
            stiffer = stiffer * (1 - points.poisson_ratio.square()) / (1 - numbers["nu"] ** 2)
        points = replace(points, bending=points.bending * stiffer)
    for name, own in (("E", "youngs_modulus"), ("nu", "poisson_ratio")):
        if name in numbers:  # a sum keeps a gradient
            points = replace(points, **{own: torch.zeros_like(getattr(points, own)) + numbers[name]})
    if "density" in numbers:
        points = replace(points, mass=points.volume * numbers["density"])
    return model.replace(points=points, material=replace(material, **numbers))


def _check_one_layer(model: Model) -> None:
    scene = model.scene
    if model.material.volume != "patch" or scene.filled or model.points.count != scene.on_surface + scene.filled:
        raise ValueError(
            "`material.thickness` can be changed only of a sheet of one layer (`scene.layers: 1`): change `material.E` "
            "and `material.density` instead."
        )


def in_settings(settings: Namespace, values: Mapping[str, Any]) -> None:
    """Set numbers in parsed settings, which are changed."""
    angles = {}
    for name, value in values.items():
        value = number(name).check(name, value)
        if name in POLAR:
            angles[name] = value
            continue
        part, key = _place(settings, name)
        part[key] = value
        if name == "wind.flow":
            settings.wind.schedule = _without_flow(settings.wind.schedule)
    if angles:
        settings.wind.flow = flow_of(list(settings.wind.flow), angles)


def _without_flow(schedule: Any) -> list[Any] | None:
    kept = [key.clone() for key in schedule or () if not isinstance(schedule, str) and key.gusts is not None]
    for key in kept:
        key.flow = key.speed = key.azimuth = None
    return kept or None


def of_settings(settings: Namespace, name: str) -> Any:
    """A number from parsed settings."""
    if name in POLAR:
        return angles_of(settings.wind.flow)[POLAR.index(name)]
    part, key = _place(settings, name)
    return part[key]


def _place(settings: Namespace, name: str) -> tuple[Any, str]:
    parts = name.split(".")
    if parts[0] == "forces":
        entry = next((one for one in settings.forces or () if one["class_path"].rsplit(".", 1)[-1] == parts[1]), None)
    elif parts[:2] == ["wind", "modulations"]:
        entry = next(iter((settings.wind.modulations or [])[int(parts[2]) :]), None)
    else:
        return settings, name
    if entry is None:
        raise ValueError(f"There is no `{name}`: add the modulation or the force that has it.")
    if entry.get("init_args") is None:
        entry["init_args"] = {}
    return entry["init_args"], parts[-1]


LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709


@fixed
@dataclass
class Edit:
    """A change to a part of the object.

    Deformations and velocities stay as they are; stresses follow the new material from then on. Where the law changes,
    its internal variable is reset. The thickness cannot be edited: the points of the material, their layers and the
    contact samples depend on it.

    Args:
        region: Region at rest, in scene units; it may also contain Gaussians that do not move. Everything that moves if
            null.
        time: Time [s]: the edit applies from the first frame at or after it. 0 means at load.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density at rest [kg/m³]; unchanged if null.
        law: Constitutive law; unchanged if null. A plastic law needs ``solver.formulation: updated``.
        color: Red, green and blue in [0, 1], the same from every direction; unchanged if null.
        detail: Fraction of the brightness differences within the region that the new colour keeps, in [0, 1].
    """

    region: Region | None = None
    time: float = 0.0
    _: KW_ONLY
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    law: ConstitutiveLaw | None = None
    color: list[float] | None = None
    detail: float = 0.0

    def __post_init__(self) -> None:
        check_positive("edits.time", self.time, allow_zero=True)
        for name in ("E", "nu", "density"):
            if getattr(self, name) is not None:
                check_plain(f"edits.{name}", getattr(self, name))
                number(f"material.{name}").check(f"edits.{name}", getattr(self, name))
        if self.color is not None and not all(0 <= part <= 1 for part in check_vector("edits.color", self.color)):
            raise ValueError(f"Expected `edits.color` to lie in [0, 1], but got {self.color}.")
        if not 0 <= self.detail <= 1:
            raise ValueError(f"Expected `edits.detail` to lie in [0, 1], but got {self.detail}.")
        if not self.of_material and self.color is None:
            raise ValueError("An entry of `edits` changes nothing: give `E`, `nu`, `density`, `law` or `color`.")

    @property
    def of_material(self) -> bool:
        """True if the edit changes more than the colour."""
        return any(value is not None for value in (self.E, self.nu, self.density, self.law))


def edited_points(points: MaterialPoints, inside: Tensor, edit: Edit, flowed: bool = False) -> MaterialPoints:
    """Apply an edit to the material.

    Args:
        points: The material of one scene, shapes (P, ·).
        inside: Which points are edited, bool, shape (P,).
        flowed: Whether the points have already moved. After plastic flow, the elastic and the total deformation differ
            for good. If no plastic law is left, one of the other laws is set to keep both, and the plastic law stays in
            the list without particles, because the kernels check the list.

    Returns:
        The material; laws that no point uses any more are left out.
    """

    def field(value: float | None, old: Tensor) -> Tensor:
        return old if value is None else torch.where(inside, value, old)

    before = torch.zeros_like(inside, dtype=torch.long) if points.law_index is None else points.law_index
    index, laws = before, list(points.laws)
    if edit.law is not None:
        index = torch.where(inside, len(laws), before)
        laws.append(edit.law)
    used = torch.unique(index).tolist()
    kept = [laws[k] for k in used]
    had_both = flowed and any(laws[k].plastic for k in torch.unique(before).tolist())
    if had_both and not any(type(law).plastic for law in kept):
        kept[0] = copy.deepcopy(kept[0])
        kept[0].plastic = True
        kept.append(next(law for law in laws if type(law).plastic))
    place = torch.zeros(len(laws), dtype=torch.long, device=index.device)
    place[used] = torch.arange(len(used), device=index.device)
    bending = points.bending
    if bending is not None and edit.E is not None:
        bending = torch.where(inside, bending * edit.E / points.youngs_modulus, bending)
    mass = points.mass if edit.density is None else torch.where(inside, edit.density * points.volume, points.mass)
    return dataclasses.replace(
        points,
        mass=mass,
        youngs_modulus=field(edit.E, points.youngs_modulus),
        bending=bending,
        poisson_ratio=field(edit.nu, points.poisson_ratio),
        laws=tuple(kept),
        law_index=place[index] if len(kept) > 1 else None,
    )


def recolored(sh: Tensor, inside: Tensor, color: Sequence[float], detail: float = 0.0) -> Tensor:
    """Give some Gaussians of a splat one colour.

    Args:
        sh: Coefficients, shape (N, K, 3).
        inside: Which Gaussians get the colour, bool, shape (N,).
        color: Red, green and blue in [0, 1].
        detail: Fraction of the brightness differences that is kept: the colour is multiplied by ``1 + detail (Y /
            mean(Y) - 1)`` with the luminance Y of the old colours.

    Returns:
        Shape (N, K, 3).
    """
    old = (sh[:, 0] * SH_DC + 0.5).clamp_min(0)
    luminance = (old * old.new_tensor(LUMINANCE)).sum(-1)
    mean = torch.where(inside, luminance, 0.0).sum() / inside.sum().clamp_min(1)
    factor = 1 + detail * (luminance / mean.clamp_min(1e-6) - 1)
    new = torch.zeros_like(sh)
    new[:, 0] = (factor[:, None] * old.new_tensor(list(color)) - 0.5) / SH_DC
    return torch.where(inside[:, None, None], new, sh)


@fixed
@dataclass
class Copy:
    """One copy of the object. By default it is the object itself, at its own place.

    Args:
        shift: Where it stands, from the place of the object [m]: z up, along the axes of the wind.
        turn: Angle about the vertical, counterclockwise from above [degrees]. The axis goes through the middle of what
            the pins hold, such as the foot of a plant; through the middle of the object if nothing is held.
        delay: Time by which the wind and its gusts come later than for the object [s].
        seed: Seed of its gusts. Null for gusts of its own, with the seed of the wind plus the number of the copy (from
            0 on); or with a ``delay`` for those of the wind, only later.
    """

    shift: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    turn: float = 0.0
    _: KW_ONLY
    delay: float = 0.0
    seed: int | None = None

    def __post_init__(self) -> None:
        self.shift = list(check_vector("copies.shift", self.shift))
        for name in ("turn", "delay"):
            check_vector(f"copies.{name}", [getattr(self, name)], 1)
        if self.seed is not None:
            check_whole("copies.seed", self.seed, 0)


CENTER = (1.0, 1.0, 1.0)
"""Centre of the simulated part in the normalised space."""


def rotation_matrix(degrees: Sequence[float], axes: Sequence[int]) -> Tensor:
    """Successive rotations by each angle about its axis.

    Args:
        degrees: Angles [degrees].
        axes: 0, 1 or 2 for x, y or z, as many as angles.

    Returns:
        Scene axes to turned axes in float64, shape (3, 3).
    """
    if len(degrees) != len(axes):
        raise ValueError(
            f"Expected as many entries in `rotation_degree` as in `rotation_axis`, but got {len(degrees)} and "
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


@fixed
@dataclass
class Normalisation:
    """PhysGaussian's normalised space. With it, boundaries and regions of the material are given in this space.

    The scene is rotated, and the simulated part scaled and centred at (1, 1, 1). The region of the scene is given in
    turned axes, but in scene units. The unit of the normalised space is a metre.

    Args:
        rotation_degree: Angles of successive rotations of the scene [degrees].
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
        """The map from the normalised space to a scene.

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
            raise ValueError("The simulated part has no extent for `normalisation` to scale.")
        scale = self.scale / extent
        origin = torch.tensor(CENTER, dtype=torch.float64) - scale * 0.5 * (low + high)
        return SimFrame(origin, rotation.T.contiguous(), 1 / scale)

    def place(
        self,
        scene: Scene,
        material: Material,
        solver: Solver,
        edits: Sequence[Edit] = (),
        cloud: GaussianCloud | None = None,
    ) -> tuple[Scene, Material, Solver, list[Edit]]:
        """Components in scene units, from those in the normalised space, which stay as they are.

        Args:
            cloud: The Gaussians of the scene, if they have been read already.

        Returns:
            Copies of the first four arguments, the scene with ``metres_per_unit`` set.
        """
        if scene.longest_side is not None or scene.metres_per_unit is not None:
            raise ValueError(
                "`normalisation` sets the scale of the scene: remove `scene.longest_side` and "
                "`scene.metres_per_unit`, or `normalisation`."
            )
        turned = SimFrame(torch.zeros(3, dtype=torch.float64), self.rotation.T.contiguous(), 1.0)
        scene = changed(scene, region=RegionInFrame(scene.region, turned))
        cloud = scene.cloud() if cloud is None else cloud
        frame = self.fit(cloud.means[scene.select(cloud)])
        scene = changed(scene, metres_per_unit=1 / frame.metres_per_unit)
        regions = [dataclasses.replace(e, region=RegionInFrame(e.region, frame)) for e in material.regions]
        conditions = [b.in_frame(frame) for b in solver.boundaries if isinstance(b, Boundary)]
        solver = changed(solver, boundaries=FixedList(conditions))
        material = dataclasses.replace(material, regions=regions)
        changes = [dataclasses.replace(e, region=e.region and RegionInFrame(e.region, frame)) for e in edits]
        return scene, material, solver, changes


if TYPE_CHECKING:
    SceneLike = Scene | ProceduralScene | GaussianCloud | str | os.PathLike[str]
    WindLike = WindField | SpatialWind | VectorLike | str
    DeviceLike = torch.device | str
    SolverLike = Solver
    MaterialLike = Material | str
else:  # what a YAML file can contain: the annotations of the constructor are its schema
    SceneLike, WindLike, DeviceLike = Scene, WindField, Literal["auto", "cpu", "cuda"]
    SolverLike, MaterialLike = MPMSolver, Material

HoldLike = Region | PinnedRegion | PinnedPoints | list[Region | PinnedRegion | PinnedPoints] | str
CELLS = 32
"""Largest number of grid cells along the longest side if no solver is given."""


def resolve_device(device: DeviceLike) -> torch.device:
    """The device of a name: ``auto`` (a CUDA GPU if there is one, else the CPU), ``cpu`` or ``cuda``."""
    if isinstance(device, torch.device):
        return device
    if device != "auto" and not device.startswith("cuda"):
        return torch.device(device)
    if torch.cuda.is_available():
        return torch.device("cuda" if device == "auto" else device)
    if device != "auto":
        raise ValueError(
            "`--device cuda` needs a CUDA GPU and a CUDA build of torch, but found none: use --device auto or cpu."
        )
    return torch.device("cpu")


def as_scene(source: SceneLike, up: Sequence[float] | None = None) -> Scene:
    """Make a scene from settings, a file, Gaussians or a scene made in code.

    Args:
        up: Direction that points up in it; z if None.

    Returns:
        A :class:`Scene` as it is. Anything else is simulated as a whole.
    """
    if isinstance(source, Scene):
        if up is not None:
            raise ValueError("`up` belongs to the scene: write Scene(..., up=...), and leave out the separate `up`.")
        return source
    direction = [0.0, 0.0, 1.0] if up is None else list(check_vector("up", up))
    if isinstance(source, ProceduralScene | GaussianCloud):
        generator = GivenScene(source) if isinstance(source, GaussianCloud) else source
        return Scene(generator=generator, up=direction)
    return Scene(ply=source, up=direction)


def as_material(material: MaterialLike | None) -> Material:
    """Return the given material, that of a name, or the default."""
    return Material.named(material) if isinstance(material, str) else material or Material()


def as_solver(
    solver: Solver | None, hold: HoldLike | None, scene: Scene, cloud: GaussianCloud, damping: float = 0.0
) -> Solver:
    """Return a copy of the given solver, which may be another simulation's, or make one that suits the scene.

    An object that ``hold`` or a part of the scene holds then has no gravity, as in the starters of the preview: its
    captured shape is already in balance with its weight. ``damping`` [1/s] is that of a solver that is made.
    """
    if solver is None:
        own = cloud.select(scene.select(cloud))
        means = own.means
        frame = SimFrame.fit(means, scene.up, scene.longest_side, scene.metres_per_unit)
        side = float((means.amax(0) - means.amin(0)).amax()) * frame.metres_per_unit
        dx = suggest_spacing(side, particle_spacing(means) * frame.metres_per_unit, CELLS)
        if isinstance(hold, str):
            check_choice("hold", hold, ("auto",))
            splat, cell = Gaussians.of(own), dx / frame.metres_per_unit
            hold = end_region(splat.means, guess_hold(splat, frame.rotation[2].tolist(), cell).direction, cell)
        given = list(hold) if isinstance(hold, list | tuple) else [] if hold is None else [hold]
        pins = [PinnedRegion(part) if isinstance(part, Region) else part for part in given]
        held = bool(pins) or (scene.parts is not None and bool(scene.parts.mask(role="held").any()))
        gravity = (0.0, 0.0, 0.0 if held else -9.8)
        return MPMSolver(dx=dx, gravity=gravity, boundaries=pins, damping=damping)
    if hold is not None:
        raise ValueError(
            "`hold` only works without a solver: add the pin to the `boundaries` of the solver, and leave out `hold`."
        )
    return changed(solver, boundaries=FixedList(map(changed, solver.boundaries)))


def as_wind(wind: WindLike | None, frame: SimFrame) -> WindField | SpatialWind:
    """Convert to a wind: a wind, a look by its name, a steady flow from three numbers [m/s], or None for still air.

    Places of its effects are converted from scene units to metres.
    """
    if isinstance(wind, WindField):
        return wind.in_frame(frame)
    if isinstance(wind, SpatialWind):
        return wind
    if isinstance(wind, str):
        check_choice("wind", wind, tuple(LOOKS))
        return look(wind).in_frame(frame)
    return WindField() if wind is None else WindField(flow_rows("wind", [wind])[0])


def as_camera(
    camera: CameraPath | None,
    cameras: Mapping[str, CameraPath] | None,
    wind: WindField | SpatialWind,
    scene: SimulatedScene,
) -> CameraPath:
    """Return the given camera, or an orbit camera that looks at the front of the object or from beside the wind.

    The front is the side from which photos were taken; they are known if one of ``cameras`` is that of a capture.
    Beside a wind, its strongest flow goes to the right of the picture. If photos are from all around, and the wind is
    not horizontal or differs from place to place, the azimuth is that of an :class:`OrbitCamera` by default.
    """
    if camera is not None:
        return camera
    captured = next((path for path in (cameras or {}).values() if isinstance(path, CaptureCamera)), None)
    azimuth = None
    if captured is not None:
        eyes = torch.stack([seen.position for _, seen in read_views(captured.path, origin=scene.model.origin)])
        azimuth = photo_azimuth(eyes, scene.center.cpu(), scene.frame.rotation)
    if azimuth is None and isinstance(wind, WindField):
        azimuth = azimuth_beside(wind.flows[int(wind.flows.norm(dim=-1).argmax())].tolist())
    return OrbitCamera() if azimuth is None else OrbitCamera(azimuth=azimuth)


WIDER: dict[str, Any] = {
    "scene": Scene | ProceduralScene | GaussianCloud | str | os.PathLike,
    "material": Material | str | None,
    "solver": Solver | None,
    "wind": Any,
    "device": Any,
    "forces": list[Force | Callable[..., Any]],
    "hold": HoldLike | None,
}
"""What a simulation takes in Python where its annotations say what a file can contain."""
