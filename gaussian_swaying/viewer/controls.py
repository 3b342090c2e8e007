"""The page of a live wind tunnel: its controls, and their effect on the session."""

from __future__ import annotations

import html
import math
import os
import shutil
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from torch import Tensor

from gaussian_swaying._checks import one_line
from gaussian_swaying._devices import in_double
from gaussian_swaying._inputs import spare_memory
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.formats import FORMATS, read_gaussians
from gaussian_swaying.gaussians.labelling import alike, connected
from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.mpm.materials import MATERIALS, name_of
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.rendering.brush import Seen, seen, touched
from gaussian_swaying.rendering.cameras.camera import Camera, resized_intrinsics
from gaussian_swaying.rendering.passes import PASSES, colormap
from gaussian_swaying.rendering.tints import TINTS
from gaussian_swaying.simulation.draw import speed_scale
from gaussian_swaying.simulation.model import POLAR, angles_of, flow_of, number
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.suggest import suggest
from gaussian_swaying.viewer.pictures import FilmStrip, under_cursor
from gaussian_swaying.viewer.screen import Panel, Screen
from gaussian_swaying.viewer.session import Session, Snapshot
from gaussian_swaying.viewer.streams import BrushMove

KINDS = {"Sway": "SineSway", "Gusts": "UniformGust", "Noise": "GaussianGust"}
WIDEST = 500.0  # range of a slider
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
                name = f"wind.modulations.{place}.{field}"
                control = found[field] = number_control(self.gui, name, field.capitalize(), float(value))
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


def number_control(gui: Any, name: str, label: str, value: float) -> Any:
    """A control of a number that may change: a slider if its range has two ends within reach, else a field."""
    known = number(name)
    label += f" [{known.unit}]" if known.unit else ""
    wide = known.high - known.low
    if wide <= WIDEST:
        return gui.add_slider(label, known.low, known.high, wide / 100, value)
    low, high = (None if math.isinf(end) else end for end in (known.low, known.high))
    return gui.add_number(label, value, min=low, max=high, step=0.01)


def _plain(modulation: Any) -> dict[str, Any]:
    return {"class_path": modulation["class_path"], "init_args": dict(modulation.get("init_args") or {})}


def _name(modulation: dict[str, Any]) -> str:
    kind = modulation["class_path"].rsplit(".", 1)[-1]
    return next((name for name, known in KINDS.items() if known == kind), kind)


if TYPE_CHECKING:
    import viser


class Holding:
    """Grabs the object where it is clicked, and pins the material in a box.

    Args:
        controls: The panel; a folder of it is open.
    """

    def __init__(self, controls: Panel) -> None:
        self._controls, self.page = controls, controls.page
        self.session, self.server = controls.session, controls.server
        self._pin: Any = None
        self._handle: Any = None
        self._grabbed = False  # whether what the handle pulls is held by now
        gui = self.server.gui
        gui.add_markdown("Click on the object to take hold of it, then drag the axes that appear.")
        self.release = gui.add_button("Let go of it", disabled=True)
        self.new_pin = gui.add_button("New pin box", hint="Drag it over what should be held, at rest")
        self.pin_size = gui.add_slider("Size of the box [% of the object]", 2, 100, 1, 15)
        self.hold = gui.add_button("Hold what is in the box", disabled=True)
        self.free = gui.add_button("Let go of all pins")
        controls.on(self.release.on_click, self.let_go)
        controls.on(self.new_pin.on_click, self._place_pin)
        controls.on(self.pin_size.on_update, self._size_pin)
        controls.on(self.hold.on_click, self._hold_box)
        controls.on(self.free.on_click, lambda: self.session.change({"solver.boundaries": []}))
        controls.on(self.server.scene.on_click(), self._clicked, tell_event=True)

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
        self._controls.on(self._handle.on_update, self._dragged)
        self.release.disabled = False

    def _dragged(self) -> None:
        if self._handle is not None:
            self.session.drag([float(x) for x in self._handle.position])

    def let_go(self) -> None:
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

    def follow(self) -> None:
        """Remove the handle of the mouse if the session has released the material."""
        if self._handle is not None and self._grabbed and not self.session.pulls:
            self.let_go()
        self._grabbed = self._handle is not None and self.session.pulls

    def forget_box(self) -> None:
        """Remove the box for pins, as there is another scene."""
        if self._pin is not None:
            self._pin.remove()
            self._pin = None
            self.hold.disabled = True

    def places(self) -> np.ndarray:
        """Places at rest of the material points that pins and handles hold [scene units], shape (N, 3)."""
        with self.session.lock:  # a change binds the solver anew
            scene, solver = self.session.simulation.scene, self.session.simulation.solver
        held = torch.zeros(scene.points.count, dtype=torch.bool, device=scene.points.position.device)
        for boundary in solver.framed(scene.frame):
            if isinstance(boundary, PinnedRegion):
                held |= boundary.particle_mask(scene.points.position)
        return scene.frame.point_to_scene(in_double(scene.points.position[held])).cpu().numpy()


