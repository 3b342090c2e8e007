"""The page of a live wind tunnel: its controls, and their effect on the session."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gaussian_swaying.mpm.materials import MATERIALS, name_of
from gaussian_swaying.rendering.passes import colormap
from gaussian_swaying.simulation.draw import speed_scale
from gaussian_swaying.simulation.model import POLAR, angles_of, flow_of, number
from gaussian_swaying.viewer.files import Files
from gaussian_swaying.viewer.gusts import Gusts
from gaussian_swaying.viewer.holding import Holding
from gaussian_swaying.viewer.painting import Painting
from gaussian_swaying.viewer.pictures import SHOWN
from gaussian_swaying.viewer.screen import Panel, Screen
from gaussian_swaying.viewer.session import Session

if TYPE_CHECKING:
    import viser

MOST_SPEED = 30.0  # m/s
ARROW = 0.06  # length of the arrow of a wind of 1 m/s, in longest sides
LEAST_LOG, MOST_LOG = 2, 8  # of the stiffness [Pa] on the slider
OWN = "own numbers"  # of a material that is none of the known ones
GRIDS = {"coarse": 1.5, "normal": 1.0, "fine": 0.7}


class Controls(Panel):
    """Builds the panel and the handles in the scene.

    Args:
        page: The page.
    """

    def __init__(self, page: Screen) -> None:
        super().__init__(page)
        page.force_end = page.session.simulation.stepper.force_scale()
        self._drawn_for: Any = None  # the simulation whose handles are drawn
        self._shader: dict[str, Any] | None = None  # the last one, while shading is off
        self._settings: Any = None  # those that the panel shows
        self._revision = 0
        self._grids = self._spacings()
        gui = self.server.gui
        self.legends = gui.add_html("", visible=False)
        self._running()
        with gui.add_folder("Wind"):
            self._wind()
        with gui.add_folder("Material"):
            self._material()
        self._forces()
        with gui.add_folder("Pull and hold"):
            self.holding = Holding(self)
        with gui.add_folder("Paint parts", expand_by_default=False):
            self.painting = Painting(self)
        with gui.add_folder("Picture", expand_by_default=False):
            self._picture()
        with gui.add_folder("Files"):
            self.files = Files(self, self.other_scene, self.painting.as_saved)
        self.show_values()

    # ---- groups of controls

    def _running(self) -> None:
        gui = self.server.gui
        self.pause = gui.add_button("Pause", icon=None, hint="Stop and go on")
        self.step = gui.add_button("Step", hint="One step, while paused")
        self.reset = gui.add_button("Back to rest", hint="The motion starts again, with all that you have changed")
        self.undo = gui.add_button("Undo", hint="Take the last change back", disabled=True)
        self.restore = gui.add_button(
            "Reset to the configuration", hint="Wind, material, pins, grid and light as they were at first"
        )
        self.speed = gui.add_slider("Speed [x real time]", 0.05, 1.0, 0.05, 1.0, hint="Slow motion below 1")
        self.on(self.pause.on_click, self._toggle)
        self.on(self.step.on_click, self.session.step)
        self.on(self.reset.on_click, self.session.reset)
        self.on(self.undo.on_click, self.session.undo)
        self.on(self.restore.on_click, self.session.restore)
        self.on(self.speed.on_update, lambda: self.session.pace(self.speed.value))

    def _wind(self) -> None:
        gui = self.server.gui
        self.wind_speed = gui.add_slider("Speed [m/s]", 0.0, MOST_SPEED, 0.1, 0.0)
        self.azimuth = gui.add_slider("Direction [deg]", -180.0, 180.0, 1.0, 0.0, hint="About up; 0 is along x")
        self.elevation = gui.add_slider("Upwards [deg]", -90.0, 90.0, 1.0, 0.0)
        for control in (self.wind_speed, self.azimuth, self.elevation):
            self.on(control.on_update, self._blow)
        self.gusts = Gusts(self)

    def _material(self) -> None:
        gui = self.server.gui
        self.known = gui.add_dropdown(
            "Material",
            (OWN, *MATERIALS),
            initial_value=OWN,
            hint="Numbers of a known material; stiff ones take more substeps",
        )
        self.kept = gui.add_markdown("", visible=False)
        self.on(self.known.on_update, self._become)
        self.stiffness = gui.add_number(
            "Stiffness E [Pa]", 1e4, min=1.0, max=1e12, step=100.0, hint="Young's modulus; the slider is logarithmic"
        )
        marks = tuple((float(k), in_pascal(10.0**k)) for k in range(LEAST_LOG, MOST_LOG + 1, 2))
        self.stiffness_log = gui.add_multi_slider(
            "", float(LEAST_LOG), float(MOST_LOG), 0.05, (4.0,), marks=marks, hint="Stiffness, logarithmic"
        )
        self.feels = gui.add_markdown("")
        self.damping = gui.add_slider("Damping [1/s]", 0.0, 10.0, 0.1, 0.0)
        self.gravity = gui.add_slider("Gravity [m/s²]", 0.0, 20.0, 0.1, 0.0)
        self.grid = gui.add_dropdown(
            "Grid", tuple(self._grids), initial_value="normal", hint="A coarser grid is faster; starts again"
        )
        self.on(self.stiffness.on_update, lambda: self._stiffen(self.stiffness.value))
        self.on(self.stiffness_log.on_update, lambda: self._stiffen(10 ** self.stiffness_log.value[0]))
        self.on(self.damping.on_update, lambda: self._set("solver.damping", self.damping.value))
        self.on(self.gravity.on_update, lambda: self._set("solver.gravity", [0.0, 0.0, -self.gravity.value]))
        self.on(self.grid.on_update, lambda: self._set("solver.dx", self._grids[self.grid.value]))

    def _forces(self) -> None:
        self.forces: dict[str, Any] = {}
        model = self.session.simulation.model
        for name in model.numbers("forces."):
            if not self.forces:
                folder = self.server.gui.add_folder("Forces")
            known = number(name)
            label = name.removeprefix("forces.") + (f" [{known.unit}]" if known.unit else "")
            low, high = (None if math.isinf(end) else end for end in (known.low, known.high))
            with folder:
                control = self.forces[name] = self.server.gui.add_number(
                    label, model.value(name), min=low, max=high, step=0.01
                )
            self.on(control.on_update, lambda name=name, control=control: self._set(name, control.value))

    def _picture(self) -> None:
        gui = self.server.gui
        self.shown = gui.add_dropdown("Show", SHOWN, initial_value=SHOWN[0])
        self.by_browser = gui.add_checkbox(
            "Drawn by the browser", True, hint="Off: pictures from the server, whose colours depend on the view"
        )
        self.light = gui.add_slider("Light from [deg]", -180.0, 180.0, 1.0, 0.0)
        self.shading = gui.add_checkbox("Shading", True)
        self.streaks = gui.add_checkbox("Streaks of air", False, hint="Coloured by speed, near a plane along the wind")
        self.arrow = gui.add_checkbox("Arrow of the wind", True)
        self.box = gui.add_checkbox("Box of the grid", False)
        self.pins = gui.add_checkbox("What is held", False, hint="Points that pins and handles hold, at rest")
        changed: dict[Callable[[], None], tuple[Any, ...]] = {
            self._show: (self.shown, self.by_browser, self.streaks),
            self._shade: (self.light, self.shading),
            self.draw_handles: (self.arrow, self.box, self.pins),
        }
        for what, controls in changed.items():
            for control in controls:
                self.on(control.on_update, what)

    # ---- health

    def tell(self) -> None:
        session = self.session
        rates, health = session.rates(), session.snapshot.health
        running = "paused" if session.paused else f"{rates.real_time:.2g} x real time"
        lines = [
            f"**{self.page.pictures_per_second():.0f} pictures a second**, {running}",
            f"t = {health.time:.2f} s; {rates.substeps} substeps in a step of {rates.step:.3g} s; stretch "
            f"{health.stretch_min:.2f} to {health.stretch_max:.2f}",
        ]
        if self.page.recording is not None:
            lines.append(f"Recording: {self.page.recording.seconds:.1f} s of simulated time")
        if session.problem:
            remedy = " Press **Back to rest** to start again, or **Undo**." if session.broken else ""
            lines.append(f"⚠️ {session.problem}{remedy}")
        self.page.write(lines)
        self.undo.disabled = session.changes == 0
        self.pause.label = "Go on" if session.paused else "Pause"
        if session.simulation is not self._drawn_for:
            self.draw_handles()
        if session.settings is not self._settings or session.revision != self._revision:
            self.show_values(everything=session.revision != self._revision)
        self._show_legends()
        self.holding.follow()

    def show_values(self, everything: bool = True) -> None:
        """Show the settings that the session has now: all, or what the controls do not know by themselves."""
        self._revision, self._settings = self.session.revision, self.session.settings
        settings = self._settings
        stiffness = float(settings.material.E)
        self.feels.content = f"{in_pascal(stiffness)}: like {like(stiffness)}"
        self._show_known()
        self.gusts.show()
        if not everything:
            return
        speed, azimuth, elevation = (round(x, 1) for x in angles_of(self._flow()))
        shown: list[tuple[Any, Any]] = [
            (self.wind_speed, min(speed, MOST_SPEED)),
            (self.azimuth, azimuth),
            (self.elevation, elevation),
            (self.stiffness, stiffness),
            (self.stiffness_log, (log_place(stiffness),)),
            (self.damping, min(float(settings.solver.damping), 10.0)),
            (self.gravity, min(max(-float(settings.solver.gravity[2]), 0.0), 20.0)),
            (self.grid, min(self._grids, key=lambda name: abs(self._grids[name] - float(settings.solver.dx)))),
            (self.light, self._light_azimuth()),
            (self.shading, self.session.simulation.painter.shader is not None),
        ]
        model = self.session.simulation.model
        shown += [(control, model.value(name)) for name, control in self.forces.items() if model.numbers(name)]
        for control, value in shown:
            control.value = value
        self.draw_handles()

    def other_scene(self) -> None:
        """Adapt to another scene: remove what belongs to the old one, and show the new values."""
        self.holding.forget_box()
        self.painting.forget()
        self._grids = self._spacings()
        self.grid.value = "normal"  # type: ignore[misc]  # which is in both lists
        self.grid.options = tuple(self._grids)
        self.page.force_end = self.session.simulation.stepper.force_scale()
        self.show_values()
        self.page.look_from_start()

    def _spacings(self) -> dict[str, float]:
        """The grid spacings [m] to choose from, by name; `normal` is that of the start."""
        dx, configured = float(self.session.settings.solver.dx), self.session.configured_dx
        grids = {name: float(f"{dx * times:.6g}") for name, times in GRIDS.items()}
        return grids if configured == dx else grids | {"configured": configured}

    def _show_legends(self) -> None:
        simulation = self.session.simulation
        parts = []
        if self.shown.value == "wind force":
            parts.append(legend("Force of the wind", "Pa", self.page.force_end))
        if self.streaks.value:
            parts.append(legend("Speed of the air", "m/s", speed_scale(simulation.stepper)))
        self.legends.content, self.legends.visible = "".join(parts), bool(parts)

    # ---- what they do

    def _set(self, name: str, value: Any) -> None:
        self.session.change({name: value})

    def _become(self) -> None:
        """Take what a known material has and may change in motion: all but the thickness."""
        if self.known.value not in MATERIALS:
            return
        known = MATERIALS[self.known.value]
        self.stiffness.value, self.stiffness_log.value = known.E, (log_place(known.E),)  # type: ignore[misc]
        self.damping.value = known.damping  # type: ignore[misc]
        changed = {f"material.{name}": value for name, value in known.numbers.items() if name != "thickness"}
        self.session.change(changed | {"solver.damping": known.damping})

    def _show_known(self) -> None:
        material = self._settings.material
        name = name_of(material.E, material.nu, material.density)
        self.known.value = name or OWN  # type: ignore[misc]
        thickness = 0.0 if name is None else MATERIALS[name].thickness
        self.kept.visible = name is not None and thickness != material.thickness
        self.kept.content = (
            f"The thickness stays at {1e3 * material.thickness:.3g} mm, as it cannot change in motion; {name} has "
            f"{1e3 * thickness:.3g} mm. Start with `--material {name}` for all of it."
        )

    def _stiffen(self, stiffness: float) -> None:
        stiffness = float(f"{stiffness:.3g}")
        self.stiffness.value, self.stiffness_log.value = stiffness, (log_place(stiffness),)  # type: ignore[misc]
        self._set("material.E", stiffness)

    def _toggle(self) -> None:
        self.session.pause(not self.session.paused)
        self.pause.label = "Go on" if self.session.paused else "Pause"

    def _flow(self) -> list[float]:
        return [float(x) for x in self.session.simulation.stepper.flows()[0].tolist()]

    def _blow(self) -> None:
        angles = self.wind_speed.value, self.azimuth.value, self.elevation.value
        flow = flow_of((0.0, 0.0, 0.0), dict(zip(POLAR, angles, strict=True)))
        self._set("wind.flow", [round(x, 4) for x in flow])
        self._draw_arrow(flow)

    def _show(self) -> None:
        self.page.shown, self.page.streaks = self.shown.value, self.streaks.value
        self.page.by_browser = self.by_browser.value
        self.page.redraw()
        self._show_legends()

    def _light_azimuth(self) -> float:
        shader = self.session.simulation.painter.shader
        light = getattr(shader, "light", None)
        return 0.0 if light is None else round(angles_of(light.tolist())[1])

    def _shade(self) -> None:
        given = self.session.settings.shader
        if given is not None:
            self._shader = {"class_path": given.class_path, "init_args": dict(given.init_args)}
        if not self.shading.value:
            self.session.change({"shader": None})
            return
        shader = self._shader or {"class_path": "DiffuseShader", "init_args": {"two_sided": True}}
        old = shader["init_args"].get("light", [0.0, -1.0, 0.8])
        light = [round(x, 4) for x in flow_of(old, {"wind.speed": 1.0, "wind.azimuth": self.light.value})]
        if given is not None:
            self.session.change({"shader.init_args.light": light})
        else:
            self.session.change({"shader": shader | {"init_args": shader["init_args"] | {"light": light}}})

    # ---- handles in the scene

    def draw_handles(self) -> None:
        """Draw the arrow of the wind, the box of the grid and the pins, again after another simulation is there."""
        self._drawn_for = self.session.simulation
        scene, server = self.session.simulation.scene, self.server.scene
        self._tip = server.add_transform_controls(
            "/wind/tip", scale=0.12 * scene.size, disable_rotations=True, disable_sliders=True, depth_test=False,
            visible=self.arrow.value,
        )  # fmt: skip
        self.on(self._tip.on_update, self._tip_moved)
        self._draw_arrow(self._flow())
        low, high = map(np.array, self.session.simulation.solver.domain(self.session.snapshot.state))
        corners = torch.tensor(low + (high - low) * np.array(CORNERS), dtype=torch.float64)
        lines = scene.frame.point_to_scene(corners).cpu().numpy()[np.array(EDGES)]
        server.add_line_segments("/grid", lines, (120, 120, 120), thickness=1.5, visible=self.box.value)

        server.add_point_cloud(
            "/held", self.holding.places(), (220, 120, 40), point_size=0.008 * scene.size, visible=self.pins.value
        )

    def _anchor(self) -> np.ndarray:
        scene = self.session.simulation.scene
        low, high = (corner.double() for corner in scene.bounds)
        up = scene.frame.rotation[2].to(low)
        return (0.5 * (low + high) + (0.5 * up.abs() @ (high - low) + 0.12 * scene.size) * up).cpu().numpy()

    def _draw_arrow(self, flow: list[float]) -> None:
        """An arrow that ends above the object, as long as the wind is fast; its tail can be dragged."""
        scene = self.session.simulation.scene
        along = scene.frame.direction_to_scene(torch.tensor(flow, dtype=torch.float64)).cpu().numpy()
        head = self._anchor()
        tail = head - ARROW * scene.size * along
        points = np.stack([tail, head])[None]
        size = scene.size
        self.server.scene.add_arrows(
            "/wind/arrow", points, (40, 120, 220), shaft_radius=0.008 * size, head_radius=0.02 * size,
            head_length=0.05 * size, visible=self.arrow.value and float(np.linalg.norm(along)) > 0.05,
        )  # fmt: skip
        self._tip.position = tuple(tail)

    def _tip_moved(self) -> None:
        """Change the wind after the tail of the arrow was dragged."""
        scene = self.session.simulation.scene
        along = torch.tensor(self._anchor() - np.array(self._tip.position), dtype=torch.float64)
        flow = scene.frame.direction_to_sim(along / (ARROW * scene.size)).tolist()
        speed, azimuth, elevation = angles_of(flow)
        self.wind_speed.value = round(min(speed, MOST_SPEED), 1)  # type: ignore[misc]
        self.azimuth.value = round(azimuth, 1)  # type: ignore[misc]
        self.elevation.value = round(elevation, 1)  # type: ignore[misc]
        self._blow()


class Page(Screen):
    """A screen with controls.

    Attributes:
        controls: The panel, from :meth:`show` on.
    """

    controls: Controls

    def show(self, session: Session) -> Page:
        """Show a session, and the controls; returns the page."""
        self.session = session
        self.controls = Controls(self)
        super().show(session)
        return self

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        """Stop the video that is being recorded, and send it to a browser."""
        self.controls.files.stop_recording(client)

    def tell_figures(self) -> None:
        """Write the figures in the corner; the controls follow the session."""
        self.controls.tell()


def log_place(stiffness: float) -> float:
    """Return the slider's value for a stiffness [Pa]: its logarithm to base 10, within the range."""
    return round(min(max(math.log10(stiffness), float(LEAST_LOG)), float(MOST_LOG)), 2)


