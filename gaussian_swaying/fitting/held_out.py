"""Tracks that are not fitted, and judge a fit: the share of their motion that a simulation explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying.fitting.evidence import TrackEvidence
from gaussian_swaying.fitting.tracks import Tracks
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.simulation.simulation import Simulation

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