MOST_KEPT = 100  # strokes that can be taken back


@dataclass(frozen=True, eq=False)
class Stroke:
    """A stroke, and what it replaced.

    Attributes:
        part: The part to which it gave Gaussians.
        mark: As in :meth:`Strokes.paint`.
        index: The Gaussians that it changed, each once, shape (M,).
        labels: Their labels before, shape (M,).
        known: The parts before.
    """

    part: Part
    mark: Hashable
    index: Tensor
    labels: Tensor
    known: tuple[Part, ...]


class Strokes:
    """The labels of all Gaussians of a splat, stroke by stroke.

    Args:
        parts: The parts at first.

    Attributes:
        known: The parts that there are.
        labels: The part of each Gaussian, as its place in ``known``, int64, shape (N,).
        roles: Index of each Gaussian's role in :data:`~gaussian_swaying.gaussians.parts.ROLES`, uint8, shape (N,);
            another tensor after each change.
    """

    def __init__(self, parts: Parts) -> None:
        self.labels, self.known = parts.labels.clone(), parts.parts
        self._past: deque[Stroke] = deque(maxlen=MOST_KEPT)
        self.roles = self._roles_of(self.labels)

    def __len__(self) -> int:
        """The number of strokes that can be taken back."""
        return len(self._past)

    @property
    def last(self) -> Stroke | None:
        """The last stroke, or None."""
        return self._past[-1] if self._past else None

    def parts(self) -> Parts:
        return Parts(self.labels.clone(), self.known)

    def paint(self, part: Part, index: Tensor, mark: Hashable = None, goes_on: bool = False) -> None:
        """Give Gaussians to a part, which is new or the one with its name; nothing happens if it has them all.

        Args:
            part: The part.
            index: The Gaussians, each once, int64, shape (M,).
            mark: Anything that tells strokes apart.
            goes_on: Whether this belongs to the last stroke, if part and mark are the same; both go back together.
        """
        names, known = [each.name for each in self.known], self.known
        place = names.index(part.name) if part.name in names else len(names)
        index = index[self.labels[index] != place]
        if len(index) == 0:
            return
        labels = self.labels[index]
        last = self.last
        if goes_on and last is not None and (last.part, last.mark) == (part, mark):
            self._past.pop()
            index, labels, known = torch.cat([last.index, index]), torch.cat([last.labels, labels]), last.known
        self._past.append(Stroke(part, mark, index, labels, known))
        self.known = (*self.known[:place], part, *self.known[place + 1 :])
        self._label(index, torch.full_like(index, place))

    def take_back(self) -> None:
        """Take the last stroke back; nothing happens without one."""
        if self._past:
            last = self._past.pop()
            self.known = last.known
            self._label(last.index, last.labels)

    def _label(self, index: Tensor, labels: Tensor) -> None:
        self.labels[index] = labels
        roles = self.roles.clone()
        roles[index] = self._roles_of(labels)
        self.roles = roles

    def _roles_of(self, labels: Tensor) -> Tensor:
        return torch.tensor([ROLES.index(part.role) for part in self.known], dtype=torch.uint8)[labels]


