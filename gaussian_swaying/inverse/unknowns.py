"""Unknowns of a fit, the plan that lists them, and how variants of a simulation get their values."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.parser import check_settings, import_forces, option
from gaussian_swaying.mpm.state import State
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import Live, Model, find, flow_of, names, number
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.step import Stepper, why_not_batched
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import with_added_mass

SCALE = "scene.metres_per_unit"


def at_scale(model: Model, metres_per_unit: float) -> Model:
    """A model that moves as if a scene unit had another length.

    Args:
        model: With the values that are meant in metres.
        metres_per_unit: The length of a scene unit [m].
    """
    wind, scene = model.wind, model.scene
    gravity, sheet = model.value("solver.gravity"), not scene.filled
    if not any(gravity):
        raise ValueError(f"Without gravity nothing tells `{SCALE}`: set `solver.gravity`, or measure a length.")
    if not isinstance(wind, WindField) or len(wind.modulations) or len(wind.effects) or model.air or model.forces:
        raise ValueError(
            f"`{SCALE}` can be sought only in a plain wind: remove `wind.modulations`, `wind.effects`, `air` and "
            "`forces`, or measure a length."
        )
    if model.material.volume != "patch" or model.points.count != scene.on_surface + scene.filled:
        raise ValueError(
            f"`{SCALE}` can be sought only with `material.volume: patch` and `scene.layers: 1`: set them, or measure a "
            "length."
        )
    if model.points.bending is not None and (isinstance(model.material.bending, str) or model.material.regions):
        raise ValueError(
            f"`{SCALE}` can be sought only with one `material.bending` in N m: give it as a number and without parts, "
            "or measure a length."
        )
    ratio = metres_per_unit / scene.frame.metres_per_unit
    changes = {"material.E": model.value("material.E") / ratio ** (3 if sheet else 2)}
    if sheet:
        changes["material.density"] = model.value("material.density") / ratio
    found = model.at(changes | {"solver.gravity": [part / ratio for part in gravity]})
    if model.points.bending is not None:
        found = found.replace(points=replace(found.points, bending=model.points.bending / ratio**5))
    if model.aero.added_mass:
        found = replace(found, aero=changed(model.aero, added_mass=model.aero.added_mass / ratio))
    return replace(found, wind=changed(wind, flows=wind.flows / ratio))


SCALES = ("log", "linear")
FILM_START = "film.start"
"""Time in the film at which the motion starts, at rest until then [s]; below 0, the wind has blown for so long when the
film begins."""

OF_FILM = {
    FILM_START: Live("s"),
    SCALE: Live("m", scale="log"),
    "wind.speed@": Live(low=0.2, high=5.0, scale="log"),
    "wind.azimuth@": Live("degrees", -90.0, 90.0),
}
"""Unknowns that are no numbers of the simulation. A time of the film follows the ``@`` of a wind that changes."""


def is_change(name: str) -> bool:
    """True for an unknown of a wind that changes."""
    return "@" in name


def known_unknown(name: str) -> Live | None:
    """The number of an unknown; None if there is none."""
    return OF_FILM.get(name[: name.find("@") + 1] or name) or find(name)


@dataclass(frozen=True)
class Unknown:
    """An unknown of a fit.

    Args:
        name: The option of ``sim``, such as ``material.E``; or ``wind.speed`` [m/s], ``wind.azimuth`` [degrees, from +x
            towards +y] and ``wind.elevation`` [degrees above the ground], which together are ``wind.flow``; or
            :data:`FILM_START` [s], or :data:`~gaussian_swaying.inverse.unknowns.SCALE` [m].
        low: Smallest value.
        high: Largest value.
        scale: ``log`` or ``linear``.
        start: First value; None for a coarse search over the range.

    Raises:
        ValueError: If the name is unknown or the range makes no sense; the message names the unknown.
    """

    name: str
    low: float
    high: float
    scale: str = "linear"
    start: float | None = None

    def __post_init__(self) -> None:
        where = f"unknowns.{self.name}"
        check_choice(f"{where}.scale", self.scale, SCALES)
        known = known_unknown(self.name)
        if known is None or known.kind != "number":
            possible = {n: known_unknown(n.replace("*", "0")) for n in (FILM_START, SCALE, *names())}
            sought = [n for n, one in possible.items() if one and one.kind == "number"]
            raise ValueError(f"`{self.name}` cannot be sought: use {', '.join(sought)}, or put it into `known`.")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"Expected `{where}.range` to be [low, high], but got [{self.low}, {self.high}].")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"Expected `{where}.range` above 0 with `scale: log`, but got {self.low}.")
        known.check(f"{where}.range", self.low)
        known.check(f"{where}.range", self.high)
        if self.start is not None and not self.low <= self.start <= self.high:
            raise ValueError(f"Expected `{where}.start` within its range, but got {self.start}.")

    @property
    def unit(self) -> str:
        known = known_unknown(self.name)
        return known.unit if known else ""

    def value(self, share: float) -> float:
        """The value at a share of the range, 0 at ``low`` and 1 at ``high``."""
        if self.scale == "log":
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> float:
        """Return the share of the range at which a value lies, 0 to 1; logarithmic if ``scale`` is."""
        if self.scale == "log":
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def slope(self, share: float) -> float:
        """Change of the value per share of the range."""
        return self.value(share) * math.log(self.high / self.low) if self.scale == "log" else self.high - self.low


def of_simulation(values: Mapping[str, float]) -> dict[str, float]:
    """The values that are numbers of the simulation."""
    return {n: value for n, value in values.items() if n not in OF_FILM and not is_change(n)}


def default_scale(name: str, low: float) -> str:
    """``log`` for positive sizes, ``linear`` for angles, Poisson's ratio and ranges that reach zero."""
    known = known_unknown(name)
    return "log" if low > 0 and known and known.scale == "log" else "linear"


