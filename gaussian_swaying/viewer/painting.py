"""The controls that paint parts: a brush on the object, and what hangs together by a double click."""

from __future__ import annotations

import html
import math
import shutil
import tempfile
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.labelling import alike, connected
from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.rendering.brush import Seen, seen, touched
from gaussian_swaying.rendering.cameras.camera import Camera, resized_intrinsics
from gaussian_swaying.rendering.tints import TINTS
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.brushes import BrushMove
from gaussian_swaying.viewer.screen import Panel
from gaussian_swaying.viewer.session import Snapshot
from gaussian_swaying.viewer.strokes import Strokes

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
        self.legend.content = legend(strokes.known, counts)

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


def legend(known: Sequence[Part], counts: Sequence[int]) -> str:
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