if TYPE_CHECKING:
    import viser

MOST_WAITING = 1000  # moves of brushes
DEPTH_SIDE = 640  # most pixels of the longer side of the picture that says what is hidden
SLACK = 0.01  # longest sides that something may lie behind that picture and still be on the surface
NEAR = 5.0  # pixels within which the dabs of a double click lie
JOINED, ALIKE = "what is connected", "what looks alike"
FILE = "parts.npz"


@dataclass(eq=False)
class Mark:
    """Tells a stroke of a browser from others.

    Attributes:
        key: The browser.
        start: Where it began [pixels].
        length: How far it went from there [pixels].
    """

    key: str
    start: list[float]
    length: float = 0.0

    def is_dab(self, key: str, place: list[float]) -> bool:
        """True if the stroke is one of a browser, and stayed at a place [pixels]."""
        return key == self.key and self.length <= NEAR and math.dist(self.start, place) <= NEAR


class Painting:
    """Paints the parts of the scene at rest; the simulation takes them when they are applied.

    Args:
        controls: The panel; a folder of it is open.
    """

    def __init__(self, controls: Panel) -> None:
        self.page, self.session = controls.page, controls.session
        self._strokes: Strokes | None = None
        self._source: tuple[str, ...] = ()  # of the Gaussians that they paint
        self._choices: dict[str, Part] = {}
        self._mark: Mark | None = None  # of the last stroke
        self._waiting: deque[tuple[str, BrushMove]] = deque()
        self._view: tuple[Any, Seen] | None = None  # of the last camera
        self._paints = False
        self._paused = False  # whether the session was, before
        self._numbers = count(1)  # of the files that were applied
        gui = controls.server.gui
        gui.add_markdown(
            "Drag over the object to paint it. With Shift, and with other buttons, the mouse turns the view."
        )
        self.on = gui.add_checkbox("Paint", False, hint="The object stays at rest meanwhile")
        self.part = gui.add_dropdown("Paint as", ROLES, initial_value="held")
        self.size = gui.add_slider("Brush [pixels]", 4, 400, 2, 40)
        self.through = gui.add_checkbox("Hidden, too", False, hint="The brush reaches through the object")
        self.double = gui.add_dropdown("Double click", (JOINED, ALIKE), hint="From one Gaussian to the next")
        self.back = gui.add_button("Undo the stroke", disabled=True)
        self.apply = gui.add_button("Apply the parts", disabled=True, hint="The simulation takes them, from rest")
        self.save = gui.add_button("Save the parts", disabled=True, hint=f"A file {FILE}, for `scene.parts`")
        self.legend = gui.add_html("", visible=False)
        controls.on(self.on.on_update, lambda: self._begin() if self.on.value else self.stop())
        controls.on(self.size.on_update, self._tell_brushes)
        controls.on(self.back.on_click, self._take_back)
        controls.on(self.apply.on_click, self._apply)
        controls.on(self.save.on_click, self._save, tell_event=True)
        self.page.brushes.take = self._came
        self._show()

    # ---- on and off

    def _begin(self) -> None:
        if self._paints:
            return
        if self.session.settings.copies:
            self.on.value = False  # type: ignore[misc]
            self.page.tell("Parts are painted on one object: leave out `copies`.")
            return
        with self.session.lock:
            self._adopt(self.session.simulation)
        self._paints = True
        self._paused = self.session.paused
        self.session.pause()
        self.session.reset()
        self._show()
        self._tell_brushes()

    def stop(self) -> None:
        """Paint no longer; the simulation goes on if it did before, and what was painted is kept."""
        if self._paints:
            self._paints = False
            self.on.value = False  # type: ignore[misc]
            self._show()
            self._tell_brushes()
            self.session.pause(self._paused)

    def forget(self) -> None:
        self.stop()
        self._strokes = self._view = self._mark = None
        self._show()

    def _adopt(self, simulation: Simulation) -> Strokes:
        """The strokes on the Gaussians of a simulation; those on others are forgotten."""
        scene, settings = simulation.scene, self.session.settings.scene
        source = (str(settings.ply), str(settings.generator), str(len(scene.drawn)))
        if self._strokes is None or source != self._source:
            self._source = source
            everything = Parts(torch.zeros(len(scene.drawn)), [Part("soft")])
            self._strokes = Strokes(scene.parts or everything)
        return self._strokes

    def _tell_brushes(self) -> None:
        self.page.brushes.tell(self._paints, 0.5 * self.size.value)

    def _show(self) -> None:
        strokes, scene = self._strokes, self.session.simulation.scene
        on = strokes is not None and self._paints
        roles = None
        if strokes is not None and on:
            roles = strokes.roles if bool(scene.drawn.all()) else strokes.roles[scene.drawn]
        self.page.roles = roles  # at once, as other threads draw them
        self.page.redraw()
        self.back.disabled = not on or strokes is None or len(strokes) == 0
        self.apply.disabled, self.save.disabled = strokes is None, strokes is None and scene.parts is None
        self.legend.visible = on
        if strokes is None or not on:
            return
        self._choices = choices(strokes.known)
        if tuple(self._choices) != self.part.options:
            self.part.options = tuple(self._choices)
        counts = torch.bincount(strokes.labels, minlength=len(strokes.known)).tolist()
        self.legend.content = parts_legend(strokes.known, counts)

    # ---- strokes

    def _came(self, key: str, move: BrushMove) -> None:
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append((key, move))
            self.page.turns.ask("brush", self._take)

    def _take(self) -> None:
        try:
            while self._waiting:
                key, move = self._waiting.popleft()
                if self._paints:
                    self._paint(key, move)
        finally:
            self._show()
            if self._waiting:  # after an error
                self.page.turns.ask("brush", self._take)

    def _paint(self, key: str, move: BrushMove) -> None:
        with self.session.lock:
            snapshot = self.session.snapshot
            strokes = self._adopt(snapshot.simulation)
            if not self._choices:
                self._choices = choices(strokes.known)
            view = self._seen(snapshot, move)
        part = self._choices.get(self.part.value)
        if part is None:  # another scene has others
            return
        path = torch.tensor(move.path, dtype=torch.float64)
        if move.kind == "part":
            for _ in range(2):  # the double click itself
                last = strokes.last
                if last is not None and isinstance(last.mark, Mark) and last.mark.is_dab(key, move.path[0]):
                    strokes.take_back()
            found = self._hangs_together(snapshot.simulation, view, path)
            strokes.paint(part, _in_source(snapshot.simulation, found))
            return
        mark = self._mark
        goes_on = mark is not None and mark.key == key and not move.first
        if mark is None or not goes_on:
            mark = self._mark = Mark(key, move.path[0])
        mark.length = max(mark.length, *(math.dist(mark.start, corner) for corner in move.path))
        index = touched(view, path, 0.5 * self.size.value, self.through.value)
        strokes.paint(part, _in_source(snapshot.simulation, index), mark, goes_on)

    def _seen(self, snapshot: Snapshot, move: BrushMove) -> Seen:
        """The Gaussians as a browser sees them; kept until it looks from elsewhere, or they move."""
        key = (snapshot.number, move.size, move.fov, move.near, move.matrix)
        if self._view is not None and self._view[0] == key:
            return self._view[1]
        painter, camera = snapshot.simulation.painter, self.page.camera_of(move)
        share = min(1.0, DEPTH_SIDE / max(move.size))
        width, height = (max(1, round(share * side)) for side in move.size)
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        intrinsics, *_ = resized_intrinsics(*move.size, fx, fy, cx, cy, width, height)
        small = Camera(camera.world_to_camera, intrinsics, width, height, camera.near)
        with torch.no_grad(), snapshot.simulation.turn:
            gaussians = painter.deformed(snapshot.state)
            means = gaussians.means
            picture = painter.draw(gaussians, torch.zeros_like(means), small.to(means.device, means.dtype))
            view = seen(means, gaussians.covariances, camera, picture, SLACK * snapshot.simulation.scene.size)
        self._view = (key, view)
        return view

    def _hangs_together(self, simulation: Simulation, view: Seen, place: Tensor) -> Tensor:
        """All that hangs together with the Gaussian in front next to a place [pixels]; none beside the object."""
        index = touched(view, place[:1], max(NEAR, 0.5 * self.size.value))
        if len(index) == 0:
            return index
        centre = torch.stack([view.column[index], view.row[index]], -1).double()
        nearest = index[(centre - place[0]).square().sum(-1).argmin()]
        self.page.progress(0.5, "Looking for what hangs together")
        try:
            with simulation.turn:
                cloud = simulation.scene.model.to_cloud().to("cpu")
            seed = cloud.means[nearest].tolist()
            return (connected if self.double.value == JOINED else alike)(cloud, seed).nonzero()[:, 0]
        finally:
            self.page.progress(None)

    def _take_back(self) -> None:
        if self._strokes is not None:
            self._strokes.take_back()
            self._show()

    # ---- what comes of it

    def _apply(self) -> None:
        strokes, session = self._strokes, self.session
        if strokes is None:
            return
        painted = self.page.scratch / "painted"
        parts, path = strokes.parts(), painted / str(next(self._numbers)) / FILE
        path.parent.mkdir(parents=True)
        parts.save(path)
        changes: dict[str, Any] = {"scene.parts": str(path)}
        with session.lock:
            scene, settings = session.simulation.scene, session.settings
            before = (
                torch.zeros(len(parts), dtype=torch.bool) if scene.parts is None else scene.parts.mask(role="still")
            )
            if settings.scene.longest_side is not None and not torch.equal(before, parts.mask(role="still")):
                changes |= {"scene.longest_side": None, "scene.metres_per_unit": scene.frame.metres_per_unit}
        self.stop()
        session.change(changes)
        with session.lock:  # so that none is being read
            kept = {str(known.scene.parts) for known in session.reachable()} | {str(path)}
        for folder in painted.iterdir():
            if str(folder / FILE) not in kept:
                shutil.rmtree(folder)

    def _save(self, event: viser.GuiEvent) -> None:
        parts = self.session.simulation.scene.parts if self._strokes is None else self._strokes.parts()
        if parts is not None and event.client is not None:
            with tempfile.TemporaryDirectory() as folder:
                content = parts.save(Path(folder) / FILE).read_bytes()
            event.client.send_file_download(FILE, content, save_immediately=True)

    def as_saved(self, text: str) -> str:
        """A configuration that is saved from the page; parts whose file goes away with the page lie beside it."""
        path = Path(str(self.session.settings.scene.parts))
        if not path.is_relative_to(self.page.scratch):
            return text
        return f"# Save the parts, too, and run it in their folder\n{text.replace(str(path), FILE)}"