CORNERS = [[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
EDGES = [[a, b] for a in range(8) for b in range(a) if sum(map(abs, np.subtract(CORNERS[a], CORNERS[b]))) == 1]


def legend(name: str, unit: str, largest: float) -> str:
    """A colour scale from zero to a largest value, as HTML.

    Args:
        name: Name of the quantity.
        unit: Its unit.
        largest: End of the scale.
    """
    colours = (255 * colormap(torch.linspace(0, 1, 9, dtype=torch.float64))).round().int().tolist()
    stops = ", ".join(f"rgb({r},{g},{b})" for r, g, b in colours)
    return (
        f'<div style="padding: 0 0.8em 0.6em; font-size: 0.8em">{name} [{unit}]'
        f'<div style="height: 0.9em; border-radius: 2px; background: linear-gradient(to right, {stops})"></div>'
        '<div style="display: flex; justify-content: space-between">'
        f"<span>0</span><span>{0.5 * largest:.3g}</span><span>{largest:.3g} and more</span></div></div>"
    )


# From, in Pa, to the next one. Gels and muscle at rest: Levental, Georges & Janmey 2007, "Soft biological materials and
# their impact on cell function"; foam, rubber, cork, leather and plastics: Ashby 2011, "Materials Selection in
# Mechanical Design", chart of modulus and density. The limits are rounded to powers of ten.
FEELS = (
    (0.0, "soft jelly"),
    (1e3, "jelly"),
    (1e4, "muscle at rest"),
    (1e5, "soft foam"),
    (1e6, "rubber"),
    (1e7, "cork"),
    (1e8, "leather"),
    (1e9, "hard plastic"),
    (1e10, "metal or stone"),
)

_UNITS = ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa"), (0.0, "Pa"))


def like(stiffness: float) -> str:
    """The material whose Young's modulus [Pa] is nearest, in words."""
    return next(name for least, name in reversed(FEELS) if stiffness >= least)


def in_pascal(stiffness: float) -> str:
    """A modulus [Pa] with three digits and a unit, such as ``9 kPa``."""
    size, unit = next((size, unit) for size, unit in _UNITS if stiffness >= size)
    return f"{stiffness / (size or 1.0):.3g} {unit}"
