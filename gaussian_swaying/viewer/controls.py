"""The controls of the live page, and what they do to the session."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml

from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.viewer.film_strip import FilmStrip
from gaussian_swaying.viewer.pictures import SHOWN, under_cursor
from gaussian_swaying.viewer.scenes import settings_of_splat

if TYPE_CHECKING:
    import viser

    from gaussian_swaying.viewer.page import Page

MOST_SPEED = 30.0  # m/s
ARROW = 0.06  # length of the arrow of a wind of 1 m/s, in longest sides
GRIDS = {"coarse": 1.5, "normal": 1.0, "fine": 0.7}


class Controls:
    """Builds the panel and the handles in the scene.

    Args:
        page: The page.
    """

    def __init__(self, page: Page) -> None:
        self.page, self.session, self.server = page, page.session, page.server
        self.force_end = page.session.simulation.force_scale()
        self._upload: tempfile.TemporaryDirectory[str] | None = None
        self._pin: Any = None
        self._handle: Any = None
        self._grabbed = False  # whether what the handle pulls is held by now
        self._drawn_for: Any = None  # the simulation whose handles are drawn
        self._shader: dict[str, Any] | None = None  # the last one, while shading is off
        self._dx = float(self.session.settings.solver.dx)
        gui = self.server.gui
        self.health = gui.add_markdown("")
        self._running()
        with gui.add_folder("Wind"):
            self._wind()
        with gui.add_folder("Material"):
            self._material()
        with gui.add_folder("Pull and hold"):
            self._holding()
        with gui.add_folder("Picture", expand_by_default=False):
            self._picture()
        with gui.add_folder("Files"):
            self._files()
        self.draw_handles()

    # ---- groups of controls

    def _running(self) -> None:
        gui = self.server.gui
        self.pause = gui.add_button("Pause", icon=None, hint="Stop and go on")
        self.step = gui.add_button("Step", hint="One step, while paused")
        self.reset = gui.add_button("Reset", hint="Back to rest")
        self.speed = gui.add_slider("Speed [x real time]", 0.05, 1.0, 0.05, 1.0, hint="Slow motion below 1")
        self._on(self.pause.on_click, self._toggle)
        self._on(self.step.on_click, self.session.step)
        self._on(self.reset.on_click, self.session.reset)
        self._on(self.speed.on_update, lambda: self.session.pace(self.speed.value))

    def _wind(self) -> None:
        gui = self.server.gui
        speed, azimuth, elevation = (round(x, 1) for x in to_angles(self._flow()))
        self.wind_speed = gui.add_slider("Speed [m/s]", 0.0, MOST_SPEED, 0.1, min(speed, MOST_SPEED))
        self.azimuth = gui.add_slider("Direction [deg]", -180.0, 180.0, 1.0, azimuth, hint="About up; 0 is along x")
        self.elevation = gui.add_slider("Upwards [deg]", -90.0, 90.0, 1.0, elevation)
        self.gusts = gui.add_slider("Gusts [%]", 0, 100, 1, 0, hint="Replaces the gusts of the configuration")
        for control in (self.wind_speed, self.azimuth, self.elevation):
            self._on(control.on_update, self._blow)
        self._on(self.gusts.on_update, self._gust)

    def _material(self) -> None:
        gui, settings = self.server.gui, self.session.settings
        stiffness = round(min(max(math.log10(float(settings.material.E)), 2.0), 8.0), 2)
        self.stiffness = gui.add_slider("Stiffness [log10 of E in Pa]", 2.0, 8.0, 0.05, stiffness)
        self.damping = gui.add_slider("Damping [1/s]", 0.0, 10.0, 0.1, min(float(settings.solver.damping), 10.0))
        gravity = min(max(-float(settings.solver.gravity[2]), 0.0), 20.0)
        self.gravity = gui.add_slider("Gravity [m/s²]", 0.0, 20.0, 0.1, gravity)
        self.grid = gui.add_dropdown(
            "Grid", tuple(GRIDS), initial_value="normal", hint="A coarser grid is faster; starts again"
        )
        self._on(self.stiffness.on_update, lambda: self._set("material.E", float(f"{10**self.stiffness.value:.3g}")))
        self._on(self.damping.on_update, lambda: self._set("solver.damping", self.damping.value))
        self._on(self.gravity.on_update, lambda: self._set("solver.gravity", [0.0, 0.0, -self.gravity.value]))
        self._on(self.grid.on_update, lambda: self._set("solver.dx", float(f"{self._dx * GRIDS[self.grid.value]:.6g}")))

    def _holding(self) -> None:
        gui = self.server.gui
        gui.add_markdown("Click on the object to take hold of it, then drag the axes that appear.")
        self.release = gui.add_button("Let go of it", disabled=True)
        self.new_pin = gui.add_button("New pin box", hint="Drag it over what should be held, at rest")
        self.pin_size = gui.add_slider("Size of the box [% of the object]", 2, 100, 1, 15)
        self.hold = gui.add_button("Hold what is in the box", disabled=True)
        self.free = gui.add_button("Let go of all pins")
        self._on(self.release.on_click, self.let_go)
        self._on(self.new_pin.on_click, self._place_pin)
        self._on(self.pin_size.on_update, self._size_pin)
        self._on(self.hold.on_click, self._hold_box)
        self._on(self.free.on_click, lambda: self._set("solver.boundaries", []))
        self._on(self.server.scene.on_click(), self._clicked, tell_event=True)

    def _picture(self) -> None:
        gui = self.server.gui
        self.shown = gui.add_dropdown("Show", SHOWN, initial_value=SHOWN[0])
        self.light = gui.add_slider("Light from [deg]", -180.0, 180.0, 1.0, self._light_azimuth())
        self.shading = gui.add_checkbox("Shading", self.session.simulation.painter.shader is not None)
        self.streaks = gui.add_checkbox("Streaks of air", False, hint="Coloured by speed, near a plane along the wind")
        self.arrow = gui.add_checkbox("Arrow of the wind", True)
        self.box = gui.add_checkbox("Box of the grid", False)
        self.pins = gui.add_checkbox("What is held", False, hint="Points that pins and handles hold, at rest")
        changed: dict[Callable[[], None], tuple[Any, ...]] = {
            self._show: (self.shown, self.streaks),
            self._shade: (self.light, self.shading),
            self.draw_handles: (self.arrow, self.box, self.pins),
        }
        for what, controls in changed.items():
            for control in controls:
                self._on(control.on_update, what)

    def _files(self) -> None:
        gui = self.server.gui
        self.record = gui.add_button("Record a video")
        self.save = gui.add_button("Save the configuration", hint="A YAML file that `gaussian-swaying sim` runs")
        self.load = gui.add_upload_button("Load a splat (.ply)", mime_type=".ply")
        self._on(self.record.on_click, self._toggle_recording, tell_event=True)
        self._on(self.save.on_click, self._save, tell_event=True)
        self._on(self.load.on_upload, self._load)

    # ---- health

    def tell(self) -> None:
        """Write the figures in the corner."""
        session = self.session
        rates, health = session.rates(), session.snapshot.health
        running = "paused" if session.paused else f"{rates.real_time:.2g} x real time"
        lines = [
            f"**{self.page.pictures_per_second():.0f} pictures a second**, {running}",
            f"t = {health.time:.2f} s; {rates.substeps} substeps in a step of {rates.step:.3g} s; stretch "
            f"{health.stretch_min:.2f} to {health.stretch_max:.2f}",
        ]
        if self.page.recording is not None:
            lines.append(f"Recording: {self.page.recording.seconds:.1f} s")
        if session.problem:
            remedy = " Press **Reset** to start again." if session.broken else ""
            lines.append(f"⚠️ {session.problem}{remedy}")
        if self.page.notice:
            lines.append(f"_{self.page.notice}_")
        self.health.content = "\n\n".join(lines)
        if session.simulation is not self._drawn_for:
            self.draw_handles()
        if self._handle is not None and self._grabbed and not session.pulls:
            self.let_go()  # the session let go
        self._grabbed = self._handle is not None and session.pulls

    # ---- what they do

    def _on(self, subscribe: Callable[[Any], Any], what: Callable[..., None], tell_event: bool = False) -> None:
        """Do something in its turn when a browser uses a control; not when the program sets its value."""
        key = object()

        async def asked(event: Any) -> None:  # awaited, and not in one of viser's threads, so that the order stays
            if event.client is not None:
                self.page.turns.ask(key, partial(what, event) if tell_event else what)

        subscribe(asked)

    def _set(self, name: str, value: Any) -> None:
        self.session.change({name: value})

    def _toggle(self) -> None:
        self.session.pause(not self.session.paused)
        self.pause.label = "Go on" if self.session.paused else "Pause"

    def _flow(self) -> list[float]:
        return [float(x) for x in self.session.simulation.flows()[0].tolist()]

    def _blow(self) -> None:
        flow = from_angles(self.wind_speed.value, self.azimuth.value, self.elevation.value)
        self.session.change({"wind.flow": [round(x, 4) for x in flow], "wind.schedule": None})
        self._draw_arrow(flow)

    def _gust(self) -> None:
        gust = {"class_path": "UniformGust", "init_args": {"delta": self.gusts.value / 100, "interval": 0.2}}
        self.session.change({"wind.modulations": [gust] if self.gusts.value else []})

    def _show(self) -> None:
        self.page.shown, self.page.streaks = self.shown.value, self.streaks.value
        self.page.redraw()

    def _light_azimuth(self) -> float:
        shader = self.session.simulation.painter.shader
        light = getattr(shader, "light", None)
        return 0.0 if light is None else round(to_angles(light.tolist())[1])

    def _shade(self) -> None:
        given = yaml.safe_load(self.session.yaml()).get("shader")
        self._shader = given or self._shader or {"class_path": "DiffuseShader", "init_args": {"two_sided": True}}
        if not self.shading.value:
            self.session.change({"shader": None})
            return
        arguments = dict(self._shader.get("init_args") or {})
        old = arguments.get("light", [0.0, -1.0, 0.8])
        light = from_angles(1.0, self.light.value, to_angles(old)[2])
        arguments["light"] = [round(x, 4) for x in light]
        self.session.change({"shader": self._shader | {"init_args": arguments}})

    # ---- handles in the scene

    def draw_handles(self) -> None:
        """Draw the arrow of the wind, the box of the grid and the pins, again after another simulation is there."""
        self._drawn_for = self.session.simulation
        scene, server = self.session.simulation.scene, self.server.scene
        self._tip = server.add_transform_controls(
            "/wind/tip", scale=0.12 * scene.size, disable_rotations=True, disable_sliders=True, depth_test=False,
            visible=self.arrow.value,
        )  # fmt: skip
        self._on(self._tip.on_update, self._tip_moved)
        self._draw_arrow(self._flow())
        grid = self.session.snapshot.state.grid
        low = np.array(grid.offset) * grid.dx
        size = (np.array(grid.resolution) - 1) * grid.dx
        corners = torch.tensor(low + size * np.array(CORNERS), dtype=torch.float64)
        lines = scene.frame.point_to_scene(corners).cpu().numpy()[np.array(EDGES)]
        server.add_line_segments("/grid", lines, (120, 120, 120), thickness=1.5, visible=self.box.value)

        server.add_point_cloud(
            "/held", self._held(), (220, 120, 40), point_size=0.008 * scene.size, visible=self.pins.value
        )

    def _held(self) -> np.ndarray:
        """Places at rest of the material points that pins and handles hold [scene units], shape (N, 3)."""
        scene, body = self.session.simulation.scene, self.session.simulation.solver.bound.body
        held = torch.zeros(scene.points.count, dtype=torch.bool, device=scene.points.position.device)
        for boundary in body.boundaries:
            if isinstance(boundary, PinnedRegion):
                held |= boundary.particle_mask(scene.points.position)
        return scene.frame.point_to_scene(scene.points.position[held].double()).cpu().numpy()

    def _anchor(self) -> np.ndarray:
        """Where the arrow of the wind ends: just above the object."""
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
        """The tail of the arrow was dragged: another wind."""
        scene = self.session.simulation.scene
        along = torch.tensor(self._anchor() - np.array(self._tip.position), dtype=torch.float64)
        flow = scene.frame.direction_to_sim(along / (ARROW * scene.size)).tolist()
        speed, azimuth, elevation = to_angles(flow)
        self.wind_speed.value = round(min(speed, MOST_SPEED), 1)  # type: ignore[misc]
        self.azimuth.value = round(azimuth, 1)  # type: ignore[misc]
        self.elevation.value = round(elevation, 1)  # type: ignore[misc]
        self._blow()

    # ---- pull and hold

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with self.session.lock:
            place = under_cursor(self.session.snapshot, event.ray_origin, event.ray_direction)
        if place is None:
            return
        self.let_go()
        self.session.grab(place)
        size = self.session.simulation.scene.size
        self._handle = self.server.scene.add_transform_controls(
            "/pull", scale=0.25 * size, disable_rotations=True, depth_test=False, position=np.array(place)
        )
        self._on(self._handle.on_update, self._dragged)
        self.release.disabled = False

    def _dragged(self) -> None:
        if self._handle is not None:
            self.session.drag([float(x) for x in self._handle.position])

    def let_go(self) -> None:
        """Let go of what the mouse holds."""
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.remove()
        self.release.disabled = True
        self.session.let_go()

    def _place_pin(self) -> None:
        scene = self.session.simulation.scene
        place = tuple(scene.center.tolist())
        if self._pin is not None:
            place = self._pin.position
        self._pin = self.server.scene.add_transform_controls(
            "/pin", scale=0.2 * scene.size, disable_rotations=True, depth_test=False, position=place
        )
        self._size_pin()
        self.hold.disabled = False

    def _size_pin(self) -> None:
        if self._pin is not None:
            size = (self._pin_side(),) * 3
            self.server.scene.add_box("/pin/box", (220, 120, 40), size, wireframe=True)

    def _pin_side(self) -> float:
        return self.session.simulation.scene.size * self.pin_size.value / 100

    def _hold_box(self) -> None:
        """Add a pin that holds what is in the box at rest."""
        if self.session.settings.normalisation is not None:
            self.page.tell("Pins of this configuration are in normalised coordinates: write them into its file.")
            return
        centre, half = np.array(self._pin.position), 0.5 * self._pin_side()
        box = {"min": [float(f"{x:.6g}") for x in centre - half], "max": [float(f"{x:.6g}") for x in centre + half]}
        pin = {
            "class_path": "PinnedRegion",
            "init_args": {"kind": None, "region": {"class_path": "Box", "init_args": box}},
        }
        known = yaml.safe_load(self.session.yaml())["solver"].get("boundaries") or []
        self.session.change({"solver.boundaries": [*known, pin]})

    # ---- files

    def _toggle_recording(self, event: viser.GuiEvent) -> None:
        if self.page.recording is None:
            self.page.recorder = event.client_id
            self.page.recording = FilmStrip()
            self.record.label = "Stop recording"
        else:
            self.stop_recording(event.client)

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        """End the video, and send it to a browser."""
        film, self.page.recording = self.page.recording, None
        self.record.label = "Record a video"
        if film is None:
            return
        try:
            content = film.finish()
        except (ValueError, OSError) as error:
            self.page.tell(str(error))
            return
        if film.full:
            self.page.tell(f"The video has the greatest length, {film.seconds:.0f} s, and was saved.")
        if client is not None:
            client.send_file_download("wind.mp4", content, save_immediately=True)

    def _save(self, event: viser.GuiEvent) -> None:
        text = self.session.yaml()
        if self._upload is not None:  # it goes away with the program
            text = "# Give the splat that you loaded: --scene.ply PATH\n" + text.replace(self._upload.name + "/", "")
        if event.client is not None:
            event.client.send_file_download("live.yaml", text.encode(), save_immediately=True)

    def _load(self) -> None:
        self.load.disabled = True
        content = self.load.value.content
        threading.Thread(target=self._look_at, args=(content,), name="load", daemon=True).start()

    def _look_at(self, content: bytes) -> None:
        """Go on with an uploaded splat; its name is never used."""
        self.page.tell("Looking at the splat, which takes up to a minute.", 60.0)
        folder = tempfile.TemporaryDirectory()
        path = Path(folder.name) / "scene.ply"
        path.write_bytes(content)
        try:
            settings = settings_of_splat(self.session.parser, path, self.session.simulation.device)
            self.session.load(settings, lambda: self.page.turns.ask("loaded", lambda: self._loaded(folder)))
        except Exception as error:
            self.page.tell(" ".join(str(error).split()))
            folder.cleanup()
        finally:
            self.load._impl.value = replace(self.load.value, content=b"")
            self.load.disabled = False

    def _loaded(self, folder: tempfile.TemporaryDirectory[str]) -> None:
        """Another scene is there: what belongs to the old one goes, and the controls show its values."""
        self._upload = folder
        if self._pin is not None:
            self._pin.remove()
            self._pin = None
            self.hold.disabled = True
        settings = self.session.settings
        self._dx = float(settings.solver.dx)
        self.force_end = self.session.simulation.force_scale()
        speed, azimuth, elevation = (round(x, 1) for x in to_angles(self._flow()))
        shown = {
            self.wind_speed: min(speed, MOST_SPEED),
            self.azimuth: azimuth,
            self.elevation: elevation,
            self.stiffness: round(min(max(math.log10(float(settings.material.E)), 2.0), 8.0), 2),
            self.damping: min(float(settings.solver.damping), 10.0),
            self.gravity: min(max(-float(settings.solver.gravity[2]), 0.0), 20.0),
            self.grid: "normal",
            self.shading: self.session.simulation.painter.shader is not None,
        }
        for control, value in shown.items():
            control.value = value  # type: ignore[attr-defined]
        self.page.tell("", 0.0)
        self.page.look_from_start()
        self.draw_handles()


CORNERS = [[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
EDGES = [[a, b] for a in range(8) for b in range(a) if sum(map(abs, np.subtract(CORNERS[a], CORNERS[b]))) == 1]


def to_angles(flow: list[float]) -> tuple[float, float, float]:
    """Speed, direction about up [degrees] and elevation [degrees] of a vector, z up."""
    speed = math.sqrt(sum(x * x for x in flow))
    if speed == 0:
        return 0.0, 0.0, 0.0
    upwards = math.asin(max(-1.0, min(1.0, flow[2] / speed)))
    return speed, math.degrees(math.atan2(flow[1], flow[0])), math.degrees(upwards)


def from_angles(speed: float, azimuth: float, elevation: float) -> list[float]:
    """The vector of :func:`to_angles`."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return [speed * math.cos(e) * math.cos(a), speed * math.cos(e) * math.sin(a), speed * math.sin(e)]