def _in_source(simulation: Simulation, index: Tensor) -> Tensor:
    drawn = simulation.scene.drawn
    return index if bool(drawn.all()) else drawn.nonzero()[:, 0][index]


def choices(known: Sequence[Part]) -> dict[str, Part]:
    """The parts that Gaussians can become, by their names on the page: those that there are, and one of each role."""
    found = {part.name if part.name == part.role else f"{part.name} ({part.role})": part for part in known}
    names = {part.name for part in known}
    return found | {role: Part(role, role) for role in ROLES if role not in names}


def parts_legend(known: Sequence[Part], counts: Sequence[int]) -> str:
    """The parts with their tints and how many Gaussians they have, as HTML.

    Args:
        known: The parts.
        counts: How many Gaussians each has.
    """
    lines = []
    for part, many in zip(known, counts, strict=True):
        tint = TINTS.get(part.role, (190, 190, 190))
        colour = "none" if part.role == "soft" else f"rgb({','.join(map(str, tint))})"
        square = f"display: inline-block; width: 0.8em; height: 0.8em; border: 1px solid #888; background: {colour}"
        name = html.escape(part.name if part.name == part.role else f"{part.name} ({part.role})")
        lines.append(f'<div><span style="{square}"></span> {name}: {many:,} Gaussians</div>')
    return f'<div style="padding: 0 0.8em 0.6em; font-size: 0.8em">{"".join(lines)}</div>'


