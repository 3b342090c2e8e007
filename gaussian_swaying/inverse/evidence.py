"""Evidence of a fit: what films show, and how far variants are from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.least_squares import Block
from gaussian_swaying.inverse.tracks import Tracks
from gaussian_swaying.inverse.unknowns import FILM_START, Values
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

LEAST_FACING = 0.05
"""Least weight of the residuals of a point that is seen edge-on."""

MOMENTS, PATCHES = 4, 4
"""Parts of the time, and squares along each side of the grid over tracks and pixels, which sort residuals into clusters
of correlated errors."""

NOISE = 0.5
"""Distance of a track that its own error explains [pixels]."""

HELD, LEAST_HELD = 7, 6
"""One of so many tracks is not fitted, if there are at least so many of them."""

Parts = dict[str, list[tuple[Tensor, Tensor, Tensor]]]
"""Residuals of each kind, with their clusters and moments, frame by frame."""

Tick = Callable[[int], object]
"""Called with the number of variants that reached one more frame."""


class Evidence(ABC):
    """One kind of difference between simulation and video, in one camera.

    Attributes:
        kind: Its name.
        floor: Lower bound of the standard deviation of the residuals.
    """

    kind: str
    floor: float

    def __init__(self, video: Footage) -> None:
        self.video = video

    @abstractmethod
    def shown(self, simulation: Simulation, states: Sequence[State]) -> Any:
        """The part of the residuals that is the same for all frames."""

    @abstractmethod
    def beside(self, shown: Any, frame: int) -> tuple[Tensor, Tensor]:
        """Differences between a frame and what some states show, shape (B, R, D), and their clusters, shape (R,)."""


class TrackEvidence(Evidence):
    """Residuals of tracks: positions of Gaussians in the simulation minus those tracked in the video [pixels].

    Args:
        simulation: The simulation.
        video: The video.
        tracks: Its tracks.
        weighed: Multiply each residual by :func:`facing`, as a camera that sees a surface edge-on hardly tells where
            its points are.
        trust: What else each residual is multiplied by, shape (F, T); None for 1.

    Attributes:
        rest: Places of the Gaussians at rest [scene units], on the CPU, shape (T, 3).
    """

    kind, floor = "tracks", 0.05

    def __init__(
        self, simulation: Simulation, video: Footage, tracks: Tracks, weighed: bool = False, trust: Tensor | None = None
    ) -> None:
        super().__init__(video)
        scene = simulation.scene
        self.tracks, self._weighed, self.trust = tracks, weighed, trust
        index = tracks.index.to(scene.moving.device)
        self._follow = scene.follow.some(index).to(scene.moving.device)
        self._means = scene.model.means.detach()[scene.moving[index]]
        self.rest = self._means.cpu()
        self._cluster = _patch_of(self.rest)
        self._weight = torch.ones(len(index), 1, dtype=torch.float64)
        if weighed:
            normals = scene.rest().normals[scene.moving[index]].cpu()
            self._weight = facing(normals, self.rest, video.cameras[0])[:, None]

    def on(self, simulation: Simulation) -> TrackEvidence:
        """The same tracks for the same scene on another grid."""
        return TrackEvidence(simulation, self.video, self.tracks, self._weighed, self.trust)

    def trusting(self, trust: Tensor) -> TrackEvidence:
        """The same tracks, with residuals multiplied by ``trust``, shape (F, T)."""
        found = copy(self)
        found.trust = trust
        return found

    def shown(self, simulation: Simulation, states: Sequence[State]) -> Tensor:
        """Places of the Gaussians [scene units], shape (B, T, 3)."""
        moves = torch.stack([self._follow.motion(state)[0] for state in states]).to(self._means)
        return (self._means + simulation.scene.frame.displacement_to_scene(moves)).cpu()

    def pixels(self, shown: Tensor, frame: int) -> Tensor:
        """Where a frame would have them [pixels], shape (B, T, 2)."""
        return project(shown.flatten(0, 1), self.video.cameras[frame])[0].unflatten(0, shown.shape[:2])

    def beside(self, shown: Tensor, frame: int) -> tuple[Tensor, Tensor]:
        """See the base class; D is 2."""
        seen = self.tracks.seen[frame]
        pixel = self.pixels(shown[:, seen], frame)
        weight = self._weight[seen] if self.trust is None else self._weight[seen] * self.trust[frame, seen, None]
        return weight * (pixel - self.tracks.position[frame, seen]), self._cluster[seen]


class PictureEvidence(Evidence):
    """Pictures of the simulation against frames, or their opacities against silhouettes, averaged over squares.

    Args:
        video: The video.
        masks: Compare silhouettes instead of colours.
        width: Width of the averaged pictures [pixels].
    """

    floor = 1 / 255

    def __init__(self, video: Footage, masks: bool, width: int = 80) -> None:
        super().__init__(video)
        self.kind, self.masks = "silhouettes" if masks else "pixels", masks
        self.factor = max(1, round(video.size[0] / width))

    def shown(self, simulation: Simulation, states: Sequence[State]) -> tuple[Painter, list[DeformedGaussians]]:
        return simulation.painter, [simulation.painter.deformed(state) for state in states]

    def beside(self, shown: tuple[Painter, list[DeformedGaussians]], frame: int) -> tuple[Tensor, Tensor]:
        """See the base class; D is 1 for silhouettes and 3 for colours."""
        painter, several = shown
        camera = self.video.cameras[frame].to(painter.device)
        masks = self.video.masks
        wanted = self.video.images[frame] if masks is None or not self.masks else masks[frame][..., None]
        target = self._averaged(wanted.to(painter.device).float() / 255)
        found = []
        for gaussians in several:
            picture = painter.picture(gaussians, camera)
            seen = picture.alpha if self.masks else picture.color
            found.append((self._averaged(seen.float()) - target).flatten(0, 1))
        row, column = (torch.arange(n) * PATCHES // n for n in target.shape[:2])
        return torch.stack(found).double().cpu(), (row[:, None] * PATCHES + column).reshape(-1)

    def _averaged(self, picture: Tensor) -> Tensor:
        planes = picture.permute(2, 0, 1)[None]
        return torch.nn.functional.avg_pool2d(planes, self.factor)[0].permute(1, 2, 0)


def compare(
    simulation: Simulation,
    evidence: Sequence[Evidence],
    values: Sequence[Values],
    times: Sequence[float],
    careful: bool = True,
    moving: bool = False,
    tick: Tick = lambda count: None,
) -> list[Block]:
    """Simulate variants and compare each with the videos.

    Args:
        simulation: The base.
        evidence: The comparisons to make.
        values: The values of each variant.
        times: Times of the frames to compare [s], ascending.
        careful: Take the same substeps for all. If not, or if one of them diverges, each variant takes its own, and may
            end in NaN.
        moving: Whether the videos begin in motion; their first frame is then compared, too.
        tick: Called after every frame.

    Returns:
        One block for each kind, joined over cameras and times; clusters of different kinds and, for pictures, cameras
        differ.
    """
    parts: Parts = {}
    try:
        runs = states_of(simulation, values, times, alike=careful)
        for number, (time, states) in enumerate(zip(times, runs, strict=True)):
            tick(len(values))
            if time <= 0 and not moving:  # at rest all variants are alike
                continue
            for place, part in enumerate(evidence):
                if (frame := part.video.frame_at(time)) is not None:
                    found, cluster = part.beside(part.shown(simulation, states), frame)
                    shift = 0 if part.kind == "tracks" else place * PATCHES**2
                    moment = torch.full_like(cluster, number * MOMENTS // len(times))
                    parts.setdefault(part.kind, []).append((found, cluster + shift, moment))
    except SimulationDiverged:
        if not careful:
            raise
        return compare(simulation, evidence, values, times, False, moving, tick)
    return _joined(parts)


def compare_starts(
    simulation: Simulation,
    evidence: Sequence[Evidence],
    values: Sequence[Values],
    times: Sequence[float],
    starts: Sequence[float],
    tick: Tick = lambda count: None,
) -> list[list[Block]]:
    """Compare variants as if each had begun to move at each of some times of the film, from one simulation of each.

    The arguments are those of :func:`compare`, in a wind that does not depend on time, and times at which the motion
    begins [s]. For each of these, the blocks of all variants, also of the first frame; NaN for one that diverged.
    """
    wanted: dict[int, list[tuple[int, float]]] = {}  # what is compared with a state, by its time [microseconds]
    for number, start in enumerate(starts):
        for time in times:
            wanted.setdefault(round(1e6 * max(0.0, time - start)), []).append((number, time))
    moments = sorted(wanted)
    own = [{name: value for name, value in one.items() if name != FILM_START} for one in values]
    parts: list[Parts] = [{} for _ in starts]
    runs = states_of(simulation, own, [1e-6 * moment for moment in moments], alike=False)
    for moment, states in zip(moments, runs, strict=True):
        tick(len(values))
        for part in evidence:
            shown = part.shown(simulation, states)
            for number, time in wanted[moment]:
                if (frame := part.video.frame_at(time)) is not None:
                    found, cluster = part.beside(shown, frame)
                    parts[number].setdefault(part.kind, []).append((found, cluster, torch.zeros_like(cluster)))
    return [_joined(own) for own in parts]


def _joined(parts: Parts) -> list[Block]:
    found = []
    for kind, own in parts.items():
        values, cluster, moment = zip(*own, strict=True)
        found.append(Block(kind, torch.cat(values, 1), torch.cat(cluster), torch.cat(moment)))
    return found


def facing(normals: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """Foreshortening of surfaces with some normals at some points (T, 3) in a camera, shape (T,): 1 if seen face-on."""
    view = camera.world_to_camera.cpu().double()
    ray = torch.nn.functional.normalize(points.double() + view[:3, :3].T @ view[:3, 3], dim=-1)
    return (normals.double() * ray).sum(-1).abs().clamp(min=LEAST_FACING)


def _patch_of(points: Tensor) -> Tensor:
    """Return the index of each point's square (T,), in a grid over the two longest directions of all points (T, 3)."""
    if len(points) < 3:
        return torch.zeros(len(points), dtype=torch.long)
    centred = (points - points.mean(0)).double()
    flat = centred @ torch.linalg.svd(centred, full_matrices=False)[2][:2].mT
    low, high = flat.amin(0), flat.amax(0)
    cell = ((flat - low) / (high - low).clamp(min=1e-12) * PATCHES).long().clamp(0, PATCHES - 1)
    return cell[:, 0] * PATCHES + cell[:, 1]


