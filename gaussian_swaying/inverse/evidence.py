"""Evidence of a fit: points that are followed in films, and how far variants are from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying.inverse.least_squares import Block
from gaussian_swaying.inverse.plan import FILM_START, Values
from gaussian_swaying.inverse.tracks import Tracks
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

MOMENTS, PATCHES = 4, 4  # parts of the time, and squares along each side of the object: clusters
NOISE = 0.5  # distance of a track that its own error explains [pixels]
HELD, LEAST_HELD = 7, 6  # one of so many tracks is not fitted, if there are at least so many of them


class Evidence:
    """Where Gaussians of a simulation are, beside where they were followed in the video of a camera.

    Residuals are multiplied by ``trust`` (F, T). ``rest`` are the places at rest [scene units], on the CPU, (T, 3).
    """

    def __init__(self, simulation: Simulation, video: Footage, tracks: Tracks, trust: Tensor | None = None) -> None:
        scene = simulation.scene
        self.simulation, self.video, self.tracks, self.trust = simulation, video, tracks, trust
        index = tracks.index.to(scene.moving.device)
        self._follow = scene.follow.some(index).to(scene.moving.device)
        self._means = scene.model.means.detach()[scene.moving[index]]
        self.rest = self._means.cpu()
        self._cluster = _patch_of(self.rest)

    def on(self, simulation: Simulation) -> Evidence:
        """The same tracks for the same scene on another grid."""
        return Evidence(simulation, self.video, self.tracks, self.trust)

    def shown(self, states: Sequence[State]) -> Tensor:
        """Places of the Gaussians [scene units], shape (B, T, 3)."""
        moves = torch.stack([self._follow.motion(state)[0] for state in states]).to(self._means)
        return (self._means + self.simulation.scene.frame.displacement_to_scene(moves)).cpu()

    def pixels(self, shown: Tensor, frame: int) -> Tensor:
        """Where a frame would have them [pixels], shape (B, T, 2)."""
        return project(shown.flatten(0, 1), self.video.cameras[frame])[0].unflatten(0, shown.shape[:2])

    def beside(self, shown: Tensor, frame: int) -> tuple[Tensor, Tensor]:
        """Residuals of some states in a frame [pixels], shape (B, R, 2), and their clusters, shape (R,)."""
        seen = self.tracks.seen[frame]
        off = self.pixels(shown[:, seen], frame) - self.tracks.position[frame, seen]
        return off if self.trust is None else self.trust[frame, seen, None] * off, self._cluster[seen]


def compare(
    evidence: Sequence[Evidence],
    values: Sequence[Values],
    times: Sequence[float],
    moving: bool = False,
    starts: Sequence[float] = (),
    tick: Callable[[int], object] = int,
) -> list[Block]:
    """Simulate variants of the evidence's simulation, and compare each with the videos at times [s].

    At 0 they are compared only if the videos begin in motion. They have the same substeps unless one diverges. With
    ``starts``, of a wind that does not depend on time, there is a block for each of them: what the residuals were if
    all had begun to move then, from one simulation.
    """
    wanted: dict[float, tuple[float, list[tuple[int, float]]]] = {}  # what is compared with a state, by its time
    for number, start in enumerate(starts or [0.0]):
        for time in times:
            _, what = wanted.setdefault(round(max(0.0, time - start), 6), (max(0.0, time - start), []))
            what += [(number, time)] if time > 0 or moving else []  # at rest all variants are alike
    own = [{name: v for name, v in one.items() if name != FILM_START} for one in values] if starts else values
    moments = [wanted[key] for key in sorted(wanted)]

    def compared(alike: bool) -> list[Block]:
        parts: list[list[tuple[Tensor, Tensor, Tensor]]] = [[] for _ in starts or [0.0]]
        runs = states_of(evidence[0].simulation, own, [moment for moment, _ in moments], alike)
        for number, ((_, what), states) in enumerate(zip(moments, runs, strict=True)):
            tick(len(values))
            for part in evidence if what else ():
                shown = part.shown(states)
                for block, time in what:
                    if (frame := part.video.frame_at(time)) is not None:
                        found, cluster = part.beside(shown, frame)
                        moment = torch.full_like(cluster, number * MOMENTS // len(moments))
                        parts[block].append((found, cluster, moment))
        joined = (zip(*own, strict=True) for own in parts)
        return [Block(torch.cat(list(r), 1), torch.cat(list(c)), torch.cat(list(m))) for r, c, m in joined]

    try:
        return compared(not starts)
    except SimulationDiverged:
        return compared(False)


def _patch_of(points: Tensor) -> Tensor:
    if len(points) < 3:
        return torch.zeros(len(points), dtype=torch.long)
    centred = (points - points.mean(0)).double()
    flat = centred @ torch.linalg.svd(centred, full_matrices=False)[2][:2].mT
    low, high = flat.amin(0), flat.amax(0)
    cell = ((flat - low) / (high - low).clamp(min=1e-12) * PATCHES).long().clamp(0, PATCHES - 1)
    return cell[:, 0] * PATCHES + cell[:, 1]


def explained(parts: Sequence[Evidence], values: Values, times: Sequence[float]) -> dict[str, float]:
    """The share of the motion of tracks that were not fitted which their simulation explains, by camera, 0 to 1.

    A track that slipped off the object explains nothing, no less: one of them would decide the sum of all.
    """
    sums = [torch.zeros(2, len(part.rest), dtype=torch.float64) for part in parts]
    for number, frame, pixel in _pixels(parts, values, times):
        part = parts[number]
        seen = part.tracks.seen[frame]
        there = part.tracks.position[frame, seen]
        rest = project(part.rest[seen], part.video.cameras[frame])[0]
        left = ((pixel[seen] - there).square().sum(-1) - NOISE**2).clamp(min=0).nan_to_num(torch.inf)
        sums[number][:, seen] += torch.stack([left, (there - rest).square().sum(-1)])
    return {
        part.video.name: 1 - float(torch.minimum(left, moved).sum() / moved.sum())
        for part, (left, moved) in zip(parts, sums, strict=True)
        if bool(moved.any())
    }


def split(tracks: Tracks) -> tuple[Tracks, Tracks]:
    """The tracks that are fitted, and those that judge the fit; all of them for both if there are too few."""
    held = tracks.index % HELD == 0
    if int(held.sum()) < LEAST_HELD:
        return tracks, tracks
    return replace(tracks, seen=tracks.seen & ~held), replace(tracks, seen=tracks.seen & held)


def trusted(
    evidence: Sequence[Evidence], others: Sequence[Simulation], values: Values, times: Sequence[float]
) -> list[Evidence]:
    """Return evidence whose points count less where, and when, other grids move them otherwise.

    Such residuals would pull the values to where they make up for the grid. They are multiplied by
    :math:`(1 + d^2 / n^2)^{-1/2}`, with the root mean square distance d on the other grids, and the error n of a track.
    """
    if not others:
        return list(evidence)
    own = {(number, frame): pixel for number, frame, pixel in _pixels(evidence, values, times)}
    squares = {key: torch.zeros(len(pixel), dtype=torch.float64) for key, pixel in own.items()}
    for other in others:
        for number, frame, pixel in _pixels([part.on(other) for part in evidence], values, times):
            off = torch.nan_to_num(pixel - own[number, frame])  # NaN: it diverged
            squares[number, frame] += off.square().sum(-1) / (2 * len(others))
    found = [copy(part) for part in evidence]
    for part in found:
        part.trust = torch.ones(part.tracks.seen.shape, dtype=torch.float64)
    for (number, frame), square in squares.items():
        found[number].trust[frame] = (1 + square / NOISE**2).rsqrt()  # type: ignore[index]
    return found


def _pixels(parts: Sequence[Evidence], values: Values, times: Sequence[float]) -> Iterator[tuple[int, int, Tensor]]:
    for time, states in zip(times, states_of(parts[0].simulation, [values], times, alike=False), strict=True):
        for number, part in enumerate(parts):
            if (frame := part.video.frame_at(time)) is not None:
                yield number, frame, part.pixels(part.shown(states), frame)[0]
