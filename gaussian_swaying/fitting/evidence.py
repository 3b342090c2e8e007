"""Residuals between variants of a simulation and a video: differences of tracks, silhouettes and pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.fitting.tracks import Tracks
from gaussian_swaying.fitting.unknowns import FILM_START
from gaussian_swaying.fitting.variants import Values, states_of
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

LEAST_FACING = 0.05
"""Least weight of the residuals of a point that is seen edge-on."""
MOMENTS = 4
"""Parts of the time, which sort residuals into clusters of errors that are alike all over the object."""
PATCHES = 4
"""Squares along each side of the grid that sorts tracks and pixels into clusters of correlated errors."""


Parts = dict[str, list[tuple[Tensor, Tensor, Tensor]]]
"""Residuals of each kind, with their clusters and moments, frame by frame."""


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals of one kind.

    Attributes:
        kind: ``tracks``, ``silhouettes`` or ``pixels``.
        values: Differences between simulation and video for each variant, float64, shape (B, R, D); in pixels for
            tracks, else in grey levels from 0 to 1.
        cluster: Index of the cluster of correlated residuals that each belongs to, shape (R,).
        moment: Index of the part of the time that each belongs to, shape (R,); None if all are of one.
    """

    kind: str
    values: Tensor
    cluster: Tensor
    moment: Tensor | None = None

    def of(self, values: Tensor) -> Block:
        """The block with other values."""
        return Block(self.kind, values, self.cluster, self.moment)


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

    def frame_at(self, time: float) -> int | None:
        return self.video.frame_at(time)

    @abstractmethod
    def shown(self, simulation: Simulation, states: Sequence[State]) -> Any:
        """The part of :meth:`residuals` that is the same for all frames."""

    @abstractmethod
    def beside(self, shown: Any, frame: int) -> tuple[Tensor, Tensor]:
        """Differences between a frame and what some states show, as :meth:`residuals`."""

    def residuals(self, simulation: Simulation, states: Sequence[State], frame: int) -> tuple[Tensor, Tensor]:
        """Differences in a frame, shape (B, R, D), and their clusters, shape (R,)."""
        return self.beside(self.shown(simulation, states), frame)


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
        self,
        simulation: Simulation,
        video: Footage,
        tracks: Tracks,
        weighed: bool = False,
        trust: Tensor | None = None,
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

    def beside(self, shown: Tensor, frame: int) -> tuple[Tensor, Tensor]:
        """See the base class; D is 2."""
        seen = self.tracks.seen[frame]
        pixel = project(shown[:, seen].flatten(0, 1), self.video.cameras[frame])[0].unflatten(
            0, (len(shown), int(seen.sum()))
        )
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
        if self.masks:
            assert self.video.masks is not None
            wanted = self.video.masks[frame][..., None]
        else:
            wanted = self.video.images[frame]
        target = self._averaged(wanted.to(painter.device).float() / 255)
        found = []
        for gaussians in several:
            picture = painter.picture(gaussians, camera)
            seen = picture.alpha if self.masks else picture.color
            found.append((self._averaged(seen.float()) - target).flatten(0, 1))
        rows, columns = target.shape[:2]
        row, column = (torch.arange(n) * PATCHES // n for n in (rows, columns))
        cluster = (row[:, None] * PATCHES + column).reshape(-1)
        return torch.stack(found).double().cpu(), cluster

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

    Returns:
        One block for each kind, joined over cameras and times; clusters of different kinds and, for pictures, cameras
        differ.
    """
    parts: Parts = {}
    try:
        runs = states_of(simulation, values, times, alike=careful)
        for number, (time, states) in enumerate(zip(times, runs, strict=True)):
            if time <= 0 and not moving:  # at rest all variants are alike
                continue
            for place, part in enumerate(evidence):
                frame = part.frame_at(time)
                if frame is None:
                    continue
                found, cluster = part.residuals(simulation, states, frame)
                shift = 0 if part.kind == "tracks" else place * PATCHES**2
                moment = torch.full_like(cluster, number * MOMENTS // len(times))
                parts.setdefault(part.kind, []).append((found, cluster + shift, moment))
    except SimulationDiverged:
        if not careful:
            raise
        return compare(simulation, evidence, values, times, careful=False, moving=moving)
    return _joined(parts)


def compare_starts(
    simulation: Simulation,
    evidence: Sequence[Evidence],
    values: Sequence[Values],
    times: Sequence[float],
    starts: Sequence[float],
) -> list[list[Block]]:
    """Compare variants as if each had begun to move at each of some times of the film, from one simulation of each.

    Args:
        simulation: The base, in a wind that does not depend on time.
        evidence: The comparisons to make.
        values: The values of each variant; their own start is left out.
        times: Times of the frames to compare [s], ascending.
        starts: Times in the film at which the motion begins [s].

    Returns:
        For each start the blocks of all variants, also of the first frame; a variant that diverged ends in NaN.
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
        for part in evidence:
            shown = part.shown(simulation, states)
            for number, time in wanted[moment]:
                if (frame := part.frame_at(time)) is not None:
                    found, cluster = part.beside(shown, frame)
                    parts[number].setdefault(part.kind, []).append((found, cluster, torch.zeros_like(cluster)))
    return [_joined(own) for own in parts]


def _joined(parts: Parts) -> list[Block]:
    found = []
    for kind, own in parts.items():
        values, cluster, moment = zip(*own, strict=True)
        found.append(Block(kind, torch.cat(values, 1), torch.cat(cluster), torch.cat(moment)))
    return found


def scales_of(blocks: Sequence[Block], floors: Mapping[str, float], member: int = 0) -> dict[str, float]:
    """Robust standard deviation of the residuals of a variant, for each kind: from the median of their sizes."""
    found = {}
    for block in blocks:
        size = block.values[member].norm(dim=-1)
        count = block.values.shape[-1]
        # median of the norm of D standard normal numbers, to within a percent
        middle = {1: 0.6745, 2: 1.1774, 3: 1.5382}[count]
        sigma = float(size.nanmedian()) / middle if size.numel() else 0.0
        found[block.kind] = max(sigma, floors[block.kind])
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
    axes = torch.linalg.svd(centred, full_matrices=False)[2][:2]
    flat = centred @ axes.mT
    low, high = flat.amin(0), flat.amax(0)
    cell = ((flat - low) / (high - low).clamp(min=1e-12) * PATCHES).long().clamp(0, PATCHES - 1)
    return cell[:, 0] * PATCHES + cell[:, 1]