class Followed:
    """The share of the motion of tracks that were not fitted which a simulation explains, added up frame by frame."""

    def __init__(self, simulation: Simulation, videos: Sequence[Footage], tracks: Sequence[Tracks]) -> None:
        self._simulation = simulation
        pairs = zip(videos, tracks, strict=True)
        self._own = {video.name: TrackEvidence(simulation, video, held_out(own)) for video, own in pairs}
        self._left, self._moved = dict.fromkeys(self._own, 0.0), dict.fromkeys(self._own, 0.0)

    def add(self, moment: float, state: State) -> None:
        """Add the state at a time of the film [s]."""
        for name, own in self._own.items():
            if (frame := own.video.frame_at(moment)) is not None:
                seen = own.tracks.seen[frame]
                rest = project(own.rest[seen], own.video.cameras[frame])[0]
                off = own.beside(own.shown(self._simulation, [state]), frame)[0].square().sum(-1)
                self._left[name] += float((off - NOISE**2).clamp(min=0).sum())
                self._moved[name] += float((own.tracks.position[frame, seen] - rest).square().sum())

    def shares(self) -> dict[str, float]:
        """The share of each camera in which something moves."""
        return {name: 1 - self._left[name] / moved for name, moved in self._moved.items() if moved > 0}


def _held(tracks: Tracks) -> Tensor:
    """Mask of the tracks that are not fitted, but judge the fit; none if there are too few."""
    held = tracks.index % HELD == 0
    return held if int(held.sum()) >= LEAST_HELD else torch.zeros_like(held)


