"""A whole fit: coarse search, then least squares stage by stage; it can be continued after every iteration."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._files import write_json
from gaussian_swaying._inputs import read_json
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.evidence import (
    Block,
    Evidence,
    Followed,
    Judged,
    PictureEvidence,
    TrackEvidence,
    compare,
    compare_starts,
    distrust,
    fitted_part,
    prepared,
    scales_of,
    trusted,
    write_before,
)
from gaussian_swaying.inverse.report import (
    BEFORE,
    PICTURES,
    Result,
    consequences,
    predictions,
    wind_seen,
    write_page,
    write_results,
)
from gaussian_swaying.inverse.tracks import Tracks, beside_rest, match, opencv, still_until, track
from gaussian_swaying.inverse.unknowns import (
    FILM_START,
    PRIOR,
    Plan,
    Unknown,
    apart_by,
    bent_alike,
    changes,
    changes_of,
    check_apart,
    check_unknowns,
    check_variants,
    directions,
    is_mirrored,
    parse_base,
    prior_of,
    read_unknown,
    rivals_of,
    states_of,
    steady_share,
    values_at,
)
from gaussian_swaying.inverse.videos import Footage, frame_times, read_videos
from gaussian_swaying.mpm.state import State
from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder
from gaussian_swaying.simulation.simulation import Simulation

STEP = 0.004
"""Step of the finite differences, as a share of the range."""

HUBER = 1.345
"""Standard deviations above which a residual counts less (Huber 1981: 95 % efficiency)."""

START = 1e-6
"""Damping of the first step: nearly none, as damping mostly slows combinations that the video hardly determines."""

BETTER, WORSE, LEAST_DAMPING = 0.03, 30.0, 1e-3
"""Factor on the damping after a step that lowered the cost at once and as expected, that between the shorter steps that
are tried after one that did not lower it, and their least damping."""

SHORTER = 5
"""Shorter steps that are tried at once."""

AS_EXPECTED = 0.5
"""Least share of the fall of the cost that linear residuals have, with which the damping is lowered."""

LEAST_GAIN = 1e-4
NO_STEP = "no step is better"
REACH = 0.25
"""Longest step, as a share of each range."""

Residuals = Callable[[Tensor], list[Block]]
"""Residuals at some points (B, U), each a share of every range."""

Rescale = Callable[[Sequence[Block]], dict[str, float]]
"""Robust standard deviation of the first variant's residuals, for each kind."""

Retract = Callable[[Tensor, Tensor], Tensor]
"""The end of a step from a place, both in shares of the ranges (U,): the sum, or along what is straight otherwise."""


class DivergedError(ValueError):
    """No simulation of a step is finite."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations: sums over the residuals and their sensitivities at a point.

    Attributes:
        cost: Mean of Huber's function over all residuals, each in standard deviations.
        gradient: Weighed sum of sensitivity times residual, shape (U,).
        matrix: Weighed sum of sensitivity times sensitivity, J^T W J, shape (U, U).
        scores: The gradient of each cluster of correlated residuals, shape (C, U): patches of the object at all times,
            and parts of the time all over the object.
        count: Number of residuals.
    """

    cost: float
    gradient: Tensor
    matrix: Tensor
    scores: tuple[Tensor, Tensor]
    count: int

    def covariance(self) -> Tensor:
        r"""Covariance of the unknowns in shares of their ranges, shape (U, U).

        :math:`A^{-1} \bigl(\sum \tfrac{C}{C - 1} \sum_c g_c g_c^T\bigr) A^{-1} + A^{-1}`, where the gradients are
        summed over clusters of correlated residuals: the sandwich of White (1980) and Liang & Zeger (1986).
        Neighbouring tracks at all times are clusters, and so are all tracks in a part of the time, as a fault of the
        model is alike all over the object. The usual :math:`s^2 A^{-1}` takes all residuals for
        independent, and is far too small alone. It is added, as the sandwich of few clusters, or of residuals below the
        lower bound of the standard deviation, may be near zero.
        """
        inverse = torch.linalg.pinv(self.matrix, hermitian=True)
        middle = torch.zeros_like(self.matrix)
        for scores in self.scores:
            clusters = int((scores.abs().sum(-1) > 0).sum())
            middle = middle + clusters / max(clusters - 1, 1) * scores.mT @ scores
        return inverse @ middle @ inverse + inverse


@dataclass
class Progress:
    """The state of an optimisation; enough to continue it.

    Attributes:
        place: Values of the unknowns, as shares of their ranges, shape (U,).
        damping: Damping of the next step.
        iteration: Iterations done.
        normal: The normal equations at ``place``; None if they are to be computed.
        scales: Standard deviations of each kind of residual there.
        done: The reason why it ended; empty if it did not.
    """

    place: Tensor
    damping: float = START
    iteration: int = 0
    normal: Normal | None = None
    scales: dict[str, float] = field(default_factory=dict)
    done: str = ""


def huber(blocks: Sequence[Block], scales: Mapping[str, float]) -> Tensor:
    """Cost of each variant, shape (B,); infinite for one that is not finite."""
    total, count = torch.zeros(len(blocks[0].values), dtype=torch.float64), 0
    for block in blocks:
        size = block.values.norm(dim=-1) / scales[block.kind]
        loss = torch.where(size < HUBER, 0.5 * size.square(), HUBER * (size - 0.5 * HUBER))
        total, count = total + loss.sum(-1), count + size.shape[-1]
    return torch.where(torch.isfinite(total), total, float("inf")) / max(count, 1)


def normal_equations(blocks: Sequence[Block], scales: Mapping[str, float], steps: Tensor) -> Normal:
    """Normal equations, from the residuals of the first variant and the differences of the others.

    Args:
        blocks: Residuals of 1 + U variants; variant 1 + u differs from the first in unknown u.
        scales: Standard deviation of each kind.
        steps: The difference in each unknown, as a share of its range, shape (U,).
    """
    unknowns, gradient, matrix, count = len(steps), 0.0, 0.0, 0
    clusters = sum(int(block.cluster.max()) + 1 if len(block.cluster) else 0 for block in blocks)
    scores, first = torch.zeros(clusters, unknowns, dtype=torch.float64), 0
    times = torch.zeros(1 + max(int(_moment(block).amax()) for block in blocks), unknowns, dtype=torch.float64)
    for block in blocks:
        sigma = scales[block.kind]
        residual = block.values[0] / sigma
        change = (block.values[1:] - block.values[:1]) / (sigma * steps[:, None, None])
        usable = torch.isfinite(residual).all(-1) & torch.isfinite(change).all(-1).all(0)
        residual, change, cluster = residual[usable], change[:, usable], block.cluster[usable]
        moment = _moment(block)[usable]
        weight = HUBER / residual.norm(dim=-1).clamp(min=HUBER)
        own = ((change * residual).sum(-1) * weight).mT  # (R, U)
        gradient = gradient + own.sum(0)
        flat = (change * weight.sqrt()[:, None]).flatten(1)
        matrix = matrix + flat @ flat.mT
        scores.index_add_(0, cluster + first, own)
        times.index_add_(0, moment, own)
        first, count = first + (int(block.cluster.max()) + 1 if len(block.cluster) else 0), count + len(residual)
    assert isinstance(gradient, Tensor)
    assert isinstance(matrix, Tensor)
    base = [block.of(block.values[:1]) for block in blocks]
    return Normal(float(huber(base, scales)[0]), gradient, matrix, (scores, times), count)


