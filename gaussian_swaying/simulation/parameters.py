"""The numbers of a simulation that may change: their names, units and ranges, and how each gets into a simulation.

Edits, the live page, fits, sweeps, the preview and assignment in Python all use this list. A number of a
force of your own joins it in one line::

    register("forces.Breath.strength", unit="N", low=0.0)

It can then be changed with :meth:`~gaussian_swaying.simulation.simulation.Simulation.change`, has a control on the live
page, and can be an unknown of a fit and an axis of a sweep.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_vector, number_of, requires_grad
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import LIVE, FixedList, changed, fixed
from gaussian_swaying._numbers import sense_of
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.material import PLATE, Material
from gaussian_swaying.simulation.simulated_scene import SimulatedScene
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.field import SpatialWind, WindField
from gaussian_swaying.wind.force import AeroForce

if TYPE_CHECKING:
    from jsonargparse import Namespace

M = TypeVar("M", bound=nn.Module)

POLAR = ("wind.speed", "wind.azimuth", "wind.elevation")
"""Three numbers that together are ``wind.flow``."""


@fixed
@dataclass(frozen=True, eq=False)
class Setup:
    """Scene, material and drivers of a simulation. Never changed in place: another value makes another setup.

    Attributes:
        scene: The scene at rest.
        material: The material that was given.
        points: The material of the points.
        wind: The wind.
        aero: The force of the wind on patches.
        forces: The custom forces.
        solver: Numbers of the solver.
        air: The box of computed air; None if the wind is given everywhere.
    """

    scene: SimulatedScene
    material: Material
    points: MaterialPoints
    wind: WindField | SpatialWind
    aero: AeroForce
    forces: tuple[Force, ...]
    solver: Any
    air: ComputedAir | None = None


Read = Callable[[Setup], Any]
Write = Callable[[Setup, Mapping[str, Any]], Setup]


@fixed
@dataclass(frozen=True, eq=False)
class Parameter:
    """A number, or three, that may change.

    Attributes:
        name: The option of ``sim``, or a name of its own such as ``wind.speed``.
        read: Gives its value; ValueError if a setup has none.
        write: Gives a setup with other values of all parameters that have this function; ValueError if it has no place
            for them.
        unit: Its unit; empty for a pure number.
        low: Smallest value.
        high: Largest value.
        scale: ``log`` for sizes of any order of magnitude, else ``linear``.
        kind: ``number``, ``whole`` or ``vector`` (three numbers).
        batched: Whether simulations that differ in it are steps of one rollout.
        same_points: Whether all objects take it without other points, patches or contact.
        differentiable: Whether it keeps the gradient of a tensor.
    """

    name: str
    read: Read
    write: Write
    _: KW_ONLY
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    scale: Literal["linear", "log"] = "linear"
    kind: Literal["number", "whole", "vector"] = "number"
    batched: bool = False
    same_points: bool = True
    differentiable: bool = False

    def check(self, value: Any, name: str | None = None) -> Any:
        """A value as plain numbers, or as the tensor that it is if a gradient is required.

        Args:
            value: A number or tensor; three of them for a vector.
            name: Name of it in messages; its own if None.
        """
        name = name or self.name
        if requires_grad(value) and not self.differentiable:
            raise ValueError(f"`{name}` would lose its gradient: give a plain number (`tensor.detach()`).")
        if self.kind == "vector":
            plain = check_vector(name, value.detach() if isinstance(value, Tensor) else value)
            return value if isinstance(value, Tensor) and value.requires_grad else list(plain)
        if isinstance(value, bool) or not isinstance(value, int | float | Tensor):
            raise TypeError(f"Expected `{name}` to be a number, but got {value!r:.60}.")
        if self.kind == "whole" and value != int(value):
            raise TypeError(f"Expected `{name}` to be a whole number, but got {value!r:.60}.")
        plain_number = float(number_of(value))
        if not self.low <= plain_number <= self.high or not math.isfinite(plain_number):
            raise ValueError(f"Expected `{name}` to be {self.range_in_words}, but got {plain_number:g}.")
        if isinstance(value, Tensor) and value.requires_grad:
            return value
        return int(plain_number) if self.kind == "whole" else plain_number

    @property
    def range_in_words(self) -> str:
        if self.low == -math.inf:
            return "finite"
        return f"at least {self.low:g}" if self.high == math.inf else f"from {self.low:g} to {self.high:g}"


_KNOWN: dict[str, Parameter] = {}


def register(name: str, read: Read | None = None, *, write: Write | None = None, **settings: Any) -> Parameter:
    """Add a parameter.

    Args:
        name: ``forces.CLASS.ATTRIBUTE`` for a number of a force of that class; any other name needs ``read`` and
            ``write``.
        read: Gives its value; found by the name for a force.
        write: Changes it; found by the name for a force.
        settings: Further attributes of :class:`Parameter`: unit, range, scale, kind, and how it may be used.

    Returns:
        The parameter.

    Raises:
        ValueError: If the name is taken, or says nothing about how to change it.
    """
    if name in _KNOWN:
        raise ValueError(f"The parameter `{name}` is registered already: choose another name.")
    parts = name.split(".")
    if read is None and write is None and parts[0] == "forces" and len(parts) == 3:
        read, write = _of_force(parts[1], parts[2])
    if read is None or write is None:
        raise ValueError(f"Expected `{name}` to be forces.CLASS.ATTRIBUTE, or to come with `read` and `write`.")
    sense = sense_of(name)
    _KNOWN[name] = Parameter(name, read, write, **((sense._asdict() if sense else {}) | settings))
    LIVE.add(name)
    return _KNOWN[name]


def names() -> list[str]:
    """The names of all parameters; ``*`` stands for the place of a modulation."""
    return list(_KNOWN)


def find(name: str) -> Parameter | None:
    """The parameter of a name, or None. ``wind.modulations.0.FIELD`` is any number of a modulation of the wind."""
    if name in _KNOWN:
        return _KNOWN[name]
    parts = name.split(".")
    if parts[:2] == ["wind", "modulations"] and len(parts) == 4 and parts[2].isdecimal():
        like = _KNOWN.get(f"wind.modulations.*.{parts[3]}", _KNOWN["wind.modulations.*.amplitude"])
        known = like.name.endswith(f".{parts[3]}")
        more: dict[str, Any] = {} if known else {"unit": "", "low": -math.inf, "high": math.inf, "scale": "linear"}
        return replace(like, name=name, read=_of_modulation(name), **more)
    return None


def parameter(name: str) -> Parameter:
    """As :func:`find`."""
    found = find(name)
    if found is None:
        raise ValueError(f"`{name}` is no parameter that may change: use one of {', '.join(names())}.")
    return found


def present(setup: Setup, start: str = "") -> list[str]:
    """The names of the parameters of a setup that begin with a prefix."""
    found = []
    for name in names():
        if name.startswith(start) and "*" not in name:
            try:
                parameter(name).read(setup)
            except ValueError:
                continue
            found.append(name)
    return found


def value_of(setup: Setup, name: str) -> Any:
    """The value of a parameter in a setup."""
    return parameter(name).read(setup)


def with_values(setup: Setup, values: Mapping[str, Any]) -> Setup:
    """A setup with other values.

    Args:
        setup: The setup, which stays as it is.
        values: Values by the names of parameters; tensors keep their gradient where the parameter is differentiable.
    """
    together: dict[Write, dict[str, Any]] = {}
    for name, value in values.items():
        known = parameter(name)
        together.setdefault(known.write, {})[name] = known.check(value)
    for write, several in together.items():
        setup = write(setup, several)
    return setup


def in_settings(settings: Namespace, name: str, value: Any) -> None:
    """Set a parameter in parsed settings, which are changed.

    Args:
        settings: From the parser of a simulation.
        name: The parameter.
        value: Its value.
    """
    value, parts = parameter(name).check(value), name.split(".")
    if name in POLAR:
        settings.wind.flow = flow_of(list(settings.wind.flow), {name: value})
    elif parts[0] == "forces":
        _arguments(settings.forces, parts[1], name)[parts[2]] = value
    elif parts[:2] == ["wind", "modulations"]:
        entries = settings.wind.modulations
        if int(parts[2]) >= len(entries):
            raise ValueError(f"The wind has no modulation {parts[2]} for `{name}`: add it to `wind.modulations`.")
        _arguments([entries[int(parts[2])]], "", name)[parts[3]] = value
    else:
        settings[name] = value
        if name == "wind.flow":
            settings.wind.schedule = None


def all_in_settings(settings: Namespace, values: Mapping[str, Any]) -> None:
    """Set several parameters as :func:`in_settings` does; the speed of the wind first, as still air has no angles."""
    for name in sorted(values, key=lambda name: name != POLAR[0]):
        in_settings(settings, name, values[name])


def of_settings(settings: Namespace, name: str) -> Any:
    """The value of a parameter in parsed settings, as :func:`in_settings` sets it."""
    parts = name.split(".")
    if name in POLAR:
        return angles_of(settings.wind.flow)[POLAR.index(name)]
    if parts[0] == "forces":
        return _arguments(settings.forces, parts[1], name)[parts[2]]
    if parts[:2] == ["wind", "modulations"]:
        return settings.wind.modulations[int(parts[2])]["init_args"][parts[3]]
    return settings[name]


def _arguments(entries: Sequence[Any], kind: str, name: str) -> Any:
    """The ``init_args`` of the first entry of a class; of any class if ``kind`` is empty."""
    for entry in entries or ():
        if not kind or entry["class_path"].rsplit(".", 1)[-1] == kind:
            if entry.get("init_args") is None:
                entry["init_args"] = {}
            return entry["init_args"]
    raise ValueError(f"`forces` has no {kind} for `{name}`: add it.")


def flow_of(base: Sequence[float], values: Mapping[str, float]) -> list[float]:
    """A flow [m/s] with some of ``wind.speed``, ``wind.azimuth`` and ``wind.elevation`` replaced.

    Example:
        >>> [round(x, 3) for x in flow_of([2.0, 0.0, 0.0], {"wind.azimuth": 90.0})]
        [0.0, 2.0, 0.0]
    """
    x, y, z = base
    speed = values.get("wind.speed", math.hypot(x, y, z))
    azimuth = math.radians(values["wind.azimuth"]) if "wind.azimuth" in values else math.atan2(y, x)
    rise = math.radians(values["wind.elevation"]) if "wind.elevation" in values else math.atan2(z, math.hypot(x, y))
    level = speed * math.cos(rise)
    return [level * math.cos(azimuth), level * math.sin(azimuth), speed * math.sin(rise)]


# ---- how they are set


def _uniform_wind(setup: Setup) -> WindField:
    if not isinstance(setup.wind, WindField):
        raise ValueError("Expected `wind` to be a WindField: a custom wind has no numbers that could be changed.")
    return setup.wind


def _steady(setup: Setup, name: str) -> WindField:
    wind = _uniform_wind(setup)
    if len(wind.flows) > 1:
        raise ValueError(f"`wind.schedule` gives the flow: remove it, or do not change `{name}`.")
    return wind


def _write_polar(setup: Setup, values: Mapping[str, Any]) -> Setup:
    wind = _steady(setup, next(iter(values)))
    base = wind.flows[0].tolist()
    if not any(base) and len(values) < 2:
        raise ValueError("The base has no `wind.flow`: give one, or seek `wind.speed` and `wind.azimuth`.")
    return replace(setup, wind=wind.with_flow(flow_of(base, values)))


def _write_wind(setup: Setup, values: Mapping[str, Any]) -> Setup:
    wind = _uniform_wind(setup)
    if "wind.flow" in values:
        wind = wind.with_flow(values["wind.flow"])
    if "wind.seed" in values:
        wind = changed(wind, seed=values["wind.seed"])
    return replace(setup, wind=wind)


def _write_modulation(setup: Setup, values: Mapping[str, Any]) -> Setup:
    wind = _uniform_wind(setup)
    parts = list(wind.modulations)
    for name, value in values.items():
        _of_modulation(name)(setup)  # it is there
        _, _, place, field = name.split(".")
        parts[int(place)] = changed(parts[int(place)], **{field: value})
    return replace(setup, wind=changed(wind, modulations=FixedList(parts)))


def _of_modulation(name: str) -> Read:
    def read(setup: Setup) -> float:
        wind = _uniform_wind(setup)
        place, field = int(name.split(".")[2]), name.split(".")[3]
        there = wind.modulations[place] if place < len(wind.modulations) else None
        value = getattr(there, field, None)
        if not isinstance(value, float):
            raise ValueError(f"The wind has no number `{name}`: add the modulation.")
        return value

    return read


def _polar(setup: Setup) -> tuple[float, float, float]:
    return angles_of(_steady(setup, POLAR[0]).flows[0].tolist())


def angles_of(flow: Sequence[float]) -> tuple[float, float, float]:
    """Speed [m/s], azimuth from x towards y and elevation [degrees] of a flow."""
    x, y, z = flow
    return math.hypot(x, y, z), math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def _write_material(setup: Setup, values: Mapping[str, Any]) -> Setup:
    points, material = setup.points, setup.material

    for name in values:
        if any(getattr(part, name[9:]) is not None for part in material.regions):
            raise ValueError(
                f"`{name}` is to change, but `material.regions` or `scene.parts` gives it too: remove it there."
            )
    bends = material.bending is not None or any(part.bending is not None for part in material.regions)
    if bends and setup.points.bending is None:
        for name in ("material.E", "material.nu"):
            if name in values:
                raise ValueError(
                    f"`{name}` is to change, but with `material.bending` it says where the layers lie: make another "
                    "simulation, or leave `material.bending` out."
                )
    if "material.thickness" in values:
        ratio = values["material.thickness"] / _thickness(setup)
        points = thicker(setup, ratio).points
        material = replace(material, thickness=values["material.thickness"])
    if points.bending is not None and setup.material.bending == PLATE:
        points = replace(points, bending=points.bending * _stiffer(setup, values))
    for name, field in (("E", "youngs_modulus"), ("nu", "poisson_ratio")):
        if f"material.{name}" in values:
            value = values[f"material.{name}"]
            # a sum keeps a gradient
            points = replace(points, **{field: torch.zeros_like(getattr(points, field)) + value})
            material = replace(material, **{name: value})
    if "material.density" in values:
        points = replace(points, mass=points.volume * values["material.density"])
        material = replace(material, density=values["material.density"])
    return replace(setup, points=points, material=material)


def _stiffer(setup: Setup, values: Mapping[str, Any]) -> Any:
    """Factor of the stiffness against bending of each point of a plate of one layer, by Kirchhoff's D."""
    points, ratio = setup.points, 1.0
    if "material.E" in values:
        ratio = ratio * values["material.E"] / points.youngs_modulus
    if "material.nu" in values:
        ratio = ratio * (1 - points.poisson_ratio.square()) / (1 - values["material.nu"] ** 2)
    if "material.thickness" in values:
        ratio = ratio * (values["material.thickness"] / _thickness(setup)) ** 3
    return ratio