def fitted_part(tracks: Tracks) -> Tracks:
    """The tracks that are fitted."""
    return replace(tracks, seen=tracks.seen & ~_held(tracks))


def held_out(tracks: Tracks) -> Tracks:
    """The tracks that were not fitted; all if there are too few."""
    held = _held(tracks)
    return replace(tracks, seen=tracks.seen & held) if bool(held.any()) else tracks


def trusted(
    simulation: Simulation,
    others: Sequence[Simulation],
    evidence: Sequence[Evidence],
    values: Values,
    times: Sequence[float],
) -> list[Evidence]:
    """Return evidence whose points count less where, and when, other grids move them otherwise.

    A flapping flag is soon elsewhere on another grid, by many times the error of a track. Such residuals would pull the
    values to where they make up for the grid. A residual is multiplied by :math:`(1 + d^2 / n^2)^{-1/2}`, with the root
    mean square distance d of the point in a frame of the other grids from that of its own, and the error n of a track.
    """
    parts = [part for part in evidence if isinstance(part, TrackEvidence)]
    if not others or not parts:
        return list(evidence)
    own = _pixels(simulation, parts, values, times)
    trust = [torch.ones(part.tracks.seen.shape, dtype=torch.float64) for part in parts]
    squares = {key: torch.zeros(len(pixel), dtype=torch.float64) for key, pixel in own.items()}
    for other in others:
        for key, pixel in _pixels(other, [part.on(other) for part in parts], values, times).items():
            squares[key] += torch.nan_to_num(pixel - own[key]).square().sum(-1) / (2 * len(others))  # NaN: it diverged
    for (number, frame), square in squares.items():
        trust[number][frame] = (1 + square / NOISE**2).rsqrt()
    return [part.trusting(trust[parts.index(part)]) if isinstance(part, TrackEvidence) else part for part in evidence]


def distrust(evidence: Sequence[Evidence], times: Sequence[float]) -> float:
    r"""Return what the trust in points adds to the cost of a place: the mean of :math:`-2 \log` of it.

    Points that count less have smaller residuals. That is no better fit: with the larger variance that is assumed of
    them, minus the logarithm of the likelihood has this term for their two coordinates.
    """
    found = []
    for part in evidence:
        if isinstance(part, TrackEvidence) and part.trust is not None:
            frames = [frame for time in times if (frame := part.video.frame_at(time)) is not None]
            found.append(-2 * part.trust[frames][part.tracks.seen[frames]].log())
    return float(torch.cat(found).mean()) if found else 0.0


def _pixels(
    simulation: Simulation, parts: Sequence[TrackEvidence], values: Values, times: Sequence[float]
) -> dict[tuple[int, int], Tensor]:
    """Places of the points of each part in each frame [pixels], shape (T, 2)."""
    found = {}
    for time, states in zip(times, states_of(simulation, [values], times, alike=False), strict=True):
        for number, part in enumerate(parts):
            if (frame := part.video.frame_at(time)) is not None:
                found[number, frame] = part.pixels(part.shown(simulation, states), frame)[0]
    return found