def _moment(block: Block) -> Tensor:
    return torch.zeros_like(block.cluster, dtype=torch.long) if block.moment is None else block.moment


def sensitivities(residuals: Residuals, place: Tensor) -> tuple[list[Block], Tensor]:
    """Return the residuals at a point with their central differences, and the widths of these, shape (U,).

    Steps go to both sides, as far as the range allows: one-sided differences bias the gradient, and in a narrow valley,
    such as that of wind, stiffness and density raised together, one-sided steps find no lower cost even far from the
    minimum.
    """
    unknowns = len(place)
    up, down = (place + STEP).clamp(max=1.0), (place - STEP).clamp(min=0.0)
    beside = [place + torch.diag(end - place) for end in (up, down)]
    found = []
    for block in residuals(torch.cat([place[None], *beside])):
        here, high, low = block.values.split([1, unknowns, unknowns])
        found.append(block.of(torch.cat([here, here + high - low])))
    return found, up - down


def linearised(residuals: Residuals, rescale: Rescale, place: Tensor) -> tuple[Normal, dict[str, float], list[Block]]:
    """Return the normal equations at a place, the standard deviations of its residuals, and the residuals."""
    blocks, steps = sensitivities(residuals, place)
    scales = rescale(blocks)
    return normal_equations(blocks, scales, steps), scales, blocks


def iterate(
    residuals: Residuals,
    rescale: Rescale,
    progress: Progress,
    tolerance: float,
    least_gain: float = LEAST_GAIN,
    retract: Retract = torch.add,
) -> None:
    """One iteration; ``progress`` is updated, also with the reason to stop.

    Args:
        residuals: Computes residuals.
        rescale: Standard deviations of the first variant's residuals.
        progress: The state to start from.
        tolerance: Smallest step worth another iteration, as a share of the ranges.
        least_gain: Smallest share of the cost worth another iteration.
        retract: Takes a step.
    """
    if progress.normal is None:
        progress.normal, progress.scales, _ = linearised(residuals, rescale, progress.place)
        if progress.normal.count == 0:
            raise DivergedError("Every simulation of a step diverged: narrow the ranges of `unknowns`.")
    normal, place = progress.normal, progress.place
    progress.iteration += 1

    def end_with(damping: float) -> Tensor:
        return retract(place, step_from(normal, place, damping) - place).clamp(0.0, 1.0)

    trial = end_with(progress.damping)
    there, scales, blocks = linearised(residuals, rescale, trial)
    cost = float(huber([block.of(block.values[:1]) for block in blocks], progress.scales)[0])
    shortened = not cost < normal.cost
    if shortened and float((trial - place).abs().amax()) < tolerance:  # a shorter one is none either
        progress.done = NO_STEP
        return
    if shortened:
        least = max(progress.damping * WORSE, LEAST_DAMPING)
        dampings = [least * WORSE**k for k in range(SHORTER)]
        trials = torch.stack([end_with(damping) for damping in dampings])
        costs = huber(residuals(trials), progress.scales)
        best = int(costs.argmin())
        cost, trial, progress.damping = float(costs[best]), trials[best], dampings[best]
        if not cost < normal.cost:
            progress.done = NO_STEP
            return
        there, scales, _ = linearised(residuals, rescale, trial)
    moved, gain = float((trial - place).abs().amax()), normal.cost - cost
    progress.place, progress.normal, progress.scales = trial, there, scales
    damped = progress.damping > LEAST_DAMPING
    if not shortened and gain > AS_EXPECTED * normal.cost * expected_gain(normal, trial - place):
        progress.damping *= BETTER
    if damped:  # a short step says nothing, but if it is the best
        progress.done = NO_STEP if shortened and moved < tolerance else ""
        return
    if moved < tolerance:
        progress.done = f"the last step was below {tolerance:g} of every range"
    elif gain < least_gain * normal.cost:
        progress.done = f"the last step lowered the cost by less than {least_gain:.2%}"


def step_from(normal: Normal, place: Tensor, damping: float = 0.0) -> Tensor:
    """Return the values after a damped step; an unknown at an end of its range that would leave it is kept."""
    free = torch.ones_like(place, dtype=torch.bool)
    for _ in range(len(place) + 1):
        matrix = normal.matrix[free][:, free]
        damped = matrix + (damping + 1e-12) * torch.diag(matrix.diagonal().clamp(min=1e-12))
        step = torch.zeros_like(place)
        step[free] = -torch.linalg.solve(damped, normal.gradient[free])
        blocked = free & (((place <= 0) & (step < 0)) | ((place >= 1) & (step > 0)))
        if not bool(blocked.any()) or not bool((free & ~blocked).any()):
            break
        free &= ~blocked
    longest = float(step.abs().amax())
    return (place + step * min(1.0, REACH / max(longest, 1e-12))).clamp(0.0, 1.0)


def expected_gain(normal: Normal, step: Tensor) -> float:
    """Expected relative decrease of the cost for a step, with linearised residuals."""
    fall = -(normal.gradient @ step + 0.5 * step @ normal.matrix @ step) / max(normal.count, 1)
    return float(fall) / max(normal.cost, 1e-300)


FAR = 0.005
"""Step, as a share of a range, above which the values have not settled."""

GAIN = 0.003
"""Least expected relative decrease of the cost by such a step; below it, the step would change nothing visible."""

_BEGIN = "put `pixels` last in `stages`, raise `search`, or give a `start` that is nearer"


def unsettled(normal: Normal, place: Tensor, unknowns: Sequence[Unknown], ended: str) -> str:
    """Return a sentence that says why the end of a fit is not a local minimum; empty if it is one.

    The sentence names what the next Gauss-Newton step would change, and the remedy. A lower minimum elsewhere is not
    detected.

    Args:
        normal: The normal equations at the end.
        place: The values at the end, as shares of the ranges, shape (U,).
        unknowns: The unknowns.
        ended: The reason why the last iterations ended, see :class:`~gaussian_swaying.inverse.fit.Progress`;
            empty if their number ran out.
    """
    step = step_from(normal, place) - place
    gain = expected_gain(normal, step)
    if float(step.abs().amax()) <= FAR or gain <= GAIN:
        return ""
    why = {"": "`iterations` ran out", NO_STEP: "no step lowered the cost"}.get(ended, ended)
    remedy = _BEGIN if ended else "raise `iterations` and continue with --resume"
    told = f"{changes(step.tolist(), unknowns, place)}, to lower the cost by {gain:.2g} of itself"
    return f"The values have not settled: {why}, but the sensitivities ask for {told}: {remedy}."