def values_at(unknowns: Sequence[Unknown], place: Iterable[float]) -> dict[str, float]:
    """Values of unknowns at a place, given as shares of their ranges."""
    return {u.name: u.value(float(share)) for u, share in zip(unknowns, place, strict=True)}


def check_unknowns(simulation: Simulation, unknowns: Sequence[Unknown]) -> None:
    """Raise ValueError if a simulation has no such parameter as an unknown; the message names it and the remedy."""
    names = [unknown.name for unknown in unknowns]
    if not names:
        raise ValueError("Expected `unknowns` to have at least one entry, such as wind.speed: add it.")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"`{name}` is in `unknowns` twice: remove one.")
    values = {unknown.name: unknown.value(0.5) for unknown in unknowns}
    model = simulation.model.at(of_simulation(values))
    if SCALE in values:
        at_scale(model, values[SCALE])


KNOTS, EVERY = 3, 0.4
"""Fewest times after the first frame at which the wind is sought, and the longest time between two of them [s]."""

WALK = {"wind.speed@": 0.5, "wind.azimuth@": 20.0}
"""Standard deviations of the change in a second: of the logarithm of the speed, and of the azimuth [degrees]."""

PRIOR = "prior"
"""Kind of the residuals of the prior, which are in standard deviations."""


def changes_of(unknowns: Sequence[Unknown], until: float) -> list[Unknown]:
    """The unknowns of a wind that changes until a time of the film [s], beside some that are sought already.

    The azimuth changes only where it is sought.
    """
    sought = {kind: OF_FILM[kind] for kind in WALK if kind[:-1] in {u.name for u in unknowns}}
    count = max(KNOTS, math.ceil(until / EVERY))
    times = [until * (k + 1) / count for k in range(count)]
    return [Unknown(f"{kind}{time:.4g}", n.low, n.high, n.scale) for kind, n in sought.items() for time in times]


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


STEPS = 24
"""Values of each of intensity and time scale that are weighed."""

WEAKEST, STRONGEST, LONGEST = 0.005, 2.0, 5.0
"""Range of the intensity, and longest time scale per length of the film; all are as likely beforehand on a logarithmic
scale."""

APART = 5.0
"""Largest ratio of the ends of an interval within which a time scale counts as told."""

QUANTILES = (0.5, 0.16, 0.84)
_NORMAL = torch.distributions.Normal(0.0, 1.0).icdf((torch.arange(9, dtype=torch.float64) + 0.5) / 9)
Interval = tuple[float, float, float]
"""Median, and the ends of the middle 68 %."""


