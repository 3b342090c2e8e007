"""Wind that changes during a film: its speed and azimuth at a few times, linear between them, with a prior.

``wind.speed@0.5`` is the factor on ``wind.speed`` at 0.5 s of the film, and ``wind.azimuth@0.5`` the turn [degrees]. At
the first frame they are 1 and 0. The prior is a random walk: changes in a second have a standard deviation of
:data:`WALK`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from gaussian_swaying.fitting.unknowns import CHANGES, FILM_START, Unknown, is_change
from gaussian_swaying.simulation.model import flow_of
from gaussian_swaying.wind.field import WindField

KNOTS, EVERY = 3, 0.4
"""Fewest times after the first frame at which the wind is sought, and the longest time between two of them [s]."""
WALK = {"wind.speed@": 0.5, "wind.azimuth@": 20.0}
"""Standard deviations of the change in a second: of the logarithm of the speed, and of the azimuth [degrees]."""
PRIOR = "prior"
"""Kind of the residuals of the prior, which are in standard deviations."""
RANGES = {"wind.speed@": (0.2, 5.0, "log"), "wind.azimuth@": (-90.0, 90.0, "linear")}


def changes_of(unknowns: Sequence[Unknown], until: float) -> list[Unknown]:
    """The unknowns of a wind that changes until a time of the film [s], beside some that are sought already.

    The azimuth changes only where it is sought.
    """
    sought = [kind for kind in CHANGES if kind[:-1] in {u.name for u in unknowns}]
    count = max(KNOTS, math.ceil(until / EVERY))
    times = [until * (k + 1) / count for k in range(count)]
    return [Unknown(f"{kind}{time:.4g}", *RANGES[kind]) for kind in sought for time in times]


def steady_share(unknown: Unknown) -> float:
    """The share of the range of an unknown of :func:`changes_of` at which the wind does not change."""
    return unknown.share(1.0 if unknown.scale == "log" else 0.0)


def knots_of(flow: Sequence[float], values: Mapping[str, float]) -> tuple[list[float], list[list[float]]]:
    """Times of the film [s] and flows [m/s] of a wind that changes.

    Args:
        flow: The flow at the first frame [m/s].
        values: Values of the unknowns.
    """
    named = {tuple(name.split("@")): value for name, value in values.items() if is_change(name)}
    moments = sorted({moment for _, moment in named}, key=float)
    speed, azimuth = math.hypot(*flow), math.degrees(math.atan2(flow[1], flow[0]))
    flows = [list(flow)]
    for moment in moments:
        factor, turn = named.get(("wind.speed", moment), 1.0), named.get(("wind.azimuth", moment), 0.0)
        flows.append(flow_of(flow, {"wind.speed": factor * speed, "wind.azimuth": azimuth + turn}))
    return [0.0, *map(float, moments)], flows


def changing(wind: WindField, values: Mapping[str, float]) -> WindField:
    """A wind with the changes among some values; itself if there are none. Its time begins with the motion."""
    if not any(map(is_change, values)):
        return wind
    times, flows = knots_of(wind.flows[0].tolist(), values)
    start = values.get(FILM_START, 0.0)
    return wind.with_schedule([time - start for time in times], flows)


def prior_of(unknowns: Sequence[Unknown], places: Tensor) -> Tensor | None:
    """Residuals of the prior at places (B, U), shares of the ranges: shape (B, R, 1); None in a steady wind."""
    columns = []
    for kind, walk in WALK.items():
        own = sorted((float(u.name.split("@")[1]), k) for k, u in enumerate(unknowns) if u.name.startswith(kind))
        path = [(0.0, torch.zeros(len(places), dtype=torch.float64))]
        for time, k in own:
            found = torch.tensor([unknowns[k].value(share) for share in places[:, k].tolist()], dtype=torch.float64)
            path.append((time, found.log() if unknowns[k].scale == "log" else found))
        for (before, a), (after, b) in pairwise(path):
            columns.append((b - a) / (walk * math.sqrt(after - before)))
    return torch.stack(columns, 1)[..., None] if columns else None