if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

SPARE = 1 << 26
"""Memory that a splat may take besides a multiple of its size [bytes]: less than elsewhere, as others may upload it."""


def settings_of_splat(
    parser: ArgumentParser,
    path: str | os.PathLike[str],
    device: torch.device,
    folder: Path,
    further: Sequence[str] = (),
    tell: Callable[[float, str], None] = lambda share, what: None,
    quick: bool = False,
) -> Namespace:
    """The settings that the preview suggests for a splat.

    Args:
        parser: From :meth:`Simulation.parser`.
        path: The splat.
        device: Device of the simulation.
        folder: Gets ``parts.npz``, which the settings name, if the splat has parts.
        further: Options that replace what is suggested.
        tell: Called with the share that is done, from 0 to 1, and the name of the next task.
        quick: Whether the grid is a coarser one than that of its starter.
    """
    tell(0.05, "Reading the splat")
    with spare_memory(SPARE):
        gaussians = read_gaussians(path)
    tell(0.15, "Looking for a region, pins, a grid and how it sways")
    found = suggest(gaussians, quality="draft" if quick else "normal", device=device.type)
    found.to_yaml(folder / "starter.yaml", splat=Path(path))
    return parser.parse_args(["--config", str(folder / "starter.yaml"), "--device", device.type, *further])


