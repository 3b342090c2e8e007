"""Evidence of a fit: what films show, prepared, and how far variants are from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.cameras import Background, follow_camera, gains, moves_by, stands_still, with_gains
from gaussian_swaying.inverse.tracks import STILL, Tracks
from gaussian_swaying.inverse.unknowns import FILM_START, Values, states_of
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation, classify

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


NOISE = 0.5
"""Distance of a track that its own error explains [pixels]."""

HELD, LEAST_HELD = 7, 6
"""One of so many tracks is not fitted, if there are at least so many of them."""


class Followed:
    """The share of the motion of tracks that were not fitted which a simulation explains, added up frame by frame.

    Args:
        simulation: The scene.
        videos: The videos.
        tracks: All tracks of each.
    """

    def __init__(self, simulation: Simulation, videos: Sequence[Footage], tracks: Sequence[Tracks]) -> None:
        self._simulation = simulation
        self._own = {
            video.name: TrackEvidence(simulation, video, held_out(own))
            for video, own in zip(videos, tracks, strict=True)
        }
        self._left = dict.fromkeys(self._own, 0.0)
        self._moved = dict.fromkeys(self._own, 0.0)

    def add(self, moment: float, state: State) -> None:
        """Add the state at a time of the film [s]."""
        for name, own in self._own.items():
            frame = own.frame_at(moment)
            if frame is None:
                continue
            tracks = own.tracks
            seen = tracks.seen[frame]
            if not bool(seen.any()):
                continue
            moved = tracks.position[frame, seen] - project(own.rest[seen], own.video.cameras[frame])[0]
            off = own.residuals(self._simulation, [state], frame)[0].square().sum(-1)
            self._left[name] += float((off - NOISE**2).clamp(min=0).sum())
            self._moved[name] += float(moved.square().sum())

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

    Args:
        simulation: The scene.
        others: The same on other grids; with none, the evidence is returned as it is.
        evidence: What is compared.
        values: The values of the unknowns at which the grids are compared.
        times: Times of the frames that are compared [s], ascending.
    """
    parts = [part for part in evidence if isinstance(part, TrackEvidence)]
    if not others or not parts:
        return list(evidence)
    own = _pixels(simulation, parts, values, times)
    squares: dict[tuple[int, int], Tensor] = {}
    for other in others:
        for key, pixel in _pixels(other, [part.on(other) for part in parts], values, times).items():
            square = torch.nan_to_num(pixel - own[key]).square().sum(-1) / (2 * len(others))  # NaN where one diverged
            squares[key] = squares[key] + square if key in squares else square
    found = []
    for part in evidence:
        if isinstance(part, TrackEvidence):
            number = parts.index(part)
            trust = torch.ones(part.tracks.seen.shape, dtype=torch.float64)
            for (place, frame), square in squares.items():
                if place == number:
                    trust[frame] = (1 + square / NOISE**2).rsqrt()
            part = part.trusting(trust)
        found.append(part)
    return found


def distrust(evidence: Sequence[Evidence], times: Sequence[float]) -> float:
    r"""Return what the trust in points adds to the cost of a place: the mean of :math:`-2 \log` of it.

    Points that count less have smaller residuals. That is no better fit: with the larger variance that is assumed of
    them, minus the logarithm of the likelihood has this term for their two coordinates.

    Args:
        evidence: From :func:`trusted`.
        times: Times of the frames that are compared [s].
    """
    found = []
    for part in evidence:
        if isinstance(part, TrackEvidence) and part.trust is not None:
            frames = [frame for time in times if (frame := part.frame_at(time)) is not None]
            found.append(-2 * part.trust[frames][part.tracks.seen[frames]].log())
    return float(torch.cat(found).mean()) if found else 0.0


def _pixels(
    simulation: Simulation, parts: Sequence[TrackEvidence], values: Values, times: Sequence[float]
) -> dict[tuple[int, int], Tensor]:
    """Places of the points of each part in each frame [pixels], shape (T, 2)."""
    found = {}
    for time, states in zip(times, states_of(simulation, [values], times, alike=False), strict=True):
        for number, part in enumerate(parts):
            if (frame := part.frame_at(time)) is not None:
                found[number, frame] = project(part.shown(simulation, states)[0], part.video.cameras[frame])[0]
    return found