@dataclass(frozen=True)
class Gusts:
    """The spectrum of a wind.

    Attributes:
        mean: Mean speed [m/s].
        intensity: Standard deviation of the speed over its mean.
        time_scale: Time after which the speed is alike by 1/e [s].
        seconds: For which the wind was seen [s].
    """

    mean: Interval
    intensity: Interval
    time_scale: Interval
    seconds: float

    @property
    def told(self) -> bool:
        _, low, high = self.time_scale
        return high < min(APART * low, self.seconds)

    def sentence(self) -> str:
        mean, intensity, time = (
            "{:.2g} ({:.2g} to {:.2g})".format(*own) for own in (self.mean, self.intensity, self.time_scale)
        )
        scale = f"their time scale {time} s"
        if not self.told:
            scale = f"{self.seconds:.2g} s are too short to tell {scale}: film longer"
        return f"gusts: the mean speed is {mean} m/s, their intensity {intensity}, and {scale}"


def spectrum(times: Sequence[float], speeds: Tensor, covariance: Tensor) -> Gusts:
    """Mean, intensity and time scale of a speed that is known at some times.

    Args:
        times: The times [s], ascending, N of them.
        speeds: The speeds [m/s], float64, shape (N,).
        covariance: Covariance of their errors [m²/s²], shape (N, N).
    """
    moments = torch.tensor(times, dtype=torch.float64)
    length, closest = float(moments[-1] - moments[0]), float(moments.diff().amin())
    scale = torch.logspace(math.log10(0.5 * closest), math.log10(LONGEST * length), STEPS, dtype=torch.float64)
    share = torch.logspace(math.log10(WEAKEST), math.log10(STRONGEST), STEPS, dtype=torch.float64)
    tau, sigma = scale.repeat(STEPS), (share * float(speeds.mean())).repeat_interleave(STEPS)
    apart = (moments[:, None] - moments).abs()
    matrix = sigma.square()[:, None, None] * torch.exp(-apart / tau[:, None, None]) + covariance
    matrix = matrix + 1e-9 * float(speeds.square().mean()) * torch.eye(len(moments), dtype=torch.float64)
    root = torch.linalg.cholesky(matrix)
    white = torch.linalg.solve_triangular(root, torch.stack([speeds, torch.ones_like(speeds)], -1), upper=False)
    known = white[..., 1].square().sum(-1)  # one over the variance of the mean
    mean = (white[..., 0] * white[..., 1]).sum(-1) / known
    left = (white[..., 0] - mean[:, None] * white[..., 1]).square().sum(-1)
    weight = torch.softmax(-root.diagonal(dim1=-2, dim2=-1).log().sum(-1) - 0.5 * (known.log() + left), 0)
    means = mean[:, None] + _NORMAL / known.sqrt()[:, None]
    each = weight[:, None].expand_as(means) / len(_NORMAL)
    return Gusts(
        _quantiles(means.flatten(), each.flatten()),
        _quantiles((sigma[:, None] / means.abs()).flatten(), each.flatten()),
        _quantiles(tau, weight),
        length,
    )


def gusts_of(unknowns: Sequence[Unknown], place: Sequence[float], covariance: Tensor) -> Gusts | None:
    """The gusts of a fitted wind; None if its speed was not fitted at several times.

    Args:
        unknowns: The unknowns.
        place: Their values, as shares of the ranges.
        covariance: Covariance of the shares, shape (U, U).
    """
    names = [u.name for u in unknowns]
    knots = sorted((float(name.split("@")[1]), k) for k, name in enumerate(names) if name.startswith("wind.speed@"))
    if not knots or "wind.speed" not in names:
        return None
    first = names.index("wind.speed")
    base, slope = unknowns[first].value(place[first]), unknowns[first].slope(place[first])
    speeds, slopes = [base], torch.zeros(1 + len(knots), len(names), dtype=torch.float64)
    slopes[0, first] = slope
    for row, (_, k) in enumerate(knots, start=1):
        factor = unknowns[k].value(place[k])
        speeds.append(base * factor)
        slopes[row, first], slopes[row, k] = factor * slope, base * unknowns[k].slope(place[k])
    times = [0.0, *(time for time, _ in knots)]
    return spectrum(times, torch.tensor(speeds, dtype=torch.float64), slopes @ covariance.double() @ slopes.T)


