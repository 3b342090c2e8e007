"""Effects of the grid: points are trusted less where a finer and a coarser grid move them otherwise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.fitting.evidence import Evidence, TrackEvidence
from gaussian_swaying.fitting.held_out import NOISE
from gaussian_swaying.fitting.variants import Values, states_of
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.simulation.simulation import Simulation


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