LEAST = 0.05
"""Least speed after a step, per that before."""


def straight(unknowns: Sequence[Unknown]) -> Retract:
    """Return the function that takes a step from a place, both as shares of the ranges (U,).

    Args:
        unknowns: What is sought. Without ``wind.speed`` and ``wind.azimuth``, a step is added.
    """
    names = [unknown.name for unknown in unknowns]
    if not {"wind.speed", "wind.azimuth"} <= set(names):
        return torch.add
    k, j = names.index("wind.speed"), names.index("wind.azimuth")
    speed, azimuth = unknowns[k], unknowns[j]

    def end_of(place: Tensor, step: Tensor) -> Tensor:
        end, here, begin = place + step, float(place[k]), float(place[j])
        along = max(1 + float(step[k]) * speed.slope(here) / speed.value(here), LEAST)
        across = math.radians(float(step[j]) * azimuth.slope(begin))
        turned = azimuth.value(begin) + math.degrees(math.atan2(across, along))
        end[k] = speed.share(speed.value(here) * math.hypot(along, across))
        end[j] = azimuth.share(min(max(turned, azimuth.low), azimuth.high))
        return end

    def moved(place: Tensor, step: Tensor) -> Tensor:
        if not speed.value(float(place[k])) > 0:  # it has no direction there
            return place + step
        while float(((end := end_of(place, step)) - place).abs().amax()) > 1.001 * REACH:  # shorter on the same line
            step = 0.5 * step
        return end

    return moved


PROGRESS, VALUES, RESULT, SCENE = "fit.json", "values.csv", "result.json", "scene.yaml"
PAGE = "page.html"
OURS = (PROGRESS, PAGE, VALUES, RESULT, SCENE, PICTURES)
HORIZONS = (0.25, 0.5)
"""Shares of the fitted frames that the first stage takes, one after the other, and all frames if no matches follow.

Chaos grows with time: in a flapping flag, a change of Young's modulus by a hundredth makes pixels of difference
within two seconds, and over the whole video the cost has local minima far from the global one. So the first horizon is
the shortest time that determines the unknowns, and its solution must be exact before time is added."""

MATCHED = (0.5, 0.5, 0.75, 1.0, 1.0)
"""Shares of the fitted frames that are used, one for each time that Gaussians are matched again."""

SEARCHED = 0.5
"""Share of the fitted frames that the coarse search looks at."""

NEAR = 0.1
"""Standard deviation of the second part of the search, as a share of the ranges."""

COARSE = {"tracks": 0.02, "matches": 0.02, "silhouettes": 0.1, "pixels": 0.1}
"""Standard deviations of residuals in the coarse search: shares of the picture's width, and grey levels."""

CLOSELY = (3e-4, LEAST_GAIN)
"""Shortest step of the last stage, as a share of the ranges, and least gain, as a share of the cost."""

ROUGHLY = (30 * CLOSELY[0], 30 * CLOSELY[1])
"""The same of the other steps."""

LONG_STILL = 0.05
"""Longest time that a film may be still, if the start of its motion is no unknown [s]; slow objects need a frame."""

SPREAD = ("wind.speed", "wind.azimuth")
"""Unknowns whose starts are spread over their ranges although one was given."""

APART, SAME = 0.15, 0.03
"""Least distance between starts, and largest between ends that are the same, as a share of a range."""

BRIEF = 4
"""Most iterations of a short solve at a horizon."""

RIVAL, MIRRORED = 1.05, 1.25
"""Cost per that of the best end below which another end may be right as well, and that of the mirrored wind, which
differs by so little that errors of the model decide: a wrong one was lower by a tenth."""

LOWER = 1.02
"""Cost per that of the best end above which a fit goes on from there."""

ROUNDS = 2
"""Most times that a fit goes on from a better end."""

DRAG = ("aero.C_D", "aero.C_F")
"""Coefficients that scale the force of the wind."""

LATER = 0.2
"""Share of the fitted frames that a wind which changes has to predict."""

PREFERRED = 0.8
"""Distance that it leaves there per that of a steady one, above which the steady one is taken."""

GRIDS = (0.8, 1.25)
"""Cells of other grids that tell the error of the grid, per its own."""

REFINED = 5
"""Most iterations on another grid."""

BEGUN, BEGINS = 12, 10
"""Simulations that are compared with the first frame of a film in motion, and starts of each."""

MOST_STARTS = 60
"""Most starts of the motion that the coarse search tries with each simulation."""

AWAY = 3.0
"""Largest distance between the first frame and the splat at rest in a film that begins at rest [pixels]."""

Say = Callable[[str], None]


@dataclass
class Course:
    """The resume state of a fit, as ``fit.json`` stores it.

    Attributes:
        step: Number of the step, which is a stage at a horizon.
        place: Values of the unknowns, as shares of their ranges.
        first: Values (as shares) whose simulation the first frame looks like; empty if it shows the scene at rest.
        rivals: Where other starts ended, as shares, to be compared with the end.
        matched: Values (as shares) at which the current step began, and Gaussians were matched; empty before it.
        rounds: How often it went on from another end.
        damping: See :class:`~gaussian_swaying.inverse.fit.Progress`.
        iteration: Iterations done in this step.
        ended: The reason why the iterations of this step ended; empty if they did not.
        history: One row for each iteration.
        directions: The principal directions of the sensitivities.
        seconds: Time spent.
    """

    step: int = -1
    place: list[float] = field(default_factory=list)
    first: list[float] = field(default_factory=list)
    rivals: list[list[float]] = field(default_factory=list)
    matched: list[float] = field(default_factory=list)
    rounds: int = 0
    damping: float = START
    iteration: int = 0
    ended: str = ""
    history: list[dict[str, Any]] = field(default_factory=list)
    directions: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


