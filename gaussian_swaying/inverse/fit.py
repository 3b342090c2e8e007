"""A whole fit: coarse search, then least squares stage by stage; it can be continued after every step."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_swaying._files import write_json
from gaussian_swaying._inputs import read_json
from gaussian_swaying.config.parser import check_settings, option
from gaussian_swaying.inverse.least_squares import DivergedError, Residuals, Solved, cost_of, covariance, normal, solve
from gaussian_swaying.inverse.plan import FILM_START, Plan, apart_by, check_apart, make_plan, mirror_of, turn, values_at
from gaussian_swaying.inverse.registration import first_look, prepared
from gaussian_swaying.inverse.report import PICTURES, Fit, consequences, write_before, write_films, write_results
from gaussian_swaying.inverse.tracks import Tracks, match, opencv, track
from gaussian_swaying.inverse.variants import check_variants, compare, explained, split, states_of, trusted, turning
from gaussian_swaying.inverse.videos import Footage, frame_times, read_videos
from gaussian_swaying.mpm.state import State
from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation

PROGRESS, FORMAT = "fit.json", 2
OURS = (PROGRESS, "page.html", "values.csv", "result.json", "scene.yaml", PICTURES)
UNSETTLED = "The values have not settled: `iterations` ran out: raise it and continue with --resume."
STEPS = (0.5, 0.5, 0.75, 1.0, 1.0)  # shares in which Gaussians are matched from rendered frames
STARTS, SEARCHED, COARSE = 3, 0.5, 0.02  # starts, share of the frames, as chaos grows, and residuals per picture
LONG_STILL = 0.05  # longest time that a film may be still, if the start of its motion is no unknown [s]
SPREAD = ("wind.speed", "wind.azimuth", "material.E")  # searched although a start was given
APART, SAME = 0.15, 0.03  # least distance of starts, and largest of ends that are the same, as shares of a range
BRIEF, REFINED, TRIES = 4, 5, 2  # most iterations of a short solve, and on another grid; steps that are tried for each
RIVAL, MIRRORED = 1.05, 1.25  # cost per the best below which another end is a rival; that of the mirrored wind
MIRROR = 20.0  # largest angle between the wind of an end and the mirrored wind [degrees]
GRIDS = (0.8, 1.25)  # cells of other grids that tell the error of the grid, per its own
BEGUN, BEGINS, MOST_STARTS = 12, 10, 60  # simulations, starts of each at the first frame, and in the search
LONG, COARSER = 300.0, 1.3  # time of a fit above which a coarser grid is proposed [s], and its cells


class Say:
    """Prints lines and a bar of the work that is being done, with the time left."""

    def __init__(self, shown: bool = True) -> None:
        self._shown, self._begin, self.tick = shown, time.monotonic(), lambda count: None

    def __call__(self, line: str) -> None:
        if self._shown:
            tqdm.write(f"[{time.monotonic() - self._begin:6.0f} s] {line}", file=sys.stderr)

    @contextmanager
    def work(self, what: str, frames: int) -> Iterator[None]:
        """Inside the block, ``tick`` counts frames of simulations, of so many at most."""
        with tqdm(total=frames, desc=what, unit="frame", file=sys.stderr, disable=not self._shown, leave=False) as bar:
            self.tick = bar.update
            yield
        self.tick = lambda count: None


@dataclass(eq=False)
class Problem:
    """The unknowns of a simulation, and the videos from which they are found.

    ``grids`` are the simulation on other grids, ``told`` what the background says, and ``doubts`` what speaks against
    the videos.
    """

    simulation: Simulation
    videos: Sequence[Footage]
    plan: Plan
    say: Say = field(default_factory=lambda: Say(False))
    grids: Sequence[Simulation] = ()
    told: Sequence[str] = ()
    doubts: Sequence[str] = ()

    def __post_init__(self) -> None:
        plan, videos = self.plan, self.videos
        self.times = frame_times(videos)
        fitted = max(3, round(0.5 * len(self.times)))
        if plan.until is not None:
            fitted = sum(time <= plan.until + 1e-6 for time in self.times)
            if fitted < 3:
                raise ValueError(f"Fewer than three frames lie before `until` = {plan.until:g} s: raise it.")
        self.fitted = self.times[:fitted]
        check_variants(self.simulation, plan.unknowns)
        self.sought = {unknown.name: k for k, unknown in enumerate(plan.unknowns)}
        self.middle = [0.5 if u.start is None else u.share(u.start) for u in plan.unknowns]
        self.begins = plan.unknowns[self.sought[FILM_START]] if FILM_START in self.sought else None
        self.moving = self.begins is not None and self.begins.low < 0
        self.first: list[float] = []
        self._tracks: list[Tracks] | None = None
        for video in videos:  # all cameras have to see the start of the motion, or a state before it
            begin, step = video.times[0], (video.times[-1] - video.times[0]) / max(len(video.times) - 1, 1)
            if begin > max([1.5 * step, *([self.begins.low] if self.begins else [])]):
                raise ValueError(
                    f"The frames of camera {video.name} begin at {begin:.3g} s, but points are followed from 0 s on: "
                    "cut all videos to the same beginning, or leave that camera out of `cameras`."
                )

    def _until(self, share: float) -> list[float]:
        return self.fitted[: max(3, round(share * len(self.fitted)))]

    @property
    def tracks(self) -> list[Tracks]:
        """The points that are followed, from the splat at rest or from where ``first`` has them."""
        if self._tracks is None:
            shown = self.simulation.painter.deformed(self._states(self.first, [0.0])[0]) if self.first else None
            self._tracks = [track(self.simulation, video, self.plan.tracks, shown) for video in self.videos]
            if sum(len(own.index) for own in self._tracks) < 4:
                raise ValueError("Fewer than four points can be followed: give sharper videos of something textured.")
        return self._tracks

    def begin_at(self, first: Sequence[float]) -> None:
        """Take values, as shares, whose simulation the first frame looks like; empty for the splat at rest."""
        if list(first) != self.first:
            self.first, self._tracks = list(first), None

    def begin_from(self, places: Tensor) -> list[float]:
        """Return the place of some (B, U), with its start, from whose pictures most Gaussians are found at first."""
        known = self.begins
        assert known is not None
        before = torch.linspace(max(0.0, -known.high), -known.low, BEGINS, dtype=torch.float64).tolist()
        brief = [replace(video, images=video.images[:1]) for video in self.videos]
        values = [self.values(place) | {FILM_START: 0.0} for place in places]
        found: list[tuple[int, list[float]]] = []
        with self.say.work("where the film begins", len(before) * len(places)):
            for ago, states in zip(before, states_of(self.simulation, values, before, alike=False), strict=True):
                self.say.tick(len(places))
                for place, state in zip(places.tolist(), states[: None if ago else 1], strict=False):  # rest is alike
                    shown = self.simulation.painter.deformed(state)
                    tracks = [track(self.simulation, video, self.plan.tracks, shown) for video in brief]
                    place[self.sought[FILM_START]] = known.share(-ago)
                    found.append((sum(int(own.seen[0].sum()) for own in tracks), place))
        return max(found, key=itemgetter(0))[1]

    def evidence(self, matched: Sequence[float] | None = None) -> list[Tracks]:
        """The fitted tracks of each video: points that are followed, or that are matched at a place."""
        if matched is None:
            return [split(own)[0] for own in self.tracks]
        states, found = list(zip(self.fitted, self._states(matched, self.fitted), strict=True)), []
        for video in self.videos:
            shown = [state for moment, state in states if video.frame_at(moment) is not None]
            found.append(split(match(self.simulation, video, shown, self.plan.tracks, self.moving))[0])
        return found

    def trusted(self, evidence: Sequence[Tracks], place: Sequence[float]) -> list[Tracks]:
        return trusted(evidence, self.grids, self.values(place), self.fitted)

    def _states(self, place: Sequence[float], times: Sequence[float]) -> list[State]:
        return [own[0] for own in states_of(self.simulation, [self.values(place)], times, alike=False)]

    def values(self, place: Tensor | Sequence[float]) -> dict[str, float]:
        return values_at(self.plan.unknowns, place)

    def residuals(self, evidence: Sequence[Tracks], times: Sequence[float]) -> Residuals:
        """The residuals of some evidence up to a horizon, as a function of places (B, U)."""
        return lambda places: compare(evidence, list(map(self.values, places)), times, self.moving, self.say.tick)[0]

    def solved(
        self, place: Sequence[float], evidence: Sequence[Tracks], times: Sequence[float], most: int, closely: bool
    ) -> Solved:
        at = torch.tensor(place, dtype=torch.float64)
        with self.say.work(f"to {times[-1]:.3g} s", (1 + TRIES * most) * len(times) * (1 + 2 * len(at))):
            return solve(self.residuals(evidence, times), at, TRIES * most, closely)

    def search(self) -> list[list[float]]:
        """Return the best starts of a coarse search: Sobol's sequence over the ranges.

        Coefficients and damping stay in the middle of their ranges, and what has a ``start`` stays there, but for
        :data:`SPREAD`. Values that were given are the first start.
        """
        unknowns, plan = self.plan.unknowns, self.plan
        begin = torch.tensor([self.middle], dtype=torch.float64)
        given = any(u.start is not None for u in unknowns)
        sought = [u for u in unknowns if u.start is None or u.name in SPREAD]
        free = [self.sought[u.name] for u in sought if not u.name.startswith(("aero.", "solver."))]
        if not plan.search or not free:
            if self.moving:
                self.begin_at(begin[0].tolist())
            return begin.tolist()
        places = begin.repeat(plan.search, 1)
        places[:, free] = torch.quasirandom.SobolEngine(len(free), scramble=True, seed=0).draw(len(places)).double()
        if self.moving:
            self.begin_at(self.begin_from(places[:BEGUN]))
        if given:
            places = torch.cat([begin, places])
        evidence, times, known = self.evidence(), self._until(SEARCHED), self.begins
        starts = [0.0 if known is None or known.start is None else known.start]
        if known is not None and known.start is None:  # in a steady wind one simulation shows what any start would
            step = max(times[1] - times[0], (known.high - known.low) / MOST_STARTS)
            numbers = range(math.ceil(known.low / step), math.floor(known.high / step) + 1)
            starts = [step * k for k in numbers] or [known.low]
        values, scale = [self.values(place) for place in places], COARSE * max(video.size[0] for video in self.videos)
        with self.say.work("search", len(places) * len(times)):
            found = compare(evidence, values, times, self.moving, self.say.tick, starts)
        costs, best = torch.stack([cost_of(block, scale) for block in found]).min(0)
        if known is not None:
            places[:, self.sought[FILM_START]] = torch.tensor([known.share(start) for start in starts]).double()[best]
        if not bool(torch.isfinite(costs).any()):
            raise DivergedError("Every simulation of the coarse search diverged: narrow the ranges of `unknowns`.")
        ends = places[:1].tolist() if given else []
        for place in places[costs.argsort()].tolist():
            if len(ends) < STARTS and all(apart_by(unknowns, place, other) > APART for other in ends):
                ends.append(place)
        return ends

    def best_of(self, places: Sequence[Sequence[float]]) -> list[list[float]]:
        """Solve from several starts for a short while, and return the best end, and another with nearly its cost."""
        times = self._until(SEARCHED)
        ended = self._brief(places, self.evidence(), times)
        for cost, place in ended:
            self.say(f"start to {times[-1]:.3g} s: cost {cost:.3g}, {self._shown(place)}")
        return [place for cost, place in ended[:2] if cost <= 2 * ended[0][0]]

    def _brief(
        self, places: Sequence[Sequence[float]], evidence: Sequence[Tracks] | None, times: Sequence[float]
    ) -> list[tuple[float, list[float]]]:
        """Short solves from some places: costs and ends, apart from each other and the best first.

        Without evidence each compares the points of its own first frame, as those of one place speak for that place.
        """
        found = []
        for place in places:
            with suppress(DivergedError, *([] if evidence else [ValueError])):  # it may have no such points
                own, shown = copy(self), evidence
                if shown is None:
                    own.begin_at(place)
                    shown = own.trusted(own.evidence(), place)
                found.append(own.solved(place, shown, times, BRIEF, False))
        if not found:
            raise DivergedError("Every simulation of a start diverged: narrow the ranges of `unknowns`.")
        scale = min(own.scale for own in found)
        ends: list[tuple[float, list[float]]] = []
        for cost, end in sorted((float(cost_of(own.block, scale)[0]), own.place.tolist()) for own in found):
            if all(apart_by(self.plan.unknowns, end, other) > SAME for _, other in ends):
                ends.append((cost, end))
        return ends

    def others(self, place: Sequence[float], rivals: Sequence[Sequence[float]]) -> list[dict[str, float]]:
        """Values of other ends, of other starts and the mirrored wind, that cost about as little over all frames."""
        unknowns, other = self.plan.unknowns, mirror_of(self.simulation.model, self.plan.unknowns, place)
        tried, near = [list(place), *map(list, rivals), *other], []
        if len(tried) == 1:
            return []
        try:
            ended = self._brief(tried, None if self.moving else self.trusted(self.evidence(), place), self.fitted)
        except DivergedError:
            return []
        for cost, end in ended:
            self.say(f"rival: cost {cost:.5g}, {self._shown(end)}")
            values = self.values(end)
            aside = [turn(values["wind.azimuth"] - self.values(mirror)["wind.azimuth"]) for mirror in other]
            most = MIRRORED if any(abs(angle) < MIRROR for angle in aside) else RIVAL
            if cost < most * ended[0][0] and apart_by(unknowns, end, place) > 2 * SAME:
                near.append(values)
        return near

    def expected(self) -> str:
        """What the fit will take, in words, from the time of one simulation; and a coarser grid if that is long."""
        batch, begin = 2 + 2 * len(self.sought), 0.0
        for times in (self.fitted[:2], self.fitted):  # the first time compiles
            begin = time.monotonic()
            for _ in states_of(self.simulation, [self.values(self.middle)] * batch, times):
                pass
        count = SEARCHED * self.plan.search + 3 * batch * sum(STEPS)
        count += BRIEF * batch * (STARTS + 3) + REFINED * batch * len(GRIDS)
        seconds = count * (time.monotonic() - begin) / batch
        told = f"about {count:.0f} simulations of {self.fitted[-1]:.3g} s: some {duration(seconds)}"
        if self.simulation.device.type == "cpu" and seconds > LONG:
            coarser = COARSER * float(self.simulation.solver.dx)
            told += f"; less than half of it on a coarser grid (`known: {{solver.dx: {coarser:.2g}}}`)"
        return told

    def run(self, course: dict[str, Any], keep: Callable[[], None], folder: Path | None = None) -> Fit:
        """Do the steps that ``course`` does not have, put them into it, call ``keep`` after each; return the result.

        Of the places in it, shares of the ranges, ``starts`` are those of the search, ``first`` looks like the first
        frame if that is not at rest, and ``rivals`` are ends of other starts. ``places`` has the end of the best start
        and those of the solves in ``history``, one for each of :data:`STEPS` and more for the last.
        """
        clock = time.monotonic() - course.setdefault("seconds", 0.0)

        def kept(**found: Any) -> None:
            course.update(found, seconds=time.monotonic() - clock)
            keep()

        self.begin_at(course.get("first", []))
        if "places" not in course:
            kept()
            for note in (*self.notes(), self.expected()):
                self.say(note)
            if "starts" not in course:
                kept(starts=self.search(), first=self.first)
            place, *rivals = self.best_of(course["starts"])
            self.say(f"search: {self._shown(place)}")
            at = torch.tensor(place, dtype=torch.float64)
            matrix, _ = normal(self.residuals(self.evidence(), self.fitted), at)
            check_apart(matrix, self.plan.unknowns, at, self.plan.limit)
            kept(places=[place], rivals=rivals, history=[])
        places, history, last = course["places"], course["history"], len(STEPS) - 1
        while True:
            number = min(len(history), last)
            times, matched = self._until(STEPS[number]), places[number]
            evidence = self.trusted(self.evidence(matched), matched)
            left = self.plan.iterations - sum(row["steps"] for row in history[last:]) // TRIES
            if left <= 0 or (history[last:] and history[-1]["ended"]):  # it is continued after its end
                break
            found = self.solved(places[-1], evidence, times, left, number == last)
            places.append(found.place.tolist())
            cost = float(cost_of(found.block, found.scale)[0])
            row = {"until": times[-1], "steps": found.steps, "cost": cost, "ended": found.ended}
            history.append(row | {"pixels": found.scale} | self.values(places[-1]))
            self.say(f"matches to {times[-1]:.3g} s, {found.steps} steps: {self._shown(places[-1])}")
            kept()
            if number == last:
                break
        return replace(self.result(course, evidence, folder), seconds=time.monotonic() - clock)

    def result(self, course: Mapping[str, Any], evidence: Sequence[Tracks], folder: Path | None) -> Fit:
        at = course["places"][-1]
        place, held = torch.tensor(at, dtype=torch.float64), [split(own)[1] for own in self.tracks]
        values, fast = self.values(at), turning(evidence, self.plan.unknowns, place, self.fitted)
        return Fit(
            self.plan.unknowns,
            tuple(at),
            covariance(*normal(self.residuals(evidence, self.fitted), place)) + self.grid_covariance(place, evidence),
            course["history"],
            course["seconds"],
            "" if course["history"][-1]["ended"] else UNSETTLED,
            (*self.notes(), *fast),
            write_films(folder, held, values, self.times, len(self.fitted)) if folder else {},
            explained(held, values, self.fitted),
            consequences(self.plan.assumed, values, self.simulation),
            self.told,
            self.others(at, course["rivals"]),
        )

    def grid_covariance(self, place: Tensor, evidence: Sequence[Tracks]) -> Tensor:
        """The covariance that the grid adds at a place, (U, U): how far the minimum of another grid is."""
        found = torch.zeros(len(place), len(place), dtype=torch.float64)
        for other in self.grids:
            with suppress(DivergedError):
                own = [replace(part, simulation=other) for part in evidence]
                end = self.solved(place.tolist(), own, self.fitted, REFINED, True).place
                found += torch.outer(end - place, end - place)
        return found

    def notes(self) -> list[str]:
        """Sentences on what speaks against the plan: unknowns that are confounded, a camera, a missing start."""
        both = "move the object in nearly the same way, so both may be far off: put one of them into `known`."
        drag = [name for name in ("aero.C_D", "aero.C_F") if {name, "wind.speed"} <= set(self.sought)]
        found = [f"wind.speed and {name} {both}" for name in drag]
        if "camera" in self.plan.assumed:
            found.append(
                "The camera was found from a frame in which the object may move already, so all values may be off: "
                "give a film that begins at rest."
            )
        found += self.doubts
        asked = [] if self.doubts or self.begins is not None else self.tracks
        still = min((own.still_until() for own in asked), default=0.0)
        if still >= LONG_STILL:
            found.append(
                f"Nothing moves in the first {still:.2g} s of the film, but the simulation starts at once: add "
                f"{FILM_START}: {{range: [0, {math.ceil(20 * still) / 10:g}]}} to `unknowns`, or cut the film."
            )
        return found

    def _shown(self, place: Sequence[float]) -> str:
        return ", ".join(f"{name} {value:.5g}" for name, value in self.values(place).items())


def run_fit(
    plan: Plan,
    output: str | os.PathLike[str],
    *,
    resume: bool = False,
    device: str = "auto",
    progress: bool = True,
    started: Callable[[], None] = lambda: None,
    in_use: Sequence[Path] = (),
) -> Fit:
    """Do a fit, or continue it after its last step, and write its folder.

    ``started`` is called when it can be continued. An earlier fit is not moved aside with files that are ``in_use``.
    """
    begin, folder = time.monotonic(), Path(output)
    problem, parser, settings = _ready(plan, device, progress)
    own = {name: value for name, value in vars(plan).items() if name not in ("base", "unknowns", "iterations")}
    own |= {"unknowns": list(map(vars, plan.unknowns)), "scene": problem.simulation.config}
    described = json.loads(json.dumps(own))  # what must be the same in a fit that is continued, as it is read
    remedy = "choose another with --output"
    if resume and not (folder / PROGRESS).exists():
        raise ValueError(f"There is nothing to resume in {folder}: it has no {PROGRESS}; leave out --resume.")
    needed = [*in_use, *(Path(path) for path in (*plan.base, *plan.videos, settings.scene.ply) if path)]
    lock = hold_folder(folder, remedy) if resume else claim_folder(folder, OURS, remedy, needed)
    try:
        course: dict[str, Any] = {}
        if resume:
            kept = read_json(folder / PROGRESS, "progress of the fit")
            if not isinstance(kept, dict) or kept.get("format") != FORMAT:
                raise ValueError(f"{folder / PROGRESS} is of another version: leave out --resume to begin again.")
            for name, value in described.items():
                if kept["plan"].get(name) != value:
                    raise ValueError(f"The fit in {folder} has another `{name}`: leave out --resume to begin again.")
            course = kept["course"]

        def keep() -> None:
            write_json(folder / PROGRESS, {"format": FORMAT, "plan": described, "course": course})
            started()

        write_before(folder, problem.tracks)
        course["seconds"] = course.get("seconds", 0.0) + time.monotonic() - begin
        try:
            result = problem.run(course, keep, folder)
        except ValueError:
            if "places" not in course:  # it was refused before the first step: only pictures stay
                (folder / PROGRESS).unlink(missing_ok=True)
            raise
        write_results(folder, result, parser, settings, problem.simulation)
        return result
    finally:
        lock.release()
        if not (folder / PROGRESS).exists():
            (folder / MARKER).unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()


def check_fit(plan: Plan, output: str | os.PathLike[str], *, device: str = "auto", progress: bool = True) -> list[Path]:
    """Read all that a fit needs, say what speaks against it and what it takes, and write the pictures before it."""
    problem, *_ = _ready(plan, device, progress)
    for note in (*problem.notes(), problem.expected()):
        problem.say(note)
    return write_before(Path(output), problem.tracks)


def _ready(plan: Plan, device: str, progress: bool) -> tuple[Problem, Any, Any]:
    """The problem, and the parser and the settings of its simulation."""
    opencv()  # before anything that takes time
    parser = Simulation.parser()
    files = [word for name in plan.base for word in ("--config", name)]
    settings = parser.parse_args([*files, *(option(name, value) for name, value in plan.known.items())])
    check_settings(Simulation, settings)
    settings.device = device
    own = settings.clone()
    own.camera = own.cameras = None  # the videos have their own
    simulation, say = Simulation.from_settings(parser, own), Say(progress)
    videos = read_videos(list(plan.videos), plan.cameras, simulation.scene.size, simulation.scene.model.origin)
    earliest = next((u.low for u in plan.unknowns if u.name == FILM_START), None)
    looked = [told for video in videos for told in first_look(simulation, video, earliest)]
    with say.work("the camera of each frame", sum(len(video.times) for video in videos)):
        videos, told, doubts = prepared(simulation, videos, plan.hand_held, plan.also_moves, say.tick)
    for line in told:
        say(line)
    grids = _other_grids(simulation, say)
    return Problem(simulation, videos, plan, say, grids, told, [*looked, *doubts]), parser, settings


def _other_grids(simulation: Simulation, say: Say) -> list[Simulation]:
    found = []
    for ratio in GRIDS:
        try:
            with warnings.catch_warnings():  # of an object of few cells
                warnings.simplefilter("ignore")
                found.append(simulation.on_grid(ratio))
        except ValueError as error:
            say(f"cells {ratio:g} times as large, to know the error of the grid, are not possible: {error}")
    return found


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
) -> Fit:
    """Find the wind and the material of a simulation from videos, as ``gaussian-swaying fit`` does.

    Args:
        base: Configuration of ``sim``, or several: the splat, the solver and all that is known.
        videos: Folders with transforms.json, see :func:`~gaussian_swaying.inverse.videos.read_videos`.
        unknowns: For each unknown its range, such as ``{"wind.speed": [1, 10]}``, or ``{"range": [1, 10], "scale":
            "log", "start": 3}``.
        output: Folder for the results.
        resume: Continue the fit that was stopped in ``output``.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Print a line for each step, and a bar.
        settings: Further fields of :class:`~gaussian_swaying.inverse.plan.Plan`, such as ``known`` and ``until``.
    """
    plan = make_plan({"base": base, "videos": videos, "unknowns": unknowns, **settings}, "a fit")
    return run_fit(plan, output, resume=resume, device=device, progress=progress)