BAND = 22
"""Height of the line of text above a picture [pixels]."""

HELD_TINT, MOVING, STILL_TINT = (0.85, 0.1, 0.1), (0.1, 0.65, 0.25), (0.55, 0.55, 0.55)
"""Colours of what is held, what moves, and what is only drawn."""


def write_before(
    folder: Path, simulation: Simulation, videos: Sequence[Footage], tracks: Sequence[Tracks] | None
) -> list[Path]:
    """Write ``rest_CAMERA.png`` and, if points are followed, ``tracks_CAMERA.png``.

    Args:
        folder: Where to write; made if it is missing.
        simulation: The scene.
        videos: The videos.
        tracks: Their tracks; None if nothing is followed.

    Returns:
        The files.
    """
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for number, video in enumerate(videos):
        pictures = {f"rest_{video.name}.png": at_rest(simulation, video)}
        if tracks is not None:
            pictures[f"tracks_{video.name}.png"] = tracks_picture(video, tracks[number])
        for name, picture in pictures.items():
            iio.imwrite(folder / name, picture)
            files.append(folder / name)
    return files


def side_by_side(frame: Tensor, shown: Tensor, alpha: Tensor) -> list[tuple[str, Tensor]]:
    """A frame, the splat half over it, and the splat, each with a title.

    Args:
        frame: The frame, dtype uint8, shape (H, W, 3).
        shown: The splat's picture, colours in [0, 1], shape (H, W, 3).
        alpha: Its opacity, shape (H, W, 1).
    """
    real, drawn = frame.float() / 255, shown.detach().float().cpu().clamp(0, 1)
    cover = 0.5 * alpha.detach().float().cpu()
    return [("first frame", real), ("splat half over it", real * (1 - cover) + drawn * cover), ("splat", drawn)]


def at_rest(simulation: Simulation, video: Footage) -> Any:
    """The first frame, the scene at rest half over it and alone, and what is held there, as a NumPy array."""
    scene, painter = simulation.scene, simulation.painter
    camera: Camera = video.cameras[0].to(painter.device)
    with torch.no_grad():
        rest = scene.rest()
        picture = painter.picture(rest, camera)
        roles = painter.draw(rest, role_colours(simulation).to(painter.device), camera)
    panels = side_by_side(video.images[0], picture.color, picture.alpha)
    panels.append(("red: held, green: moves, grey: still", roles.color.detach().float().cpu().clamp(0, 1)))
    return titled(panels)


def role_colours(simulation: Simulation) -> Tensor:
    """A colour for each Gaussian of a scene: held, moving or still; shape (N, 3)."""
    parts = classify(simulation)
    colours = torch.tensor(STILL_TINT).repeat(len(parts.simulated), 1)
    colours[(parts.simulated | parts.carried).cpu()] = torch.tensor(MOVING)
    colours[parts.pinned.cpu()] = torch.tensor(HELD_TINT)
    return colours


def tracks_picture(video: Footage, tracks: Tracks) -> Any:
    """The first frame, pale, with the ways of the points that are followed, as a NumPy array (H, W, 3)."""
    import numpy as np
    from PIL import Image, ImageDraw

    pale = (video.images[0].float() * 0.4 + 255 * 0.6).round().to(torch.uint8)
    picture = Image.fromarray(pale.numpy())
    draw = ImageDraw.Draw(picture)
    for number in range(tracks.position.shape[1]):
        seen = tracks.seen[:, number]
        way = [tuple(place) for place in tracks.position[seen, number].tolist()]
        colour = (20, 90, 220) if bool(seen[-1]) else (220, 120, 0)
        if len(way) > 1:
            draw.line(way, fill=colour, width=1)
        x, y = way[0]
        draw.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=colour)
    lost = int((~tracks.seen[-1]).sum())
    told = f"{tracks.position.shape[1]} points followed; orange: {lost} lost"
    return titled([(told, torch.from_numpy(np.asarray(picture).copy()).float() / 255)])