def thicker(setup: Setup, ratio: Any) -> Setup:
    """A setup whose points have so many times the mass and volume, as in a sheet of so many times the thickness."""
    points = setup.points
    return replace(setup, points=replace(points, mass=points.mass * ratio, volume=points.volume * ratio))


def _thickness(setup: Setup) -> float:
    """The thickness; ValueError unless the object is a sheet of one layer, whose points stay if it gets thicker."""
    scene, material = setup.scene, setup.material
    if material.volume != "patch" or scene.filled or setup.points.count != scene.on_surface + scene.filled:
        raise ValueError(
            "`material.thickness` can be changed only of a sheet of one layer (`scene.layers: 1`): change `material.E` "
            "and `material.density` instead."
        )
    return number_of(material.thickness)


def _write_aero(setup: Setup, values: Mapping[str, Any]) -> Setup:
    return replace(setup, aero=changed(setup.aero, **{name[5:]: value for name, value in values.items()}))


def _of_aero(name: str) -> Read:
    return lambda setup: number_of(getattr(setup.aero, name))


def _of_solver(name: str) -> Read:
    def read(setup: Setup) -> Any:
        if not hasattr(setup.solver, name):
            raise ValueError(f"This solver has no `{name}`.")
        return getattr(setup.solver, name)

    return read


