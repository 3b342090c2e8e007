"""The cost of a run: its number of substeps, and their time on this machine, measured on a few frames."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying._files import PNG
from gaussian_swaying._provenance import cores, describe_device
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.kernels.cpu import compiled
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.timestep import wave_speed
from gaussian_swaying.recording.writer import WORKERS
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

BUDGET = 2.5  # s; for the frames that are timed
MOST_FRAMES = 9  # timed at most
TRIAL = 0.02  # s; substeps are timed together until they take so long
SUBSTEPS = 5  # timed where a frame takes longer than the budget
WARM_UP = 3.0  # s; kernels of a run are loaded and recorded in 2 to 3 s; compiling is done only once on a machine


@dataclass(frozen=True)
class Cost:
    """Cost of a run, estimated from its first frames.

    More substeps are needed if the material stiffens as it deforms, if the wind is faster, or if a body moves fast in
    ``updated``.

    Attributes:
        device: The device on which it was measured.
        particles: Material points.
        dx: Grid spacing [m].
        grid: Grid nodes along each axis.
        frames: Frames of the run.
        wave_speed: Fastest elastic wave [m/s].
        stable_substep: Longest stable substep [s].
        substep: Substep of the run at rest [s].
        substeps: Substeps per frame, on average over the run.
        substep_seconds: Time for one substep, with its share of what a frame takes besides [s].
        simulation_seconds: Time for all frames without pictures [s].
        picture_seconds: Time that the pictures of a frame add, one from each camera, including files and video [s];
            None without pictures.
        startup_seconds: Time to read the splat and prepare the scene, and on a GPU its kernels [s].
    """

    device: str
    particles: int
    dx: float
    grid: tuple[int, ...]
    frames: int
    wave_speed: float
    stable_substep: float
    substep: float
    substeps: int
    substep_seconds: float
    simulation_seconds: float
    picture_seconds: float | None
    startup_seconds: float = 0.0

    @property
    def total_seconds(self) -> float:
        """Time of the whole run [s]."""
        return self.startup_seconds + self.simulation_seconds + self.frames * (self.picture_seconds or 0.0)


@torch.inference_mode()
def estimate_cost(
    simulation: Simulation,
    frames: int,
    startup_seconds: float = 0.0,
    budget: float = BUDGET,
    pictures: bool = True,
) -> Cost:
    """Start a run, and measure its first frames and a picture.

    Nothing that a run does once is in the measured frames: on a GPU, kernels are compiled and graphs recorded in two
    frames before.

    Args:
        simulation: The run.
        frames: Number of frames of the run.
        startup_seconds: Time to prepare the run [s], if known.
        budget: Time for the frames that are timed [s], about.
        pictures: Whether pictures count, if the run makes some.

    Returns:
        The estimate.
    """
    solver = simulation.solver
    state = simulation.start()
    at_rest = solver.substeps(state, simulation.frame_dt)
    warm_up, each, taken = _timed_frames(simulation, state, at_rest, budget)
    steps = max(at_rest, statistics.mean(taken), _drag_substeps(simulation, state, frames))
    seconds = statistics.median(each)
    drawn = _picture_seconds(simulation, state, seconds * steps) if pictures and simulation.recorder.images else None
    return Cost(
        device=describe_device(simulation.device),
        particles=solver.points.count,
        dx=solver.dx,
        grid=tuple(solver.describe(state).get("grid", {}).get("resolution", ())),
        frames=frames,
        wave_speed=float(wave_speed(solver.points).amax()),
        stable_substep=solver.stable_substep(),
        substep=simulation.frame_dt / at_rest,
        substeps=round(steps),
        substep_seconds=seconds,
        simulation_seconds=seconds * round(steps) * (frames - 1),
        picture_seconds=drawn,
        startup_seconds=startup_seconds + warm_up,
    )


def _timed_frames(
    simulation: Simulation, state: State, at_rest: int, budget: float
) -> tuple[float, list[float], list[int]]:
    """Time to load the kernels [s]; and of some frames the time for a substep [s] and their numbers of substeps."""
    warm_up = 0.0
    each: list[float] = []
    taken: list[int] = []
    begin = Stopwatch()
    try:
        if simulation.device.type == "cuda":
            state, _ = simulation.advance(state)
            torch.cuda.synchronize(simulation.device)
            warm_up = min(begin.wall, WARM_UP)
            state, _ = simulation.advance(state)
        else:
            substep, each_trial = _trial(simulation, state, at_rest)
            if each_trial * at_rest > 0.4 * budget:  # a frame would take too long
                return 0.0, [substep() for _ in range(SUBSTEPS)], [at_rest]
        begin = Stopwatch()
        while len(each) < MOST_FRAMES and (begin.wall < budget or len(each) < 2):
            frame = Stopwatch()
            state, health = simulation.advance(state)
            each.append(frame.on(simulation.device) / health.substeps)
            taken.append(health.substeps)
    except SimulationDiverged:
        if not each:
            return warm_up, [begin.on(simulation.device) / at_rest], [at_rest]
    return warm_up, each, taken


def _trial(simulation: Simulation, state: State, at_rest: int) -> tuple[Callable[[], float], float]:
    """A function that times a substep [s], and its first result.

    A rollout of one substep would measure what a rollout takes besides: there are as many as take some time, but no
    more than in a frame.
    """
    dt, steps = simulation.frame_dt / at_rest, 1

    def rollout() -> None:
        simulation.solver.watched_rollout(state, dt, steps, simulation.forces, looks=1)

    def seconds() -> float:
        return _seconds(simulation, rollout) / steps

    while True:
        rollout()  # compiles and records what is not yet compiled
        found = seconds()
        if steps == at_rest or found * steps > TRIAL:
            return seconds, found
        steps = min(8 * steps, at_rest)


def _picture_seconds(simulation: Simulation, state: State, frame: float) -> float:
    """Time that the pictures of a frame add to the ``frame`` seconds without [s].

    Further threads and ffmpeg write the files and the video. If there are more than two cores, they use the others, and
    the run waits only for what they cannot write in the time of a frame.
    """
    painter = simulation.painter
    count = (1 + len(painter.cameras)) * len(simulation.recorder.renders)  # as if all were the first
    image = painter.render(state, 0).color
    draw = count * min(_seconds(simulation, lambda: painter.render(state, 0)) for _ in range(2))
    write = count * min(_seconds(simulation, lambda: _encode(image)) for _ in range(2))
    free = cores()
    return draw + write if free <= 2 else max(draw, write / min(WORKERS, free - 1) - frame)


@torch.inference_mode()
def with_whole(cost: Cost, simulation: Simulation, cloud: GaussianCloud) -> Cost:
    """The cost of a run that draws all Gaussians of a place, from its cost with those around what moves.

    A picture of every fifth one tells how its time grows with their number; all at once would take more memory.

    Args:
        cost: The cost with some.
        simulation: The run with some.
        cloud: All Gaussians.
    """
    if cost.picture_seconds is None:
        return cost
    painter = simulation.painter
    count = (1 + len(painter.cameras)) * len(simulation.recorder.renders)
    camera, device = painter.camera_at(0), simulation.device
    fifth = cloud.select(torch.arange(0, len(cloud), 5)).to(device)
    shape, opacity = covariance(fifth.quats, fifth.scales), fifth.opacities.sigmoid()
    colours = 0.5 + SH_DC * fifth.sh[:, 0]
    some, model = painter.scene.rest(), painter.scene.model
    few, own = model.opacity(), model.colors(some.means)

    def seconds(means: Tensor, covariances: Tensor, opacity: Tensor, colours: Tensor) -> float:
        def draw() -> None:
            painter.renderer(means, covariances, opacity, colours, camera, painter.background)

        return min(_seconds(simulation, draw) for _ in range(2))

    drawn = seconds(some.means, some.covariances, few, own), seconds(fifth.means, shape, opacity, colours)
    numbers = len(some.means), len(fifth)
    more = numbers[1] - numbers[0]  # negative where more than a fifth is around what moves
    each = max((drawn[1] - drawn[0]) / more, 0.0) if more else 0.0
    # a frame has places, covariances, normals, rotations and colours of all
    tables = (fifth.means, shape, fifth.means, shape, colours)
    copied = min(_seconds(simulation, lambda: [table.clone() for table in tables]) for _ in range(2)) / len(fifth)
    return replace(cost, picture_seconds=cost.picture_seconds + (count * each + copied) * (len(cloud) - numbers[0]))


def scaled_seconds(cost: Cost, other: Cost, dx: float) -> float:
    """Time of a run on another grid [s], from its cost on one grid and the time for a substep on another.

    The substeps of a frame grow with 1 / dx. The time for a substep follows the power of dx between the two grids.

    Args:
        cost: The run on a grid as close to ``dx`` as there is.
        other: The same scene on another grid; its frames and pictures do not count.
        dx: Grid spacing [m].
    """
    power = 2.0  # of a surface
    if abs(math.log(other.dx / cost.dx)) > 0.1:
        power = math.log(other.substep_seconds / cost.substep_seconds) / math.log(cost.dx / other.dx)
    finer = cost.dx / dx
    changed = cost.simulation_seconds * finer ** (1 + min(max(power, 0.0), 3.0))
    return cost.total_seconds - cost.simulation_seconds + changed


def finest_within(
    measure: Callable[[float], Cost], seconds: float, first: Cost, finest: float, coarsest: float
) -> Cost:
    """The cost of a run on the finest grid that takes at most some time; on the coarsest one if none does.

    Args:
        measure: Function that estimates the cost of the run for a grid spacing [m].
        seconds: Longest time of the run [s].
        first: Its result for one spacing.
        finest: Smallest grid spacing [m].
        coarsest: Largest grid spacing [m].
    """
    tried = {first.dx: first}
    for _ in range(3):
        dx = predicted_spacing(tried.values(), seconds, finest, coarsest)
        if dx in tried:
            break
        try:
            tried[dx] = measure(dx)
        except ValueError:  # a finer grid than the first may need too many nodes or points
            if dx > first.dx:
                raise
            finest = math.sqrt(dx * first.dx)
    fitting = [cost for cost in tried.values() if cost.total_seconds <= seconds]
    if fitting:
        return min(fitting, key=lambda cost: cost.dx)
    return tried[coarsest] if coarsest in tried else measure(coarsest)


def predicted_spacing(tried: Collection[Cost], seconds: float, finest: float, coarsest: float) -> float:
    """The finest grid spacing on which a run should take at most some time [m], rounded up to two digits.

    Args:
        tried: The run on some grids.
        seconds: Longest time of the run [s].
        finest: Smallest grid spacing [m].
        coarsest: Largest grid spacing [m]; the result if none is coarse enough.
    """
    nearest = min(tried, key=lambda cost: abs(math.log(cost.total_seconds / seconds)))
    other = min(tried, key=lambda cost: _apart(cost.dx, nearest.dx))
    low, high = finest, coarsest
    for _ in range(30):  # the time falls as dx grows
        middle = math.sqrt(low * high)
        low, high = (middle, high) if scaled_seconds(nearest, other, middle) > seconds else (low, middle)
    return min(_rounded_up(high), coarsest)


def _apart(dx: float, from_dx: float) -> float:
    """Return the distance of two grid spacings, as a logarithm; infinite if they are nearly the same."""
    distance = abs(math.log(dx / from_dx))
    return distance if distance > 0.1 else math.inf


def _rounded_up(value: float) -> float:
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-6) * unit:.2g}")


def _drag_substeps(simulation: Simulation, state: State, frames: int) -> int:
    """Substeps per frame needed for explicit drag at rest, on average over the wind of the run."""
    if simulation.stepper.idle or simulation.aero.drag_step == "semi_implicit":
        return 1
    winds = simulation.stepper.wind_force.samples(state, simulation.frame_dt, frames)
    speed = torch.linalg.vector_norm(winds, dim=-1).reshape(frames, -1).amax(1)
    area, mass = simulation.stepper.wind_force.area, simulation.solver.points.mass
    rates = [
        float(simulation.aero.rate(one.to(mass).expand_as(mass), area, mass).amax()) for one in speed.sort().values
    ]
    return math.ceil(statistics.mean(rates) * simulation.frame_dt)


def _encode(image: Tensor) -> None:
    """Work similar to writing a picture and its part of the video: the picture is compressed twice."""
    import imageio.v3 as iio

    pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
    for _ in range(2):
        iio.imwrite("<bytes>", pixels, extension=".png", **PNG)


def _seconds(simulation: Simulation, work: Callable[[], object]) -> float:
    """Time for some work [s] on an otherwise idle machine; on a GPU until it is finished."""
    begin = Stopwatch()
    work()
    return begin.on(simulation.device)


class Stopwatch:
    """Time since it was created [s], without that to compile kernels for a CPU: the next run finds them."""

    def __init__(self) -> None:
        _, wall, busy = compiled()
        self._wall, self._cpu = time.perf_counter() - wall, time.process_time() - busy

    @property
    def wall(self) -> float:
        return time.perf_counter() - compiled()[1] - self._wall

    @property
    def quiet(self) -> float:
        """The smaller of wall-clock and processor time, to exclude the time used by other programs."""
        return min(self.wall, time.process_time() - compiled()[2] - self._cpu)

    def on(self, device: torch.device) -> float:
        """Time for work on a device: on a GPU until it is finished, else :attr:`quiet`."""
        if device.type == "cuda":
            torch.cuda.synchronize(device)
            return self.wall
        return self.quiet