def _quantiles(values: Tensor, weight: Tensor) -> Interval:
    order = values.argsort()
    total = weight[order].cumsum(0)
    found = [float(values[order[min(int((total < q).sum()), len(order) - 1)]]) for q in QUANTILES]
    return found[0], found[1], found[2]


if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

STAGES = ("tracks", "silhouettes", "matches", "pixels")
"""Stages of a fit, in this order: tracks from frame to frame; silhouettes; Gaussians matched from rendered frames to
frames of the video, three rounds; colours."""

ASSUMED = ("length", "mass", "camera")
"""Things in a base that nobody measured, perhaps."""


@dataclass(frozen=True)
class Plan:
    """The settings of a fit.

    Args:
        base: Configuration files of ``sim``: the splat, the solver, and first values.
        videos: Folders with transforms.json.
        unknowns: The unknowns.
        known: Options of ``sim`` that replace those of the base.
        stages: The stages, see :data:`STAGES`; silhouettes are left out if the video has none.
        fit_share: Share of the frames that is fitted; the rest is predicted.
        until: Fit the frames up to this time [s] instead of a share of them.
        search: Number of simulations of the coarse search; 0 starts at ``start`` or in the middle of the ranges.
        starts: Number of starts that the search gives to short solves, of which the best goes on.
        iterations: Most iterations of a stage at each horizon.
        tracks: Most tracks of a camera.
        wind_changes: Whether the wind may change during the film; it does if that predicts the last fifth of the fitted
            frames better.
        limit: Largest condition number of the sensitivities; above it the fit is refused.
        seed: Seed of the coarse search.
        cameras: Names of the cameras that are used; None for all.
        assumed: What nobody measured, of :data:`ASSUMED`; the result says what follows.
        hand_held: Whether the cameras move otherwise than the videos say; None if their background is to tell.
        also_moves: Names of parts of the splat that move in the videos, though the simulation does not move them.
    """

    base: Sequence[str]
    videos: Sequence[str]
    unknowns: Sequence[Unknown]
    known: Mapping[str, Any] = field(default_factory=dict)
    stages: Sequence[str] = ("tracks", "matches")
    fit_share: float = 0.5
    until: float | None = None
    search: int = 64
    starts: int = 3
    iterations: int = 8
    tracks: int = 400
    wind_changes: bool = False
    limit: float = 1e3
    seed: int = 0
    cameras: Sequence[str] | None = None
    assumed: Sequence[str] = ()
    hand_held: bool | None = None
    also_moves: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name in self.stages:
            if name not in STAGES:
                raise ValueError(f"Expected `stages` to be of {', '.join(STAGES)}, but got {name!r}.")
        for name in self.assumed:
            if name not in ASSUMED:
                raise ValueError(f"Expected `assumed` to be of {', '.join(ASSUMED)}, but got {name!r}.")
        if not self.stages:
            raise ValueError(f"Expected `stages` to have at least one of {', '.join(STAGES)}.")
        if not 0 < self.fit_share <= 1:
            raise ValueError(f"Expected `fit_share` above 0 and at most 1, but got {self.fit_share}.")
        for name, least in (("search", 0), ("starts", 1), ("iterations", 1), ("tracks", 4), ("seed", 0)):
            check_whole(name, getattr(self, name), least)
        if self.wind_changes and "wind.speed" not in {u.name for u in self.unknowns}:
            raise ValueError("Expected `wind.speed` in `unknowns` with `wind_changes`: add it.")
        if not self.limit > 1:
            raise ValueError(f"Expected `limit` above 1, but got {self.limit}.")