def _write_solver(setup: Setup, values: Mapping[str, Any]) -> Setup:
    changes: dict[str, Any] = {name[7:]: value for name, value in values.items()}
    if "gravity" in changes:
        changes["gravity"] = tuple(changes["gravity"])
    return replace(setup, solver=replace(setup.solver, **changes))


def _of_force(kind: str, attribute: str) -> tuple[Read, Write]:
    def read(setup: Setup) -> float:
        for force in setup.forces:
            if type(force).__name__ == kind:
                return number_of(getattr(force, attribute))
        raise ValueError(f"There is no force {kind}: add it to `forces`.")

    def write(setup: Setup, values: Mapping[str, Any]) -> Setup:
        read(setup)
        (value,) = values.values()
        forces = tuple(changed(f, **{attribute: value}) if type(f).__name__ == kind else f for f in setup.forces)
        return replace(setup, forces=forces)

    return read, write


def _mean(field: str) -> Read:
    return lambda setup: float(in_double(getattr(setup.points, field).detach()).mean())


def _steady_flow(setup: Setup) -> list[float]:
    flow: list[float] = _steady(setup, "wind.flow").flows[0].tolist()
    return flow


def _density(setup: Setup) -> float:
    return float((in_double(setup.points.mass).sum() / in_double(setup.points.volume).sum()).detach())