if TYPE_CHECKING:
    import viser
    from jsonargparse import Namespace

Folder = tempfile.TemporaryDirectory[str]
RECORD = "Record a video (simulated time)"


class Files:
    """Saves videos and configurations, and loads configurations and splats.

    Args:
        controls: The panel; a folder of it is open.
        loaded: Called when another scene is there.
        as_saved: Changes the text of a configuration before it is saved.
    """

    def __init__(self, controls: Panel, loaded: Callable[[], None], as_saved: Callable[[str], str]) -> None:
        self._loaded, self._as_saved, self.page, self.session = loaded, as_saved, controls.page, controls.session
        self._kinds = [ending for format in FORMATS.values() if format.read for ending in format.endings]
        self._upload: Folder | None = None  # where the splat lies that was loaded
        gui, elsewhere = controls.server.gui, self.page.door.token is not None
        self.record = gui.add_button(
            RECORD, hint="The video shows real time: if the simulation is slower, it takes longer to record"
        )
        self.save = gui.add_button("Save the configuration", hint="A YAML file that `gaussian-swaying sim` runs")
        self.load_settings = gui.add_upload_button(
            "Load a configuration (.yaml)",
            mime_type=".yaml,.yml",
            disabled=elsewhere,  # a configuration can name files of this computer
            hint="Only on a page that other computers cannot open" if elsewhere else "Such as one that was saved here",
        )
        kinds = ",".join(self._kinds)
        self.load = gui.add_upload_button("Load a splat", mime_type=kinds, hint=f"One of {kinds}")
        controls.on(self.record.on_click, self._toggle_recording, tell_event=True)
        controls.on(self.save.on_click, self._save, tell_event=True)
        controls.on(self.load.on_upload, lambda: self._load(self.load, self._splat))
        controls.on(self.load_settings.on_upload, lambda: self._load(self.load_settings, self._configuration))

    def _toggle_recording(self, event: viser.GuiEvent) -> None:
        if self.page.recording is None:
            self.page.recorder = event.client_id
            self.page.recording = FilmStrip()
            self.record.label = "Stop recording"
        else:
            self.stop_recording(event.client)

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        film, self.page.recording = self.page.recording, None
        self.record.label = RECORD
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
        text = self._as_saved(self.session.yaml())
        if self._upload is not None and self._upload.name in text:  # it goes away with the program
            text = "# Give the splat that you loaded: --scene.ply PATH\n" + text.replace(self._upload.name + "/", "")
        if event.client is not None:
            event.client.send_file_download("live.yaml", text.encode(), save_immediately=True)

    def _load(self, button: viser.GuiUploadButtonHandle, read: Callable[[bytes, str, Folder], Namespace]) -> None:
        self.load.disabled = self.load_settings.disabled = True
        threading.Thread(target=self._read, args=(button, read), name="load", daemon=True).start()

    def _read(self, button: viser.GuiUploadButtonHandle, read: Callable[[bytes, str, Folder], Namespace]) -> None:
        """Load an uploaded file; of its name, only the ending is used."""
        folder = Folder()
        try:
            try:
                settings = read(button.value.content, Path(button.value.name).suffix.lower(), folder)
            finally:  # before another file may come
                button._impl.value = replace(button.value, content=b"")
            self.page.progress(0.8, "Making the simulation")
            self.session.load(settings, partial(self._there, folder), self._ended)
        except Exception as error:
            self.page.tell(one_line(error))
            self._ended()
            folder.cleanup()

    def _ended(self) -> None:
        self.page.progress(None)
        self.load.disabled, self.load_settings.disabled = False, self.page.door.token is not None

    def _splat(self, content: bytes, suffix: str, folder: Folder) -> Namespace:
        path = Path(folder.name) / f"scene{suffix if suffix in self._kinds else '.ply'}"
        path.write_bytes(content)
        device = self.session.simulation.device
        quick = device.type == "cpu"  # no trial looks for a grid
        return settings_of_splat(self.session.parser, path, device, path.parent, tell=self.page.progress, quick=quick)

    def _configuration(self, content: bytes, suffix: str, folder: Folder) -> Namespace:
        """The settings in a configuration file; if its splat is not on this computer, they get the present one."""
        self.page.progress(0.1, "Reading the configuration")
        try:
            text = content.decode()
        except UnicodeDecodeError:
            raise ValueError("The configuration is not UTF-8 text: save it as UTF-8.") from None
        settings = parse_text(self.session.parser, text, ["--device", self.session.simulation.device.type])
        splat = self.session.settings.scene.ply
        if settings.scene.ply is not None and not Path(settings.scene.ply).exists():
            if splat is None:
                raise ValueError(f"The configuration is for {settings.scene.ply}, which is not here: load it first.")
            settings.scene.ply = splat
        return settings

    def _there(self, folder: Folder) -> None:
        """Adapt to another scene; called in the thread of the session."""
        if str(self.session.settings.scene.ply).startswith(folder.name):
            self._upload = folder  # and the one before goes
        self.page.turns.ask("loaded", self._loaded)


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
            with folder:
                label, value = name.removeprefix("forces."), model.value(name)
                control = self.forces[name] = number_control(self.server.gui, name, label, value)
            self.on(control.on_update, lambda name=name, control=control: self._set(name, control.value))

    def _picture(self) -> None:
        gui = self.server.gui
        self.shown = gui.add_dropdown("Show", [name for name, own in PASSES.items() if not own.air])
        self.by_browser = gui.add_checkbox(
            "Drawn by the browser", True, hint="Off: pictures from the server, whose colours depend on the view"
        )
        self.light = gui.add_slider("Light from [deg]", -180.0, 180.0, 1.0, 0.0)
        self.shading = gui.add_checkbox("Shading", True)
        self.arrow = gui.add_checkbox("Arrow of the wind", True)
        self.box = gui.add_checkbox("Box of the grid", False)
        self.pins = gui.add_checkbox("What is held", False, hint="Points that pins and handles hold, at rest")
        changed: dict[Callable[[], None], tuple[Any, ...]] = {
            self._show: (self.shown, self.by_browser),
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
        content = ""
        if self.shown.value == "force":
            content = legend("Force of the wind", "Pa", self.page.force_end)
        elif self.shown.value == "wind":
            content = legend("Speed of the air", "m/s", speed_scale(simulation.stepper))
        self.legends.content, self.legends.visible = content, bool(content)

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
        self.page.shown, self.page.by_browser = self.shown.value, self.by_browser.value
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