def read_plan(path: str | os.PathLike[str], find: Callable[[str], str] = str) -> Plan:
    """Read a ``fit.yaml``; docs/fit.md describes it.

    Args:
        path: The file. Names in ``base`` and ``videos`` are relative to its folder if they exist there, else to the
            working directory.
        find: Gives the file of a name in ``base``.
    """
    file = Path(path)
    names = [entry.name for entry in fields(Plan)]
    given = read_fields(file, "the fit file", names)
    sought = given.get("unknowns")
    if not isinstance(sought, dict) or not sought:
        raise ValueError(
            f"Expected `unknowns` in {file} to have entries such as wind.speed: {{range: [1, 10]}}, but got "
            f"{sought!r:.60}."
        )
    known = given.get("known") or {}
    if not isinstance(known, dict) or not all(isinstance(name, str) for name in known):
        raise ValueError(
            f"Expected `known` in {file} to have options of `sim` as names (material.E), but got {known!r:.60}."
        )
    settings = {name: given[name] for name in names[4:] if given.get(name) is not None}
    for name in ("stages", "cameras", "assumed", "also_moves"):
        if name in settings:
            settings[name] = _names(file, name, settings[name])
    for name in ("fit_share", "until", "limit"):
        if name in settings and (isinstance(settings[name], bool) or not isinstance(settings[name], int | float)):
            raise ValueError(f"Expected `{name}` in {file} to be a number, but got {settings[name]!r}.")
    for name in ("hand_held", "wind_changes"):
        if not isinstance(settings.get(name, True), bool):
            raise ValueError(f"Expected `{name}` in {file} to be true or false, but got {settings[name]!r}.")
    base = [_beside(file, name) or find(name) for name in _names(file, "base", given.get("base"))]
    import_forces(base)
    return Plan(
        base,
        [_beside(file, name) or name for name in _names(file, "videos", given.get("videos"))],
        [read_unknown(name, entry) for name, entry in sought.items()],
        known,
        **settings,
    )


def read_unknown(name: str, given: Any) -> Unknown:
    """An unknown from its entry: ``{range: [low, high], scale: log, start: 3}``; scale and start may be left out.

    Example:
        >>> read_unknown("material.E", {"range": [1e3, 1e5]}).scale
        'log'
    """
    where = f"unknowns.{name}"
    ends = given.get("range") if isinstance(given, Mapping) else given
    if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(_is_number(end) for end in ends):
        raise ValueError(f"Expected `{where}` to be {{range: [low, high]}}, but got {given!r:.60}.")
    further = dict(given) if isinstance(given, Mapping) else {}
    for key in further:
        if key not in ("range", "scale", "start"):
            raise ValueError(f"`{where}` has an unknown entry `{key}`: use range, scale and start.")
    start = further.get("start")
    if start is not None and not _is_number(start):
        raise ValueError(f"Expected `{where}.start` to be a number, but got {start!r}.")
    low, high = map(float, ends)
    scale = further.get("scale") or default_scale(str(name), low)
    return Unknown(str(name), low, high, str(scale), None if start is None else float(start))


def parse_base(plan: Plan, parser: ArgumentParser) -> Namespace:
    """The settings of the base, with the known options."""
    files = [word for name in plan.base for word in ("--config", name)]
    settings = parser.parse_args([*files, *(option(name, value) for name, value in plan.known.items())])
    check_settings(Simulation, settings)
    return settings


def _names(file: Path, name: str, given: Any) -> list[str]:
    several = [given] if isinstance(given, str) else given
    if not isinstance(several, list) or not several or not all(isinstance(item, str) for item in several):
        raise ValueError(f"Expected `{name}` in {file} to be a name or a list of names, but got {given!r:.60}.")
    return several


def _beside(file: Path, name: str) -> str | None:
    """A file or folder beside another file; None if there is none."""
    return str(file.parent / name) if (file.parent / name).exists() else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


Values = Mapping[str, float]


@dataclass
class _Group:
    """Variants that differ only in parameters that may differ within a batch."""

    members: list[int]
    stepper: Stepper
    state: State
    start: float
    diverged: bool = False

    def moves(self, begin: float, end: float) -> float:
        """The time for which they move between two times of the film [s]."""
        return max(end - self.start, 0.0) - max(begin - self.start, 0.0)


def check_variants(simulation: Simulation) -> None:
    """Raise ValueError if a simulation has parts that cannot be a batch: timed edits, contact, shelter, copies."""
    why = why_not_batched(simulation.model)
    if simulation.editor.edits:
        why = "`edits` change its material; put it into `material`"
    if simulation.stepper.copies is not None:
        why = "it has `copies`, and a video shows one object; remove them"
    if why is not None:
        raise ValueError(f"The base cannot be fitted through: {why}.")