_SIZE: dict[str, Any] = {"scale": "log"}
_MATERIAL: dict[str, Any] = {"batched": True, "differentiable": True}
register("wind.flow", _steady_flow, write=_write_wind, kind="vector", batched=True, differentiable=True)
register("wind.seed", lambda setup: _uniform_wind(setup).seed, write=_write_wind, kind="whole", batched=True)
register("wind.speed", lambda setup: _polar(setup)[0], write=_write_polar, batched=True, **_SIZE)
register("wind.azimuth", lambda setup: _polar(setup)[1], write=_write_polar, batched=True)
register("wind.elevation", lambda setup: _polar(setup)[2], write=_write_polar, batched=True)
for _name in ("amplitude", "delta", "std", "period", "interval", "phase"):
    _reader, _rest = _of_modulation(f"wind.modulations.0.{_name}"), {} if _name == "phase" else _SIZE
    register(f"wind.modulations.*.{_name}", _reader, write=_write_modulation, batched=True, **_rest)
register("material.E", _mean("youngs_modulus"), write=_write_material, **_SIZE, **_MATERIAL)
register("material.nu", _mean("poisson_ratio"), write=_write_material, **_MATERIAL)
register("material.density", _density, write=_write_material, **_SIZE, **_MATERIAL)
register("material.thickness", _thickness, write=_write_material, batched=True, same_points=False, **_SIZE)
for _name in ("C_D", "C_F", "C_L"):
    register(f"aero.{_name}", _of_aero(_name), write=_write_aero, differentiable=True, **_SIZE)
register("aero.added_mass", _of_aero("added_mass"), write=_write_aero, **_SIZE)
register("solver.gravity", lambda setup: list(_of_solver("gravity")(setup)), write=_write_solver, kind="vector")
for _name in ("damping", "stiffness_damping"):
    register(f"solver.{_name}", _of_solver(_name), write=_write_solver, **_SIZE)
