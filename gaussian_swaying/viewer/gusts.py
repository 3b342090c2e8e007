"""The controls of the modulations of the wind: sway and gusts."""

from __future__ import annotations

import math
from typing import Any

from gaussian_swaying.viewer.screen import Panel

KINDS = {"Sway": "SineSway", "Gusts": "UniformGust", "Noise": "GaussianGust"}
FIELDS: dict[str, tuple[str, float, float, float]] = {  # label, least, most, step
    "amplitude": ("Amplitude [share]", 0.0, 2.0, 0.05),
    "delta": ("Strength [share]", 0.0, 1.0, 0.05),
    "std": ("Strength [m/s]", 0.0, 10.0, 0.1),
    "period": ("Period [s]", 0.05, 60.0, 0.05),
    "phase": ("Phase [rad]", -6.3, 6.3, 0.1),
    "interval": ("Interval [s]", 0.01, 10.0, 0.01),
}
NONE = "Add sway, gusts or noise"


class Gusts:
    """Shows the modulations of the wind, each with its numbers, and changes, adds and removes them.

    Args:
        controls: The panel; the folder of the wind is open.
    """

    def __init__(self, controls: Panel) -> None:
        self._controls, self.session = controls, controls.session
        self.gui = controls.server.gui
        self.folder = self.gui.add_folder("Sway and gusts", expand_by_default=False)
        self.removers: list[Any] = []
        self.numbers: list[dict[str, Any]] = []  # the control of each number, for each modulation
        self._parts: list[Any] = []
        self._shown: list[dict[str, Any]] | None = None
        with self.folder:
            self.add = self.gui.add_dropdown("More", (NONE, *KINDS), initial_value=NONE)
        controls.on(self.add.on_update, self._add)
        self.show()

    def show(self) -> None:
        there = self._there()
        if there == self._shown:
            return
        self._shown = there
        for part in self._parts:
            part.remove()
        self._parts, self.numbers, self.removers = [], [], []
        names = [_name(modulation) for modulation in there]
        self.folder.label = f"Sway and gusts: {', '.join(names).lower() or 'none'}"
        with self.folder:
            for place, modulation in enumerate(there):
                self._show_one(place, modulation)

    def _show_one(self, place: int, modulation: dict[str, Any]) -> None:
        folder = self.gui.add_folder(f"{place + 1}: {_name(modulation)}")
        found: dict[str, Any] = {}
        with folder:
            for field, value in (modulation.get("init_args") or {}).items():
                if isinstance(value, bool) or not isinstance(value, (int, float)):
                    continue
                label, least, most, step = FIELDS.get(field, (field, -math.inf, math.inf, 0.1))
                least, most = min(least, value), max(most, value)
                control = found[field] = self.gui.add_number(label, float(value), min=least, max=most, step=step)
                self._controls.on(control.on_update, self._changed)
            remove = self.gui.add_button("Remove")
            self._controls.on(remove.on_click, lambda: self._remove(place))
        self._parts.append(folder)
        self.numbers.append(found)
        self.removers.append(remove)

    def _there(self) -> list[dict[str, Any]]:
        return [_plain(modulation) for modulation in self.session.settings.wind.modulations or ()]

    def _changed(self) -> None:
        changed: dict[str, Any] = {}
        for place, (modulation, controls) in enumerate(zip(self._shown or [], self.numbers, strict=True)):
            arguments = modulation["init_args"]
            for field, control in controls.items():
                if (value := type(arguments[field])(control.value)) != arguments[field]:
                    arguments[field] = changed[f"wind.modulations.{place}.{field}"] = value
        if changed:
            self.session.change(changed)

    def _add(self) -> None:
        if self.add.value != NONE:
            kind = KINDS[self.add.value]
            self.add.value = NONE  # type: ignore[misc]
            self._set([*self._there(), {"class_path": kind}])

    def _remove(self, place: int) -> None:
        self._set([modulation for k, modulation in enumerate(self._there()) if k != place])

    def _set(self, modulations: list[dict[str, Any]]) -> None:
        self.session.change({"wind.modulations": modulations})


def _plain(modulation: Any) -> dict[str, Any]:
    return {"class_path": modulation["class_path"], "init_args": dict(modulation.get("init_args") or {})}


def _name(modulation: dict[str, Any]) -> str:
    kind = modulation["class_path"].rsplit(".", 1)[-1]
    return next((name for name, known in KINDS.items() if known == kind), kind)