@torch.no_grad()
def states_of(
    simulation: Simulation, values: Sequence[Values], times: Sequence[float], alike: bool = True
) -> Iterator[list[State]]:
    """The states of all variants at each time, in the order of ``values``.

    Variants that differ only in parameters that may differ within a batch are one batch; others are further batches.

    Args:
        simulation: The base. Its motion starts from rest at time zero.
        values: For each variant the values that replace those of the base; with
            :data:`~.unknowns.FILM_START`, it is at rest until then, or has moved since then if that is below zero.
        times: Times [s], ascending, from 0 on.
        alike: Take the same substeps for all, those of the stiffest, so that differences come from the values alone. If
            not, variants that need more substeps are batches of their own, and a variant may end in NaN.
    """
    models = [model_of(simulation.model, own) for own in values]
    groups = _groups(simulation, values, models, alike)
    before = math.ceil(max(0.0, -min(group.start for group in groups)) / simulation.frame_dt)
    for k in range(-before, 0):  # the run-up, frame by frame
        _advance(groups, k * simulation.frame_dt, (k + 1) * simulation.frame_dt, alike)
    now = 0.0
    for time in times:
        if time > now:
            _advance(groups, now, time, alike)
            now = time
        found = [(member, group.state.scene(k)) for group in groups for k, member in enumerate(group.members)]
        yield [state for _, state in sorted(found, key=lambda pair: pair[0])]


def model_of(model: Model, values: Values) -> Model:
    """The model of a variant, in a wind that changes and at another scale if its values say so."""
    found = model.at(of_simulation(values))
    if isinstance(found.wind, WindField):
        found = replace(found, wind=changing(found.wind, values))
    return at_scale(found, values[SCALE]) if SCALE in values else found


def _groups(simulation: Simulation, values: Sequence[Values], models: Sequence[Model], alike: bool) -> list[_Group]:
    shared: dict[tuple[object, ...], list[int]] = {}
    for index, (own, model) in enumerate(zip(values, models, strict=True)):
        apart = [
            (name, value)
            for name, value in sorted(own.items())
            if not (is_change(name) or (name not in OF_FILM and number(name).batched))
        ]
        shared.setdefault((*apart, 0 if alike else _stiffness_class(model)), []).append(index)
    found = []
    for members in shared.values():
        part = [models[k] for k in members]
        solver = simulation.solver.like(part[0].solver)
        assign(solver, substep=None)  # a stiffer variant may need a shorter one
        stepper = Stepper(solver, part, lenient=not alike)
        found.append(_Group(members, stepper, stepper.bind(), values[members[0]].get(FILM_START, 0.0)))
    return found


def _advance(groups: Sequence[_Group], begin: float, end: float, alike: bool) -> None:
    """Advance all groups that move from one time of the film to another [s]."""
    groups = [group for group in groups if group.moves(begin, end) > 0]
    for group in groups:
        group.stepper.model = group.stepper.model.replace(frame_dt=group.moves(begin, end))
    if not alike:
        for group in groups:
            try:
                if not group.diverged:
                    group.state, _ = group.stepper.advance(group.state)
            except SimulationDiverged:
                lost = {name: torch.nan * getattr(group.state, name) for name in ("position", "velocity", "F_total")}
                group.state, group.diverged = group.state.replace(**lost), True
        return
    if not groups:
        return
    steps = max(group.stepper.substeps(group.state) for group in groups)
    while True:
        launched = [group.stepper.launch(group.state, steps) for group in groups]
        ends = [one.finish()[0] for one in launched]
        most = max(one.steps for one in launched)
        if all(one.steps == most for one in launched):
            break
        steps = most
    for group, state in zip(groups, ends, strict=True):
        group.state = state


def _stiffness_class(model: Model) -> int:
    """A number that is equal for materials whose fastest waves differ by less than a fifth or so."""
    points = with_added_mass(model.points, model.scene.patches, model.aero)
    squared = (points.youngs_modulus * points.volume / points.mass).amax()
    return round(2 * math.log2(float(squared)))


SHAKEN = 0.12
"""Change of what is sought of the material, as a share of the range."""

FLAT = 0.8
"""Part of the area that faces one way, level with the ground, from which the wind may be mirrored: a mean square."""

SCANNED = 16
"""Values of Young's modulus over its range that are tried in a wind that bends the object as far."""

TURN = 5.0
"""Least angle between the wind and its mirror image [degrees]."""