class Fit:
    """Finds the unknowns of a simulation from videos.

    Args:
        simulation: The base, with all that is known.
        videos: From :func:`~gaussian_swaying.inverse.videos.read_videos`.
        plan: The unknowns, and how to find them.
        say: Called with a line for each thing that is done.
        on_grid: Makes the simulation with cells so many times as large, to know what the grid does to the values; None
            to leave that.
        judged: What the background said of the videos, see :func:`~gaussian_swaying.inverse.evidence.prepared`.

    Raises:
        ValueError: If the plan does not fit the simulation or the videos.
    """

    def __init__(
        self,
        simulation: Simulation,
        videos: Sequence[Footage],
        plan: Plan,
        say: Say = lambda line: None,
        judged: Sequence[Judged] = (),
        on_grid: Callable[[float], Simulation] | None = None,
    ) -> None:
        check_unknowns(simulation, plan.unknowns)
        self.simulation, self.videos, self.plan, self.say = simulation, list(videos), plan, say
        self.judged, self.on_grid = tuple(judged), on_grid
        self.times = frame_times(videos)
        fitted = max(3, round(plan.fit_share * len(self.times)))
        if plan.until is not None:
            fitted = sum(time <= plan.until + 1e-6 for time in self.times)
            if fitted < 3:
                raise ValueError(f"Fewer than three frames lie before `until` = {plan.until:g} s: raise it.")
        self.fitted = self.times[:fitted]
        masked = any(video.masks is not None for video in videos)
        self.stages = [stage for stage in plan.stages if masked or stage != "silhouettes"]
        if not self.stages:
            raise ValueError(
                "The videos have no silhouettes: give `mask_path` or transparent images, or add tracks to `stages`."
            )
        check_variants(simulation)
        self.retract = straight(plan.unknowns)
        self._tracks: list[Tracks] | None = None
        self._other_grids: list[Simulation] | None = None
        self._check_begins()
        self.first: list[float] = []

    def _check_begins(self) -> None:
        """Points are followed from the start of the motion, or a state before it, so all cameras have to see that."""
        sought = [u.low for u in self.plan.unknowns if u.name == FILM_START]
        for video in self.videos:
            begin, step = video.times[0], (video.times[-1] - video.times[0]) / max(len(video.times) - 1, 1)
            if self.followed and begin > max([1.5 * step, *sought]):
                raise ValueError(
                    f"The frames of camera {video.name} begin at {begin:.3g} s, but points are followed from 0 s on: "
                    "cut all videos to the same beginning, or leave that camera out of `cameras`."
                )

    # ---- what is compared

    @property
    def followed(self) -> bool:
        """True if points are followed from frame to frame; otherwise the videos may have too little texture."""
        return "tracks" in (*self.stages, self.first_stage)

    @property
    def first_stage(self) -> str:
        """The stage that needs no place to begin from."""
        return "tracks" if self.stages[0] == "matches" else self.stages[0]

    def _until(self, share: float) -> list[float]:
        """Times of a share of the fitted frames."""
        return self.fitted[: max(3, round(share * len(self.fitted)))]

    @property
    def moving(self) -> bool:
        """True if the films may begin in motion."""
        return any(u.name == FILM_START and u.low < 0 for u in self.plan.unknowns)

    @property
    def tracks(self) -> list[Tracks]:
        if self._tracks is None:
            shown = self._first_shown() if self.first else None
            self._tracks = [track(self.simulation, video, self.plan.tracks, shown) for video in self.videos]
            if sum(len(own.index) for own in self._tracks) < 4:
                raise ValueError(
                    "Fewer than four points of the object can be followed: give sharper videos, or use the `stages` "
                    "silhouettes and pixels."
                )
        return self._tracks

    def look(self, folder: Path) -> list[Path]:
        """Write pictures to look at before the fit, into ``before`` of a folder, and return them."""
        return write_before(folder / BEFORE, self.simulation, self.videos, self.tracks if self.followed else None)

    def _first_shown(self) -> DeformedGaussians:
        states = next(self._run(torch.tensor([self.first], dtype=torch.float64), [0.0]))
        return self.simulation.painter.deformed(states[0])

    def begin_from(self, places: Tensor) -> list[float]:
        """Return which of some places (B, U) the first frame of a film in motion looks like most, with its best start.

        That is the one from whose pictures the most Gaussians are found in the first frames. One simulation of each
        shows all starts.
        """
        column = [u.name for u in self.plan.unknowns].index(FILM_START)
        known = self.plan.unknowns[column]
        before = torch.linspace(max(0.0, -known.high), -known.low, BEGINS, dtype=torch.float64).tolist()
        brief = [replace(video, images=video.images[:1], itself=False) for video in self.videos]  # it only counts
        values = [{name: v for name, v in self.values(place).items() if name != FILM_START} for place in places]
        best, most = places[0], -1
        for ago, states in zip(before, states_of(self.simulation, values, before, alike=False), strict=True):
            for place, state in zip(places, states[: None if ago else 1], strict=False):  # at rest all are alike
                shown = self.simulation.painter.deformed(state)
                tracks = [track(self.simulation, video, self.plan.tracks, shown) for video in brief]
                if (found := sum(int(own.seen[0].sum()) for own in tracks)) > most:
                    most, best = found, place.clone()
                    best[column] = known.share(-ago)
        return [float(share) for share in best]

    def evidence(self, stage: str, matched: Sequence[float] = ()) -> list[Evidence]:
        """Return the residuals of a stage, one list entry for each video and kind."""
        found: list[Evidence] = []
        if stage == "pixels":
            return [PictureEvidence(video, masks=False) for video in self.videos]
        if stage == "tracks" or (stage == "silhouettes" and "tracks" in self.stages):
            pairs = zip(self.videos, self.tracks, strict=True)
            found += [
                TrackEvidence(self.simulation, video, fitted_part(tracks), weighed=True) for video, tracks in pairs
            ]
        if stage == "silhouettes":
            found += [PictureEvidence(video, masks=True) for video in self.videos if video.masks is not None]
        if stage == "matches":
            found += self._matches(matched)
        return found

    def _matches(self, place: Sequence[float]) -> list[Evidence]:
        states: list[list[State]] = [[] for _ in self.videos]
        probes = [TrackEvidence(self.simulation, video, _NOTHING) for video in self.videos]
        for moment, found in zip(self.fitted, self._run(torch.tensor([list(place)]), self.fitted), strict=True):
            for own, probe in zip(states, probes, strict=True):
                if probe.frame_at(moment) is not None:
                    own.append(found[0])
        tracks = [
            match(self.simulation, v, own, self.plan.tracks, self.moving)
            for v, own in zip(self.videos, states, strict=True)
        ]
        pairs = zip(self.videos, tracks, strict=True)
        return [TrackEvidence(self.simulation, v, fitted_part(own), weighed=True) for v, own in pairs]

    def _trusted(self, evidence: Sequence[Evidence], place: Sequence[float]) -> list[Evidence]:
        return trusted(self.simulation, self._grids(), evidence, self.values(place), self.fitted)

    def _grids(self) -> list[Simulation]:
        if self._other_grids is None:
            self._other_grids = []
            for ratio in GRIDS if self.on_grid else ():
                try:
                    with warnings.catch_warnings():  # of an object of few cells
                        warnings.simplefilter("ignore")
                        self._other_grids.append(self.on_grid(ratio))  # type: ignore[misc]
                except ValueError as error:
                    told = f"cells {ratio:g} times as large, to know the error of the grid, are not possible: {error}"
                    self.say(told)
        return self._other_grids

    def _run(self, places: Tensor, times: Sequence[float]) -> Any:
        return states_of(self.simulation, [self.values(place) for place in places], times, alike=False)

    def values(self, place: Tensor | Sequence[float]) -> dict[str, float]:
        """Values of the unknowns at a place, given as shares of the ranges."""
        return values_at(self.plan.unknowns, place)

    def residuals(self, evidence: Sequence[Evidence], times: Sequence[float]) -> Callable[[Tensor], list[Block]]:
        """The residuals of some evidence up to a horizon, as a function of places (B, U)."""

        def at(places: Tensor) -> list[Block]:
            values = [self.values(place) for place in places]
            prior = prior_of(self.plan.unknowns, places)
            found = compare(self.simulation, evidence, values, times, moving=self.moving)
            return found if prior is None else [*found, Block(PRIOR, prior, torch.arange(prior.shape[1]))]

        return at

    # ---- the steps

    def steps(self) -> list[tuple[str, float]]:
        """Stage and horizon of every step: horizons grow up to the last matches, then all fitted frames are taken."""
        found: list[tuple[str, float]] = []
        for number, stage in enumerate(self.stages):
            begun = HORIZONS if number == 0 else ()
            if stage == "matches":
                shares = (*begun[:1], *MATCHED)
            elif "matches" in self.stages[number + 1 :]:
                shares = begun or HORIZONS[-1:]
            else:
                shares = (*begun, 1.0)
            found += [(stage, share) for share in shares]
        return found

    def search(self) -> list[list[float]]:
        """Return the best starts of a coarse search: Sobol's sequence over the ranges, then draws around the best.

        Coefficients and damping stay in the middle of their ranges, and what has a ``start`` stays there, but for
        :data:`SPREAD`. Then other stiffnesses are tried that bend as far as the best. Values that were given are the
        first start. Simulations of similar stiffness are one batch.
        """
        unknowns, plan = self.plan.unknowns, self.plan
        begin = [0.5 if u.start is None else u.share(u.start) for u in unknowns]
        given = any(u.start is not None for u in unknowns)
        moving = [
            k
            for k, u in enumerate(unknowns)
            if (u.start is None or u.name in SPREAD) and not u.name.startswith(("aero.", "solver."))
        ]
        if not plan.search or not moving:
            if self.moving and self.followed:
                self.first, self._tracks = begin, None
            return [begin]
        places = torch.tensor([begin]).repeat(max(1, 3 * plan.search // 4), 1).double()
        sobol = torch.quasirandom.SobolEngine(len(moving), scramble=True, seed=plan.seed)
        places[:, moving] = sobol.draw(len(places)).double()
        if self.moving and self.followed:
            self.first, self._tracks = self.begin_from(places[:BEGUN]), None
        evidence = self.evidence(self.first_stage)
        times = self._until(SEARCHED)
        places = torch.cat([torch.tensor([begin] * given, dtype=torch.float64).reshape(-1, len(begin)), places])
        places, costs = self._coarse(places, evidence, times)
        if others := bent_alike(unknowns, places[int(costs.argmin())].tolist()):
            stiff, other = self._coarse(torch.tensor(others, dtype=torch.float64), evidence, times)
            places, costs = torch.cat([places, stiff]), torch.cat([costs, other])
        generator = torch.Generator().manual_seed(plan.seed)
        near = places[int(costs.argmin())].repeat(plan.search - 3 * plan.search // 4, 1)
        if len(near):
            shift = torch.randn(len(near), len(moving), generator=generator, dtype=torch.float64)
            near[:, moving] = (near[:, moving] + NEAR * shift).clamp(0.02, 0.98)
            near, other = self._coarse(near, evidence, times)
            places, costs = torch.cat([places, near]), torch.cat([costs, other])
        if not bool(torch.isfinite(costs).any()):
            raise DivergedError("Every simulation of the coarse search diverged: narrow the ranges of `unknowns`.")
        found = places[:1].tolist() if given else []
        for place in places[costs.argsort()].tolist():
            apart = all(apart_by(unknowns, place, other) > APART for other in found)
            if len(found) < plan.starts and apart:
                found.append(place)
        return found

    def best_of(self, places: Sequence[Sequence[float]]) -> list[list[float]]:
        """Solve from several starts for a short while, and return the best end, and others with nearly its cost.

        Horizons grow, and at each the worse half is left.
        """
        if len(places) < 2:
            return [list(place) for place in places]
        evidence = self.evidence(self.first_stage)
        kept, left = [list(place) for place in places], len(places)
        for share in HORIZONS:
            times = self._until(share)
            ended, costs = self._brief(kept, evidence, times)
            for place, cost in zip(ended, costs, strict=True):
                self.say(f"start to {times[-1]:.3g} s: cost {cost:.3g}, {self._shown(place)}")
            left = (left + 1) // 2
            kept = ended[:left]
        return kept[:1] + [place for place, cost in zip(ended[1:], costs[1:], strict=True) if cost < 2 * costs[0]][:1]

    def _brief(
        self, places: Sequence[Sequence[float]], evidence: Sequence[Evidence], times: Sequence[float]
    ) -> tuple[list[list[float]], list[float]]:
        """Short solves from some places: their ends, apart from each other and the best first, and their costs."""
        return self._ranked([self._ended(place, evidence, times) for place in places])

    def _ended(
        self, place: Sequence[float], evidence: Sequence[Evidence], times: Sequence[float]
    ) -> tuple[list[float], list[Block], dict[str, float]] | None:
        """The end of a short solve, its residuals and their standard deviations; None if it diverges."""
        residuals, progress = self.residuals(evidence, times), Progress(torch.tensor(place, dtype=torch.float64))
        with suppress(DivergedError):
            while not progress.done and progress.iteration < BRIEF:
                iterate(residuals, _scaled(evidence), progress, *ROUGHLY, self.retract)
            blocks = residuals(progress.place[None])
            return progress.place.tolist(), blocks, _scaled(evidence)(blocks)
        return None

    def _ranked(
        self, solved: Sequence[tuple[list[float], list[Block], dict[str, float]] | None], more: Sequence[float] = ()
    ) -> tuple[list[list[float]], list[float]]:
        """Ends that are apart from each other, the best first, and their costs with the least standard deviations.

        ``more`` is added to the costs of those that have ended.
        """
        found = [one for one in solved if one is not None]
        if not found:
            raise DivergedError("Every simulation of a start diverged: narrow the ranges of `unknowns`.")
        scales = {kind: min(own[kind] for _, _, own in found) for kind in found[0][2]}
        costs = [float(huber(blocks, scales)) for _, blocks, _ in found]
        costs = [cost + other for cost, other in zip(costs, more or [0.0] * len(costs), strict=True)]
        apart: list[int] = []
        for k in sorted(range(len(found)), key=costs.__getitem__):
            if all(apart_by(self.plan.unknowns, found[k][0], found[j][0]) > SAME for j in apart):
                apart.append(k)
        return [found[k][0] for k in apart], [costs[k] for k in apart]

    def _each_from_its_own(
        self, places: Sequence[Sequence[float]], stage: str
    ) -> tuple[list[list[float]], list[float]]:
        """Short solves as :meth:`_brief`, of a film in motion: each compares the points that its own first frame has.

        Points that are followed from where one place has them speak for that place.
        """
        solved, more = [], []
        for place in places:
            own = copy(self)
            own.first, own._tracks = list(place), None
            with suppress(DivergedError, ValueError):  # it has no such points
                evidence = own._trusted(own.evidence(stage), place)
                if (found := own._ended(place, evidence, self.fitted)) is not None:
                    solved.append(found)
                    more.append(distrust(evidence, self.fitted))
        return self._ranked(solved, more)

    def _others(
        self, place: Sequence[float], rivals: Sequence[Sequence[float]]
    ) -> tuple[list[dict[str, float]], list[float]]:
        """Values of other ends that cost as little as the best one, and the best place if it is clearly better.

        Other starts, and the rivals that are known of any fit, are tried over all fitted frames.
        """
        model, unknowns = self.simulation.model, self.plan.unknowns
        tried = [*map(list, rivals), *rivals_of(model, unknowns, place)]
        if not tried:
            return [], []
        if self.moving and self.followed:
            try:
                ended, costs = self._each_from_its_own([place, *tried], self.first_stage)
            except DivergedError:
                return [], []
        else:
            ended, costs = self._brief(
                [place, *tried], self._trusted(self.evidence(self.first_stage), place), self.fitted
            )
        for end, cost in zip(ended, costs, strict=True):
            self.say(f"rival: cost {cost:.5g}, {self._shown(end)}")
        away = [apart_by(unknowns, end, place) for end in ended]
        most = [MIRRORED if is_mirrored(model, unknowns, place, end) else RIVAL for end in ended]
        near = [k for k, cost in enumerate(costs) if cost < most[k] * costs[0]]
        own = away.index(min(away))
        better = ended[0] if costs[own] > LOWER * costs[0] and away[0] > 2 * SAME else []
        return [self.values(ended[k]) for k in near if away[k] > 2 * SAME], better

    def _coarse(self, places: Tensor, evidence: Sequence[Evidence], times: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Return the places with the best start of the motion for each, and their costs.

        In a steady wind one simulation shows what any start would.
        """
        width = max(video.size[0] for video in self.videos)
        scales = {kind: size * (width if kind in ("tracks", "matches") else 1) for kind, size in COARSE.items()}
        values = [self.values(place) for place in places]
        known = {u.name: u for u in self.plan.unknowns}.get(FILM_START)
        if known is None or known.start is not None:
            return places, huber(compare(self.simulation, evidence, values, times, False, self.moving), scales)
        step = max(times[1] - times[0], (known.high - known.low) / MOST_STARTS)
        starts = [step * k for k in range(math.ceil(known.low / step), math.floor(known.high / step) + 1)] or [
            known.low
        ]
        each = torch.stack([huber(b, scales) for b in compare_starts(self.simulation, evidence, values, times, starts)])
        costs, best = each.min(0)
        places = places.clone()
        column = [u.name for u in self.plan.unknowns].index(FILM_START)
        places[:, column] = torch.tensor([known.share(start) for start in starts], dtype=places.dtype)[best]
        return places, costs

    def run(self, course: Course, keep: Callable[[Course], None], films: Path | None = None) -> Result:
        """Do the steps that are missing, and return the result.

        Args:
            course: The resume state; a new one for a new fit.
            keep: Called after every iteration, to write the course.
            films: Folder for films beside the fit; None for none.
        """
        clock = time.monotonic() - course.seconds
        if course.step < 0:
            for note in self.notes():
                self.say(note)
            course.place, *course.rivals = self.best_of(self.search())
            course.first = list(self.first)
            self.say(f"search: {self._shown(course.place)}")
            self._check_apart(course)
            course.step, course.seconds = 0, time.monotonic() - clock
            keep(course)
        if self.first != course.first:  # it is continued
            self.first, self._tracks = course.first, None
        steps = self.steps()
        while True:
            evidence = self._stepped(course, keep, clock)
            others, better = self._others(course.place, course.rivals)
            if not better or course.rounds == ROUNDS:
                break
            self.say(f"another start fits better, so the fit goes on from there: {self._shown(better)}")
            course.rivals, course.place, course.rounds = [*course.rivals, course.place], better, course.rounds + 1
            if self.moving and self.followed:
                self.first, self._tracks = list(better), None
                course.first = list(better)
            course.step = next(k for k, (_, share) in enumerate(steps) if share == 1)
            course.iteration, course.damping, course.matched, course.ended = 0, START, [], ""
            keep(course)
        wider, places = self._changed(course.place, evidence) if self.plan.wind_changes else (self, course.place)
        if wider is not self:
            evidence = wider._trusted(wider.evidence(steps[-1][0], places), places)
        course.seconds = time.monotonic() - clock
        return wider.result(course, places, evidence, films, others if wider is self else ())

    def _stepped(self, course: Course, keep: Callable[[Course], None], clock: float) -> list[Evidence]:
        steps = self.steps()
        while True:
            stage, share = steps[course.step]
            times = self._until(share)
            course.matched = course.matched or list(course.place)
            evidence = self.evidence(stage, course.matched)
            if share >= HORIZONS[-1]:
                evidence = self._trusted(evidence, course.matched)
            place = torch.tensor(course.place, dtype=torch.float64)
            progress = Progress(place, course.damping, course.iteration, done=course.ended)
            last, residuals = course.step == len(steps) - 1, self.residuals(evidence, times)
            while not progress.done and progress.iteration < self.plan.iterations:
                iterate(residuals, _scaled(evidence), progress, *(CLOSELY if last else ROUGHLY), self.retract)
                course.place, course.damping = progress.place.tolist(), progress.damping
                course.iteration, course.ended = progress.iteration, progress.done
                course.seconds = time.monotonic() - clock
                assert progress.normal is not None
                row = {
                    "stage": stage,
                    "horizon_s": times[-1],
                    "iteration": progress.iteration,
                    "cost": progress.normal.cost,
                }
                row |= {"damping": progress.damping, "ended": progress.done}
                course.history.append(
                    row | {f"scale_{k}": v for k, v in progress.scales.items()} | self.values(course.place)
                )
                self.say(f"{stage} to {times[-1]:.3g} s, {progress.iteration}: {self._shown(course.place)}")
                keep(course)
            if last:  # more `iterations` continue it
                return evidence
            course.step, course.iteration, course.damping, course.matched = course.step + 1, 0, START, []
            course.ended = ""
            keep(course)

    def _changed(self, place: Sequence[float], evidence: Sequence[Evidence]) -> tuple[Fit, list[float]]:
        """The fit in a wind that changes, and its place, if it predicts held-out frames better; else this one.

        Both are fitted to the first four fifths of the fitted frames, and compared in the others.
        """
        early = self._until(1 - LATER)
        late = self.fitted[len(early) :]
        unknowns = changes_of(self.plan.unknowns, self.fitted[-1])
        wider = Fit(
            self.simulation,
            self.videos,
            replace(self.plan, unknowns=[*self.plan.unknowns, *unknowns]),
            self.say,
            self.judged,
            self.on_grid,
        )
        wider.first, wider._tracks = self.first, self.tracks if self.followed else None
        wider._other_grids = self._grids()
        start = [*place, *map(steady_share, unknowns)]
        left = []
        for fit_, begin in ((self, list(place)), (wider, start)):
            end = fit_.solved(begin, evidence, early)
            (block, *_) = compare(self.simulation, evidence, [fit_.values(end)], self.fitted, moving=self.moving)
            frames = compare(self.simulation, evidence, [fit_.values(end)], early, moving=self.moving)[0]
            left.append(float(block.values[0, frames.values.shape[1] :].norm(dim=-1).nanmedian()))
        told = f"{left[1]:.3g} pixels from the tracks after {early[-1]:.3g} s, a steady one {left[0]:.3g}"
        self.say(f"a wind that changes is {told}")
        if not late or not left[1] < PREFERRED * left[0]:
            return self, list(place)
        for _ in range(2):
            end = wider.solved(end, wider._trusted(wider.evidence(self.stages[-1], end), end), self.fitted)
        return wider, end

    def solved(self, place: Sequence[float], evidence: Sequence[Evidence], times: Sequence[float]) -> list[float]:
        """The place at which the iterations from another end."""
        progress = Progress(torch.tensor(place, dtype=torch.float64))
        while not progress.done and progress.iteration < self.plan.iterations:
            iterate(self.residuals(evidence, times), _scaled(evidence), progress, *ROUGHLY, self.retract)
            self.say(f"to {times[-1]:.3g} s, {progress.iteration}: {self._shown(progress.place.tolist())}")
        return progress.place.tolist()

    def result(
        self,
        course: Course,
        places: Sequence[float],
        evidence: Sequence[Evidence],
        films: Path | None,
        rivals: Sequence[Mapping[str, float]],
    ) -> Result:
        """The result at a place, from a course that has ended, the evidence of its last stage, and other answers."""
        place = torch.tensor(places, dtype=torch.float64)
        normal, model = self._at_the_end(place, evidence)
        found = directions(normal.matrix, self.plan.unknowns, place)
        followed = Followed(self.simulation, self.videos, self.tracks) if self.followed else None

        def moved() -> Iterator[DeformedGaussians]:
            for moment, own in zip(self.times, self._run(place[None], self.times), strict=True):
                if followed is not None and moment <= self.fitted[-1]:
                    followed.add(moment, own[0])
                yield self.simulation.painter.deformed(own[0])

        shown = predictions(self.simulation, self.videos, self.times, len(self.fitted), moved(), films)
        return Result(
            self.plan.unknowns,
            tuple(places),
            normal.covariance() + model,
            found,
            shown,
            course.history,
            course.seconds,
            unsettled(normal, place, self.plan.unknowns, course.ended),
            tuple(self.notes()),
            {} if followed is None else followed.shares(),
            judged=self.judged,
            rivals=rivals,
        )

    def _at_the_end(self, place: Tensor, evidence: Sequence[Evidence]) -> tuple[Normal, Tensor]:
        """The normal equations at a place, and the covariance that the grid adds, shape (U, U).

        The same residuals have their minimum elsewhere on a finer and on a coarser grid. It is found by iterations, as
        a linear step is often too short; that step counts where none lowers the cost.
        """
        normal, model = self._normal(place, evidence, self.fitted), torch.zeros(2 * (len(place),), dtype=torch.float64)
        for other in self._grids():
            own = [e.on(other) if isinstance(e, TrackEvidence) else e for e in evidence]
            there, progress = copy(self), Progress(place)
            there.simulation = other
            residuals = there.residuals(own, self.fitted)
            with suppress(DivergedError):
                while not progress.done and progress.iteration < REFINED:
                    iterate(residuals, _scaled(own), progress, *CLOSELY, self.retract)
            if progress.normal is None:
                continue
            moved = not torch.equal(progress.place, place)
            shift = (progress.place if moved else step_from(progress.normal, place)) - place
            model += torch.outer(shift, shift)
        return normal, model

    def _normal(self, place: Tensor, evidence: Sequence[Evidence], times: Sequence[float]) -> Normal:
        blocks, steps = sensitivities(self.residuals(evidence, times), place)
        return normal_equations(blocks, _scaled(evidence)(blocks), steps)

    def notes(self) -> list[str]:
        """Sentences on what speaks against the plan: unknowns that are confounded, a camera, a missing start."""
        names = [u.name for u in self.plan.unknowns]
        confounded = [
            f"wind.speed and {name} move the object in nearly the same way, so both may be far off: put one of them "
            "into `known`."
            for name in DRAG
            if name in names and "wind.speed" in names
        ]
        rough = [
            "The camera was found from a frame in which the object may move already, so all values may be off: give a "
            "film that begins at rest."
        ]
        return confounded + rough * ("camera" in self.plan.assumed) + self._notes_on_start()

    def _notes_on_start(self) -> list[str]:
        if FILM_START in (u.name for u in self.plan.unknowns) or not self.followed:
            return []
        still = min(still_until(self.simulation, v, own) for v, own in zip(self.videos, self.tracks, strict=True))
        if still >= LONG_STILL:
            return [
                f"Nothing moves in the first {still:.2g} s of the film, but the simulation starts at once: add "
                f"{FILM_START}: {{range: [0, {math.ceil(20 * still) / 10:g}]}} to `unknowns`, or cut the film."
            ]
        beside = max(beside_rest(self.simulation, video, self.plan.tracks) for video in self.videos)
        if beside > AWAY:
            return [
                f"The first frame is {beside:.2g} pixels away from the splat at rest, and moves: the film begins in "
                f"motion. Add {FILM_START}: {{range: [-1, 0]}} to `unknowns`, or give a film that begins at rest."
            ]
        return []

    def _check_apart(self, course: Course) -> None:
        place = torch.tensor(course.place, dtype=torch.float64)
        normal = self._normal(place, self.evidence(self.first_stage), self.fitted)
        found = directions(normal.matrix, self.plan.unknowns, place)
        course.directions = [{"strength": d.strength, "parts": d.parts, "sentence": d.sentence} for d in found]
        for direction in found:
            self.say(f"sensitivity {direction.strength:9.3g}: {direction.sentence}")
        check_apart(found, self.plan.unknowns, self.plan.limit)

    def _shown(self, place: Sequence[float]) -> str:
        return ", ".join(f"{name} {value:.5g}" for name, value in self.values(place).items())


def _scaled(evidence: Sequence[Evidence]) -> Callable[..., dict[str, float]]:
    """The function that gives the standard deviations of a variant's residuals; that of the prior is one."""
    floors = {part.kind: part.floor for part in evidence}

    def scales(blocks: Sequence[Block], member: int = 0) -> dict[str, float]:
        known = [block for block in blocks if block.kind != PRIOR]
        return scales_of(known, floors, member) | dict.fromkeys((b.kind for b in blocks if b.kind == PRIOR), 1.0)

    return scales


_NOTHING = Tracks(torch.zeros(0, dtype=torch.long), torch.zeros(0, 0, 2), torch.zeros(0, 0, dtype=torch.bool))


def run_fit(
    plan: Plan,
    output: str | os.PathLike[str],
    *,
    resume: bool = False,
    device: str = "auto",
    progress: bool = True,
    started: Callable[[], None] = lambda: None,
    in_use: Sequence[Path] = (),
) -> Result:
    """Do a fit and write its folder: values.csv, result.json, scene.yaml and pictures.

    Args:
        plan: From :func:`~gaussian_swaying.inverse.unknowns.read_plan`.
        output: The folder.
        resume: Continue the fit in it after its last iteration.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Print a line for each iteration.
        started: Called when the folder is locked.
        in_use: Other files that are needed, as the fit file: an earlier fit in a folder with one is not moved aside.

    Returns:
        The result.
    """
    folder, parser = Path(output), Simulation.parser()
    settings = parse_base(plan, parser)
    fit_ = _ready(plan, parser, settings, device, progress)
    simulation = fit_.simulation
    described = _described(plan, simulation)
    remedy = "choose another with --output"
    if resume and not (folder / PROGRESS).exists():
        raise ValueError(f"There is nothing to resume in {folder}: it has no {PROGRESS}; leave out --resume.")
    needed = [*in_use, *(Path(path) for path in (*plan.base, *plan.videos, settings.scene.ply) if path)]
    lock = hold_folder(folder, remedy) if resume else claim_folder(folder, OURS, remedy, needed)
    try:
        course = _read_course(folder, described) if resume else Course()
        started()

        def keep(course: Course) -> None:
            write_json(folder / PROGRESS, {"plan": described, "course": vars(course)})

        fit_.look(folder)
        result = fit_.run(course, keep, folder / PICTURES)
        told = consequences(plan.assumed, result.values, simulation, settings.solver.gravity)
        seen = wind_seen(result.values, fit_.videos, simulation)
        result = replace(result, assumed=told, seen=seen)
        write_results(folder, result, parser, settings, simulation)
        write_page(folder, result)
        return result
    finally:
        lock.release()
        if not (folder / PROGRESS).exists():  # it was refused before the first iteration: only pictures stay
            (folder / MARKER).unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()


def check_fit(plan: Plan, output: str | os.PathLike[str], *, device: str = "auto", progress: bool = True) -> list[Path]:
    """Read all that a fit needs, and write the pictures that it writes before it starts.

    Args:
        plan: From :func:`~gaussian_swaying.inverse.unknowns.read_plan`.
        output: The folder of the fit.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Print what the videos say against the plan.

    Returns:
        The pictures.
    """
    parser = Simulation.parser()
    fit_ = _ready(plan, parser, parse_base(plan, parser), device, progress)
    for note in fit_.notes():
        fit_.say(note)
    return fit_.look(Path(output))


def _ready(plan: Plan, parser: Any, settings: Any, device: str, progress: bool) -> Fit:
    if {"tracks", "matches"} & set(plan.stages):
        opencv()  # before anything that takes time
    settings.device = device
    own = settings.clone()
    own.camera = own.cameras = None  # the videos have their own
    simulation = Simulation.from_settings(parser, own)
    begin = time.monotonic()

    def say(line: str) -> None:
        if progress:
            print(f"[{time.monotonic() - begin:6.0f} s] {line}", file=sys.stderr, flush=True)

    videos = read_videos(list(plan.videos), plan.cameras, simulation.scene.size, simulation.scene.model.origin)
    videos, judged = prepared(simulation, videos, plan.hand_held, plan.also_moves, say)

    def on_grid(ratio: float) -> Simulation:
        given = own.clone()
        given.solver.dx = ratio * given.solver.dx
        return Simulation.from_settings(parser, given)

    return Fit(simulation, videos, plan, say, judged, on_grid)


def fit(
    base: str | os.PathLike[str] | Sequence[str],
    videos: str | os.PathLike[str] | Sequence[str],
    unknowns: Mapping[str, Any],
    output: str | os.PathLike[str],
    *,
    resume: bool = False,
    device: str = "auto",
    progress: bool = True,
    **settings: Any,
) -> Result:
    """Find the wind and the material of a simulation from videos, as ``gaussian-swaying fit`` does.

    Args:
        base: Configuration of ``sim``, or several: the splat, the solver and all that is known.
        videos: Folders with transforms.json, see :func:`~gaussian_swaying.inverse.videos.read_videos`.
        unknowns: For each unknown its range, such as ``{"wind.speed": [1, 10]}``, or ``{"range": [1, 10], "scale":
            "log", "start": 3}``.
        output: Folder for the results.
        resume: Continue the fit in it.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Print a line for each iteration.
        settings: Further fields of :class:`~gaussian_swaying.inverse.unknowns.Plan`, such as ``known``, ``stages`` and
            ``fit_share``.

    Returns:
        Values with standard errors, what the video cannot tell apart, and the error of the predicted frames.

    Raises:
        ValueError: As :func:`run_fit`.
    """

    def names(given: Any) -> list[str]:
        return [os.fspath(given)] if isinstance(given, str | os.PathLike) else [os.fspath(one) for one in given]

    sought = [read_unknown(name, entry) for name, entry in unknowns.items()]
    plan = Plan(names(base), names(videos), sought, **settings)
    return run_fit(plan, output, resume=resume, device=device, progress=progress)


def _described(plan: Plan, simulation: Simulation) -> dict[str, Any]:
    """Return the resume key: all settings that must be the same in a fit and the one that it continues."""
    own = {name: value for name, value in vars(plan).items() if name not in ("base", "unknowns", "iterations")}
    sought = {u.name: [u.low, u.high, u.scale, u.start] for u in plan.unknowns}
    told = {**own, "unknowns": sought, "scene": simulation.config}
    return json.loads(json.dumps(told))  # as it will be read


def _read_course(folder: Path, described: Mapping[str, Any]) -> Course:
    kept = read_json(folder / PROGRESS, "progress of the fit")
    if not isinstance(kept, dict) or set(kept) != {"plan", "course"} or set(kept["course"]) != set(vars(Course())):
        raise ValueError(
            f"{folder / PROGRESS} is of another version of the program: leave out --resume to begin again."
        )
    if kept["plan"] != described:
        changed = [name for name in described if kept["plan"].get(name) != described[name]]
        raise ValueError(
            f"The fit in {folder} has another `{changed[0] if changed else 'plan'}`: leave out --resume to begin again."
        )
    return Course(**kept["course"])
