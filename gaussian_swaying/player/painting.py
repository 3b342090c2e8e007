"""Parts of the object that are painted on the live page."""

from __future__ import annotations

import math
import shutil
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.labelling import alike, connected
from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.player.pictures import Eye
from gaussian_swaying.player.session import Session, Snapshot
from gaussian_swaying.rendering.brush import Seen, seen, touched
from gaussian_swaying.rendering.tints import TINTS
from gaussian_swaying.simulation.simulation import Simulation

DEPTH_SIDE = 640  # most pixels of the longer side of the picture that says what is hidden
SLACK = 0.01  # longest sides that something may lie behind that picture and still be on the surface
NEAR = 5.0  # pixels within which the dabs of a double click lie
MOST_CORNERS, WIDEST_BRUSH = 1000, 1000.0  # of a path; radius [pixels]
TOGETHER: dict[str, Callable[..., Tensor]] = {"what is connected": connected, "what looks alike": alike}
FILE = "parts.npz"

MOST_KEPT = 100  # strokes that can be taken back


@dataclass(frozen=True, eq=False)
class Stroke:
    """A stroke, and what it replaced.

    Attributes:
        part: The part to which it gave Gaussians.
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
            index: The Gaussians, each once, int64, shape (M,).
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


@dataclass(eq=False)
class Mark:
    """Tells a stroke of a browser from others.

    Attributes:
        start: Where it began [pixels].
        length: How far it went from there [pixels].
    """

    key: str
    start: list[float]
    length: float = 0.0

    def is_dab(self, key: str, place: list[float]) -> bool:
        """True if a stroke has this key and stayed at a place [pixels]."""
        return key == self.key and self.length <= NEAR and math.dist(self.start, place) <= NEAR


class Painting:
    """Paints the parts of the scene at rest; the simulation takes them when they are applied.

    Args:
        session: The session.
        scratch: A folder for the files that are applied.

    Attributes:
        on: Whether strokes paint; the session is paused and at rest meanwhile.
        roles: Roles whose tints are shown (see :func:`.tints.by_role`), shape (N,), or None.
    """

    def __init__(self, session: Session, scratch: Path) -> None:
        self.session, self._folder = session, scratch / "painted"
        self.on = False
        self.roles: Tensor | None = None
        self._strokes: Strokes | None = None
        self._source: tuple[str, ...] = ()  # of the Gaussians that they paint
        self._mark: Mark | None = None  # of the last stroke
        self._view: tuple[Any, Seen] | None = None  # of the last camera
        self._paused = False  # whether the session was, before
        self._numbers = count(1)  # of the files that were applied

    def begin(self) -> None:
        if self.on:
            return
        if self.session.settings.copies:
            raise ValueError("Parts are painted on one object: leave out `copies`.")
        with self.session.lock:
            self._adopt(self.session.simulation)
        self.on = True
        self._paused = self.session.paused
        self.session.pause()
        self.session.reset()
        self._show()

    def stop(self) -> None:
        """Stop painting and keep the strokes; a simulation that ran before goes on."""
        if self.on:
            self.on = False
            self._show()
            self.session.pause(self._paused)

    def forget(self) -> None:
        self.stop()
        self._strokes = self._view = self._mark = None

    def shown(self) -> dict[str, Any]:
        """State of the painting for the page (JSON): parts with tint and count, and possible actions."""
        strokes = self._strokes
        scene = self.session.simulation.scene
        found: dict[str, Any] = {"on": self.on, "apply": strokes is not None, "parts": []}
        found |= {"save": strokes is not None or scene.parts is not None, "undo": bool(strokes) and self.on}
        if strokes is not None and self.on:
            counts = torch.bincount(strokes.labels, minlength=len(strokes.known)).tolist()
            many = {part.name: number for part, number in zip(strokes.known, counts, strict=True)}
            for name, part in choices(strokes.known).items():
                tint = None if part.role == "soft" else TINTS.get(part.role, (190, 190, 190))
                found["parts"].append({"name": name, "tint": tint, "count": many.get(part.name, 0)})
        return found

    def _adopt(self, simulation: Simulation) -> Strokes:
        scene, settings = simulation.scene, self.session.settings.scene
        source = (str(settings.ply), str(settings.generator), str(len(scene.drawn)))
        if self._strokes is None or source != self._source:
            self._source = source
            everything = Parts(torch.zeros(len(scene.drawn)), [Part("soft")])
            self._strokes = Strokes(scene.parts or everything)
        return self._strokes

    def _show(self) -> None:
        drawn, roles = self.session.simulation.scene.drawn, None
        if self._strokes is not None and self.on:
            roles = self._strokes.roles if bool(drawn.all()) else self._strokes.roles[drawn]
        self.roles = roles

    def paint(self, key: str, told: Mapping[str, Any]) -> None:
        """Handle a brush message of a browser; ignored while painting is off.

        Args:
            told: Its message: ``path`` in its window [pixels], the ``part``, and how it looks (:class:`.Eye`). A piece
                of a stroke has the ``radius`` [pixels], whether it goes ``through`` and whether it is the ``first``; a
                double click has ``how``, a key of :data:`TOGETHER`.
        """
        if not self.on:
            return
        path = torch.tensor(told["path"], dtype=torch.float64)
        radius, how = float(told["radius"]), told.get("how")
        if not (
            path.ndim == 2 and path.shape[1] == 2 and 0 < len(path) <= MOST_CORNERS and bool(path.isfinite().all())
        ):
            raise ValueError("the path of the brush cannot be")
        if not 0 < radius <= WIDEST_BRUSH or how not in (None, *TOGETHER):
            raise ValueError("the brush cannot be")
        eye = Eye.told(told)
        with self.session.lock:
            snapshot = self.session.snapshot
            strokes = self._adopt(snapshot.simulation)
            view = self._seen(snapshot, eye)
        part = choices(strokes.known).get(told["part"])
        if part is None:  # another scene has others
            return
        corners = path.tolist()
        if how is not None:
            for _ in range(2):  # the double click itself
                last = strokes.last
                if last is not None and isinstance(last.mark, Mark) and last.mark.is_dab(key, corners[0]):
                    strokes.take_back()
            found = self._hangs_together(snapshot.simulation, view, path, radius, how)
            strokes.paint(part, _in_source(snapshot.simulation, found))
        else:
            mark = self._mark
            goes_on = mark is not None and mark.key == key and not told["first"]
            if mark is None or not goes_on:
                mark = self._mark = Mark(key, corners[0])
            mark.length = max(mark.length, *(math.dist(mark.start, corner) for corner in corners))
            index = touched(view, path, radius, bool(told["through"]))
            strokes.paint(part, _in_source(snapshot.simulation, index), mark, goes_on)
        self._show()

    def _seen(self, snapshot: Snapshot, eye: Eye) -> Seen:
        key = (snapshot.number, eye.size, eye.fov, eye.near, eye.matrix.tolist())
        if self._view is not None and self._view[0] == key:
            return self._view[1]
        painter, scene = snapshot.simulation.painter, snapshot.simulation.scene
        share = min(1.0, DEPTH_SIDE / max(eye.size))
        small = eye.camera(scene, *(max(1, round(share * side)) for side in eye.size))
        with torch.no_grad(), snapshot.simulation.turn:
            gaussians = painter.deformed(snapshot.state)
            means = gaussians.means
            picture = painter.draw(gaussians, torch.zeros_like(means), small.to(means.device, means.dtype))
            view = seen(means, gaussians.covariances, eye.camera(scene, *eye.size), picture, SLACK * scene.size)
        self._view = (key, view)
        return view

    def _hangs_together(self, simulation: Simulation, view: Seen, place: Tensor, radius: float, how: str) -> Tensor:
        """All that hangs together with the Gaussian in front next to a place [pixels]; none beside the object."""
        index = touched(view, place[:1], max(NEAR, radius))
        if len(index) == 0:
            return index
        centre = torch.stack([view.column[index], view.row[index]], -1).double()
        nearest = index[(centre - place[0]).square().sum(-1).argmin()]
        with simulation.turn:
            cloud = simulation.scene.model.to_cloud().to("cpu")
        return TOGETHER[how](cloud, cloud.means[nearest].tolist()).nonzero()[:, 0]

    def take_back(self) -> None:
        if self._strokes is not None:
            self._strokes.take_back()
            self._show()

    def apply(self) -> None:
        strokes, session = self._strokes, self.session
        if strokes is None:
            return
        parts, path = strokes.parts(), self._folder / str(next(self._numbers)) / FILE
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
        for folder in self._folder.iterdir():
            if str(folder / FILE) not in kept:
                shutil.rmtree(folder)

    def saved(self, path: Path) -> bytes:
        """Write the painted parts to a file and return its content."""
        parts = self.session.simulation.scene.parts if self._strokes is None else self._strokes.parts()
        if parts is None:
            raise ValueError("The scene has no parts: paint some first.")
        return parts.save(path).read_bytes()

    def as_saved(self, text: str) -> str:
        """A configuration for download, whose parts file lies beside it."""
        path = Path(str(self.session.settings.scene.parts))
        if not path.is_relative_to(self._folder):
            return text
        return f"# Save the parts, too, and run it in their folder\n{text.replace(str(path), FILE)}"


def _in_source(simulation: Simulation, index: Tensor) -> Tensor:
    drawn = simulation.scene.drawn
    return index if bool(drawn.all()) else drawn.nonzero()[:, 0][index]


def choices(known: Sequence[Part]) -> dict[str, Part]:
    """The parts on offer, by their names on the page: existing ones, and one of each role."""
    found = {part.name if part.name == part.role else f"{part.name} ({part.role})": part for part in known}
    names = {part.name for part in known}
    return found | {role: Part(role, role) for role in ROLES if role not in names}
