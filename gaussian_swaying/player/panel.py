"""The panel of the live page: its controls, made from the numbers of the model, and what they change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from gaussian_swaying.mpm.materials import MATERIALS, name_of
from gaussian_swaying.player.session import Session
from gaussian_swaying.rendering.passes import PASSES, colormap
from gaussian_swaying.simulation.draw import speed_scale
from gaussian_swaying.simulation.model import POLAR, find, number
from gaussian_swaying.wind.field import WindField, angles_of, flow_of

ENDS = {
    "wind.speed": (0.0, 30.0),
    "wind.azimuth": (-180.0, 180.0),
    "wind.elevation": (-90.0, 90.0),
    "solver.damping": (0.0, 10.0),
    "material.E": (1e2, 1e8),
}
"""Ends of sliders whose number has a much wider range."""

LABELS = {
    "wind.azimuth": "direction",
    "wind.elevation": "upwards",
    "material.E": "stiffness E",
    "material.nu": "Poisson's ratio",
    "frame_dt": "length of a frame",
}
WIDEST, DECADES = 500.0, 2.0  # range of a linear slider; a logarithmic one reaches so far to both sides
KINDS = {"sway": "SineSway", "gusts": "UniformGust", "noise": "GaussianGust"}
OWN = "own numbers"  # of a material that is none of the known ones
GRIDS = {"coarse": 1.5, "normal": 1.0, "fine": 0.7}
RIM = 15.0  # m/s at the rim of the dial
TRACKS = {
    "speed": {"label": "Speed", "unit": "m/s", "low": 0.0, "high": 30.0, "digits": 1, "turns": False},
    "azimuth": {"label": "Direction", "unit": "degrees", "low": -180.0, "high": 180.0, "digits": 0, "turns": True},
    "gusts": {"label": "Gusts", "unit": "×", "low": 0.0, "high": 3.0, "digits": 2, "turns": False},
}
"""Of the timeline."""
LIGHT = "shader.init_args.light"


def slider(name: str, value: float, label: str = "") -> dict[str, Any]:
    """A control for a number of the model: a slider, or a field where the range is wide."""
    known = number(name)
    low, high = ENDS.get(name, (known.low, known.high))
    log = known.scale == "log" and (low > 0 or (name not in ENDS and value > 0))
    if log and name not in ENDS:
        low, high = max(low, value / 10**DECADES), min(high, value * 10**DECADES)
    wide = not log and high - low > WIDEST
    label = label or LABELS.get(name, name.rpartition(".")[2].replace("_", " "))
    found = {"kind": "number" if wide else "range", "name": name, "value": value, "unit": known.unit, "log": log}
    return found | {"label": label, "low": low, "high": high}


def _choice(name: str, label: str, options: Sequence[str], value: str, hint: str = "") -> dict[str, Any]:
    return {"kind": "choice", "name": name, "label": label, "options": list(options), "value": value, "hint": hint}


def _button(name: str, label: str, hint: str = "") -> dict[str, Any]:
    return {"kind": "button", "name": name, "label": label, "hint": hint}


def group(name: str, controls: list[dict[str, Any]], shut: bool = False) -> dict[str, Any]:
    """Some controls under a title."""
    return {"name": name, "controls": controls, "shut": shut}


class Panel:
    """The controls of a session, and their effect on it.

    Args:
        session: The session.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self._angles = [0.0, 0.0, 0.0]  # speed and angles of the wind; a calm has no direction of its own
        self._shader: dict[str, Any] | None = None  # the last one, while shading is off
        self._own: dict[str, Callable[[Any], Mapping[str, Any]]] = {
            "material": self._become,
            "gravity": lambda value: {"solver.gravity": [0.0, 0.0, -float(value)]},
            "grid": lambda value: {"solver.dx": self._grids()[value]},
            "add": lambda value: {"wind.modulations": [*self._modulations(), {"class_path": KINDS[value]}]},
            "light": lambda value: self._shade(True, float(value)),
            "shading": lambda value: self._shade(bool(value), self._light()),
            "free": lambda value: {"solver.boundaries": []},
            "wind.schedule": self._keyed,
        }

    def groups(self) -> list[dict[str, Any]]:
        settings, model = self.session.settings, self.session.simulation.model
        flow = self._flow()
        speed, *angles = angles_of(flow)
        self._angles = [speed, *(angles if speed > 0 else self._angles[1:])]
        wind: list[dict[str, Any]] = [
            {"kind": "dial", "name": "wind.flow", "label": "Wind", "value": flow, "high": RIM}
        ]
        wind += [slider(name, value) for name, value in zip(POLAR, self._angles, strict=True)]
        wind += self._timeline()
        gusts = []
        for place, modulation in enumerate(self._modulations()):
            kind = modulation["class_path"].rsplit(".", 1)[-1]
            start, label = f"wind.modulations.{place}.", next((k for k, own in KINDS.items() if own == kind), kind)
            for field, value in modulation["init_args"].items():
                if isinstance(value, int | float) and not isinstance(value, bool):
                    gusts.append(slider(start + field, value, f"{label}: {field}"))
            gusts.append(_button(f"remove.{place}", f"Remove the {label}"))
        gusts.append(_choice("add", "Add", ["", *KINDS], ""))
        material = settings.material
        name = name_of(material.E, material.nu, material.density) or OWN
        numbers = [one for one in model.numbers("material.") if number(one).same_points]
        body = [_choice("material", "Material", [OWN, *MATERIALS], name, "All its numbers but the thickness")]
        body += [slider(one, model.value(one)) for one in numbers]
        gravity = {"kind": "range", "name": "gravity", "label": "gravity", "unit": number("solver.gravity").unit}
        body.append(gravity | {"low": 0.0, "high": 20.0, "log": False, "value": -float(settings.solver.gravity[2])})
        body += [slider(one, model.value(one)) for one in model.numbers("solver.") if number(one).kind == "number"]
        grids = self._grids()
        grid = min(grids, key=lambda one: abs(grids[one] - float(settings.solver.dx)))
        body.append(_choice("grid", "Grid", list(grids), grid, "A coarser grid is faster"))
        body.append(_button("free", "Let go of all pins"))
        found = [group("Wind", wind), group("Sway and gusts", gusts, True), group("Material", body)]
        for prefix, title in (("aero.", "Force of the wind"), ("forces.", "Forces")):
            controls = [slider(one, model.value(one), one.removeprefix(prefix)) for one in model.numbers(prefix)]
            found += [group(title, controls, prefix == "aero.")] if controls else []
        passes = [name for name, own in PASSES.items() if not own.air]
        shader = self.session.simulation.painter.shader
        picture = [
            _choice("show", "Show", passes, "color"),
            {"kind": "toggle", "name": "server", "label": "Drawn by the server", "value": False}
            | {"hint": "Its colours depend on the view"},
            {"kind": "range", "name": "light", "label": "light from", "unit": "degrees", "log": False}
            | {"low": -180.0, "high": 180.0, "value": self._light()},
            {"kind": "toggle", "name": "shading", "label": "Shading", "value": shader is not None},
        ]
        return [*found, group("Picture", picture, True)]

    def names(self) -> dict[str, dict[str, Any]]:
        return {control["name"]: control for part in self.groups() for control in part["controls"]}

    def set(self, name: str, value: Any) -> None:
        """Do what a control does.

        Args:
            value: Its new value; None for a button.

        Raises:
            ValueError: If there is no such control, or if the value cannot be.
        """
        control = self.names().get(name)
        if control is None:
            raise ValueError(f"The page has no control {name!r:.60}: load it again.")
        if control["kind"] == "choice" and value not in control["options"]:
            raise ValueError(f"Expected {name} to be one of {', '.join(control['options'])}, but got {value!r:.60}.")
        if value in ("", OWN):  # the entry that shows that nothing is chosen
            return
        if name.startswith("remove."):
            place = int(name.removeprefix("remove."))
            kept = [one for k, one in enumerate(self._modulations()) if k != place]
            self.session.change({"wind.modulations": kept})
        elif name in POLAR:
            self._angles[POLAR.index(name)] = number(name).check(name, value)
            flow = flow_of((0.0, 0.0, 0.0), dict(zip(POLAR, self._angles, strict=True)))
            self.session.change({"wind.flow": [round(part, 4) for part in flow]})
        elif find(name) is not None:
            self.session.change({name: number(name).check(name, value)})
        elif name in self._own:
            self.session.change(self._own[name](value))

    def legends(self) -> dict[str, dict[str, Any]]:
        """Colour scales of the passes: name, unit, largest value, and colours from zero to it."""
        stepper = self.session.simulation.stepper
        colours = (255 * colormap(torch.linspace(0, 1, 9, dtype=torch.float64))).round().int().tolist()
        scales = {
            "force": ("Force of the wind", "Pa", stepper.force_scale()),
            "wind": ("Speed of the air", "m/s", speed_scale(stepper)),
        }
        return {
            name: {"name": label, "unit": unit, "high": high, "colours": colours}
            for name, (label, unit, high) in scales.items()
        }

    def _flow(self) -> list[float]:
        wind, flow = self.session.simulation.wind, self.session.simulation.stepper.flows()[0]
        if isinstance(wind, WindField):
            flow = wind.mean_flow(torch.tensor(self.session.snapshot.health.time, dtype=torch.float64))
        return [round(float(x), 4) for x in flow.tolist()]

    def _tracks(self) -> list[str]:
        """Names of the tracks of the timeline: keys of flows leave only gusts, and a file none."""
        schedule = self.session.settings.wind.schedule
        if isinstance(schedule, str):
            return []
        return ["gusts"] if any(key.flow is not None for key in schedule or ()) else list(TRACKS)

    def _timeline(self) -> list[dict[str, Any]]:
        wind, tracks = self.session.settings.wind, self._tracks()
        speed, azimuth, _ = angles_of(wind.flow or [0.0, 0.0, 0.0])
        keys = {
            name: [[key.time, key[name]] for key in wind.schedule or () if key[name] is not None] for name in tracks
        }
        usual = {"speed": round(speed, 1), "azimuth": round(azimuth), "gusts": 1.0}
        value = {"keys": keys, "usual": usual, "step": bool(wind.schedule) and wind.interpolation == "step"}
        shown = [{"name": name, **TRACKS[name]} for name in tracks]
        found = {"kind": "timeline", "name": "wind.schedule", "label": "Timeline", "tracks": shown, "value": value}
        return [found] if tracks else []

    def _keyed(self, value: Any) -> dict[str, Any]:
        wind, rows = self.session.settings.wind, {}
        for key in wind.schedule or ():
            if key.flow is not None:
                rows[key.time] = {"time": key.time, "flow": list(key.flow)}
        keys = {name: value["keys"][name] for name in self._tracks()}
        if keys.get("speed") and not keys["azimuth"] and not any(wind.flow or ()):
            keys["azimuth"] = [[keys["speed"][0][0], self._angles[1]]]  # a calm has no direction of its own
        for name, pairs in keys.items():
            for time, value in pairs:
                rows.setdefault(float(time), {"time": float(time)})[name] = float(value)
        found = {"wind.schedule": [rows[time] for time in sorted(rows)] or None}
        return found if wind.schedule else found | {"wind.interpolation": "linear"}

    def _modulations(self) -> list[dict[str, Any]]:
        return [
            {"class_path": one["class_path"], "init_args": dict(one.get("init_args") or {})}
            for one in self.session.settings.wind.modulations or ()
        ]

    def _become(self, name: str) -> dict[str, Any]:
        known = MATERIALS[name]
        changed = {f"material.{field}": value for field, value in known.numbers.items() if field != "thickness"}
        return changed | {"solver.damping": known.damping}

    def _grids(self) -> dict[str, float]:
        """The grid spacings [m] to choose from, by name; `normal` is that of the start."""
        dx, configured = self.session.first_dx, self.session.configured_dx
        grids = {name: float(f"{dx * times:.6g}") for name, times in GRIDS.items()}
        return grids if configured == dx else grids | {"configured": configured}

    def _light(self) -> float:
        light = getattr(self.session.simulation.painter.shader, "light", None)
        if light is None:
            return float(round(angles_of(self._shader["init_args"]["light"])[1])) if self._shader else 0.0
        return float(round(angles_of(light.tolist())[1]))

    def _shade(self, on: bool, azimuth: float) -> dict[str, Any]:
        given = self.session.settings.shader
        if given is not None:
            self._shader = {"class_path": given.class_path, "init_args": dict(given.init_args)}
        if not on:
            return {"shader": None}
        shader = self._shader or {"class_path": "DiffuseShader", "init_args": {"two_sided": True}}
        old = shader["init_args"].get("light", [0.0, -1.0, 0.8])
        light = [round(x, 4) for x in flow_of(old, {"wind.speed": 1.0, "wind.azimuth": azimuth})]
        if given is not None:
            return {LIGHT: light}
        return {"shader": shader | {"init_args": shader["init_args"] | {"light": light}}}