MIRROR = 20.0
"""Largest angle between the end of another start and the mirror image of the wind that is still one [degrees]."""


def rivals_of(model: Model, unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    """Places from which to start again at the end of a fit, as shares of the ranges, within them.

    Args:
        model: The scene.
        unknowns: What is sought.
        place: Where the fit ended.

    Returns:
        For each number of the material a smaller and a larger one, then the mirrored wind if there is one.
    """
    found = []
    for k, unknown in enumerate(unknowns):
        for side in (-SHAKEN, SHAKEN) if unknown.name.startswith("material.") else ():
            found.append([*place[:k], min(max(place[k] + side, 0.0), 1.0), *place[k + 1 :]])
    names = [unknown.name for unknown in unknowns]
    if "wind.azimuth" in names:
        k = names.index("wind.azimuth")
        azimuth = mirrored(model, values_at(unknowns, place))
        share = unknowns[k].share(_within(azimuth, unknowns[k])) if azimuth is not None else -1.0
        if 0 <= share <= 1:
            found.append([*place[:k], share, *place[k + 1 :]])
    return found


def apart_by(unknowns: Sequence[Unknown], one: Sequence[float], other: Sequence[float]) -> float:
    """Return the largest distance of two places, as a share of a range; azimuths 360 degrees apart are the same."""
    most = 0.0
    for unknown, a, b in zip(unknowns, one, other, strict=True):
        away = abs(a - b)
        if unknown.name == "wind.azimuth":
            wide = unknown.high - unknown.low
            away = abs(_turned(wide * (a - b))) / wide
        most = max(most, away)
    return most


def bent_alike(unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    r"""Places with another Young's modulus, and the wind that bends the object as far.

    The bend grows as :math:`w^2 / E`. A place that is several times too stiff and too windy bends as far, but swings
    too fast. The cost has a minimum there, and others on the way to the true one.

    Args:
        unknowns: What is sought.
        place: Where the wind bends it as far as it should, as shares of the ranges.

    Returns:
        :data:`SCANNED` places over the range of ``material.E``; none if that or ``wind.speed`` is not sought.
    """
    names = [unknown.name for unknown in unknowns]
    if not {"material.E", "wind.speed"} <= set(names):
        return []
    k, j = names.index("material.E"), names.index("wind.speed")
    stiffness, wind, found = unknowns[k], unknowns[j], []
    for step in range(SCANNED):
        other = list(place)
        other[k] = (step + 0.5) / SCANNED
        ratio = stiffness.value(other[k]) / stiffness.value(place[k])
        speed = wind.value(place[j]) * math.sqrt(ratio)
        other[j] = wind.share(min(max(speed, wind.low), wind.high))
        found.append(other)
    return found


def mirrored(model: Model, values: Mapping[str, float]) -> float | None:
    r"""Return the azimuth of the wind mirrored at the normal of a sheet at rest [degrees]; None if nothing is flat.

    The pressure on a sheet with normal n depends on :math:`w \cdot n` and the speed, which the mirror image
    :math:`2 (w \cdot n) n - w` leaves. Level with the ground, that is the azimuth :math:`2 \beta - \alpha`, with the
    azimuth :math:`\beta` of n.

    Args:
        model: The scene.
        values: Values of the unknowns, with ``wind.azimuth``.
    """
    patches = model.scene.patches
    normal = patches.normal.double()[:, :2]
    weight = patches.area.double() / patches.area.double().sum()
    shares, axes = torch.linalg.eigh((weight[:, None, None] * normal[:, :, None] * normal[:, None, :]).sum(0).cpu())
    if not float(shares[-1]) >= FLAT:
        return None
    facing = math.degrees(math.atan2(float(axes[1, -1]), float(axes[0, -1])))
    x, y, _ = flow_of((1.0, 0.0, 0.0), values)
    azimuth = math.degrees(math.atan2(y, x))
    other = 2 * facing - azimuth
    return other if abs(_turned(other - azimuth)) >= TURN else None


def is_mirrored(model: Model, unknowns: Sequence[Unknown], place: Sequence[float], end: Sequence[float]) -> bool:
    """True if the wind at the end of another start is about the mirror image of that at a place, both as shares."""
    values, there = values_at(unknowns, place), values_at(unknowns, end)
    other = mirrored(model, values) if "wind.azimuth" in values else None
    return other is not None and abs(_turned(there["wind.azimuth"] - other)) < MIRROR


def _turned(angle: float) -> float:
    """An angle between -180 and 180 degrees."""
    return (angle + 180) % 360 - 180


def _within(azimuth: float, unknown: Unknown) -> float:
    middle = 0.5 * (unknown.low + unknown.high)
    return middle + _turned(azimuth - middle)


LARGE = 0.25
"""Share of the largest part of a direction below which an unknown is not named."""


@dataclass(frozen=True)
class Direction:
    """A combination of the unknowns.

    Attributes:
        strength: Singular value: change of the residuals, in standard deviations, when the unknowns move along the
            direction by the whole of their ranges.
        parts: Share of each unknown, of length one.
        sentence: The direction in words.
    """

    strength: float
    parts: tuple[float, ...]
    sentence: str


def directions(matrix: Tensor, unknowns: Sequence[Unknown], place: Tensor) -> list[Direction]:
    """The principal directions of the sensitivities, the best known first.

    Args:
        matrix: J^T W J in shares of the ranges, shape (U, U).
        unknowns: The unknowns.
        place: Values at which the sensitivities were computed, as shares of the ranges, shape (U,).
    """
    values, vectors = torch.linalg.eigh(matrix)
    found = []
    for value, vector in zip(values.flip(0), vectors.flip(1).mT, strict=True):
        parts = tuple(vector.tolist())
        found.append(Direction(math.sqrt(max(float(value), 0.0)), parts, _sentence(parts, unknowns, place)))
    return found


def condition(found: Sequence[Direction]) -> float:
    """Largest singular value over the smallest."""
    return found[0].strength / max(found[-1].strength, 1e-300)


def check_apart(found: Sequence[Direction], unknowns: Sequence[Unknown], limit: float) -> None:
    """Raise ValueError if the unknowns cannot be told apart.

    Args:
        found: From :func:`directions`.
        unknowns: The unknowns.
        limit: Largest condition number.
    """
    if len(unknowns) < 2 or condition(found) <= limit:
        return
    worst = found[-1]
    largest = max(map(abs, worst.parts))
    names = [f"`{u.name}`" for u, part in zip(unknowns, worst.parts, strict=True) if abs(part) > LARGE * largest]
    if len(names) == 1:
        raise ValueError(
            f"The video does not tell {names[0]} (condition {condition(found):.3g}, limit {limit:g}): put it into "
            "`known`, or raise `limit`."
        )
    raise ValueError(
        f"The video cannot tell {', '.join(names[:-1])} and {names[-1]} apart: {worst.sentence} changes nothing that "
        f"is seen (condition {condition(found):.3g}, limit {limit:g}). Put one of them into `known`, or raise `limit`."
    )


def _sentence(parts: Sequence[float], unknowns: Sequence[Unknown], place: Tensor) -> str:
    """Describe a step along a direction in words, scaled so that its largest change is about 10 %."""
    lead = max(range(len(parts)), key=lambda k: abs(parts[k]))
    unknown = unknowns[lead]
    slope, value = unknown.slope(float(place[lead])), unknown.value(float(place[lead]))
    # how far along the direction until the largest part has changed by a tenth of its value, or of its range
    far = 0.1 * abs(value) / abs(slope) if value and unknown.scale == "log" else 0.1
    return changes([far / parts[lead] * part for part in parts], unknowns, place)


def changes(step: Sequence[float], unknowns: Sequence[Unknown], place: Tensor) -> str:
    """A step, in shares of the ranges, in words: ``raising wind.speed by 10% and lowering material.E by 20%``."""
    largest, words = max(map(abs, step)), []
    for u, part, share in zip(unknowns, step, place.tolist(), strict=True):
        if abs(part) <= LARGE * largest:
            continue
        change = part * u.slope(share)
        verb = "raising" if change > 0 else "lowering"
        own = abs(u.value(share))
        amount = f"{abs(change) / own:.0%}" if u.scale == "log" and own else f"{abs(change):.2g} {u.unit}".strip()
        words.append(f"{verb} {u.name} by {amount}")
    return " and ".join(words) if len(words) < 3 else ", ".join(words[:-1]) + " and " + words[-1]