def titled(panels: Sequence[tuple[str, Tensor]]) -> Any:
    """Pictures (H, W, 3) side by side, colours in [0, 1], with a title above each, as a NumPy array."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    joined = torch.cat([panel for _, panel in panels], 1)
    height, width = joined.shape[:2]
    picture = Image.new("RGB", (width, height + BAND), (255, 255, 255))
    picture.paste(Image.fromarray((joined.clamp(0, 1) * 255).round().to(torch.uint8).numpy()), (0, BAND))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    for number, (title, _) in enumerate(panels):
        draw.text((number * width // len(panels) + 6, 3), title, fill=(0, 0, 0), font=font)
    return np.asarray(picture)


MANY = 0.2
"""Share of the frames without background above which a fit is doubtful."""


@dataclass(frozen=True)
class Judged:
    """The judgement of the background on the film of a camera.

    Attributes:
        camera: Name of the camera.
        frames: Number of its frames.
        moved: Distance that the background goes in the film of a camera that is said to stand still [pixels].
        hand_held: Whether the camera of each frame was found.
        residual: Median distance of points of the background from where these cameras see them [pixels].
        unseen: Number of frames that show too little of the background; they have the camera of their neighbours.
        gains: Smallest and largest gain of red, green and blue, shape (2, 3); empty if it is not known.
    """

    camera: str
    frames: int
    moved: float = 0.0
    hand_held: bool = False
    residual: float = 0.0
    unseen: int = 0
    gains: tuple[tuple[float, ...], ...] = ()

    def sentences(self) -> list[str]:
        found = []
        if self.hand_held:
            found.append(
                f"camera {self.camera}: held in a hand; its background goes {self.moved:.3g} pixels. The camera of "
                f"each frame was found, {self.residual:.2f} pixels off"
                + (f"; {self.unseen} of {self.frames} frames have that of their neighbours." if self.unseen else ".")
            )
        if self.gains:
            low, high = self.gains
            told = ", ".join(
                f"{name} {a:.2f} to {b:.2f}" for name, a, b in zip(("red", "green", "blue"), low, high, strict=True)
            )
            found.append(f"camera {self.camera}: as bright as the splat now; the frames were divided by {told}.")
        return found

    def doubts(self) -> list[str]:
        if self.unseen <= MANY * self.frames:
            return []
        return [
            f"camera {self.camera}: {self.unseen} of {self.frames} frames show too little of what stands still, and "
            "have the camera of their neighbours: film more of it, or from a tripod."
        ]


def prepared(
    simulation: Simulation,
    videos: Sequence[Footage],
    hand_held: bool | None = None,
    also_moves: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> tuple[list[Footage], list[Judged]]:
    """Find the camera of each frame of films from a hand, and take drifts of exposure and white balance off all films.

    Args:
        simulation: The scene.
        videos: The films.
        hand_held: Whether their cameras move otherwise than they are said to. None: those whose frames all have one
            camera, but whose background moves by more than half a pixel.
        also_moves: Names of parts of the splat that move in the films, though the simulation does not move them.
        say: Called with a line for each thing that is done.

    Returns:
        The films, and what the background says of each; nothing if the splat has none.
    """
    background = Background(simulation, also_moves)
    if not background.exists:
        if hand_held:
            raise ValueError(
                "`hand_held` needs something that stands still in the splat, but all of it moves: stand the camera on "
                "a tripod, or have something still and textured, too, in the film and in the splat."
            )
        return list(videos), []
    if not hand_held and find_spec("cv2") is None:
        say("Without OpenCV nothing says whether a camera moves, or its exposure drifts.")
        return list(videos), []
    found, judged = [], []
    for video in videos:
        one = Judged(video.name, len(video.times))
        if hand_held is not False and stands_still(video):
            one = replace(one, moved=moves_by(video, background))
        if hand_held or (one.moved > STILL and hand_held is None):
            motion = follow_camera(video, background)
            video = replace(video, cameras=motion.cameras, itself=motion.itself)
            one = replace(one, hand_held=True, residual=motion.residual, unseen=len(motion.unseen))
        bright = gains(video, background)
        if bright is not None:
            video = replace(video, images=with_gains(video.images, bright[0]))
            ends = bright[0].amin(0), bright[0].amax(0)
            one = replace(one, gains=tuple(tuple(end.tolist()) for end in ends))
        for line in one.sentences():
            say(line)
        found.append(video)
        judged.append(one)
    return found, judged
