"""The cost of a run: its number of substeps, and their time on this machine, measured on a few frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from gaussian_swaying._files import PNG
from gaussian_swaying._provenance import cores, describe_device
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.kernels.cpu import compiled
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.writer import WORKERS
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

BUDGET = 2.5  # s; for the frames that are timed
MOST_FRAMES = 9  # timed at most
WARM_UP = 3.0  # s; kernels of a run are loaded and recorded in 2 to 3 s; compiling is done only once on a machine


@dataclass(frozen=True)
class Cost:
    """Cost of a run, estimated from its first frames.

    More substeps are needed if the material stiffens as it deforms, if the wind is faster, or if a body moves fast in
    ``updated``.

    Attributes:
        device: The device on which it was measured.
        dx: Grid spacing [m].
        grid: Grid nodes along each axis.
        frames: Frames of the run.
        substeps: Substeps per frame, on average over the frames that were timed.
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
    cloud: GaussianCloud | None = None,
) -> Cost:
    """Start a run, and measure its first frames and a picture.

    Nothing that a run does once is in the measured frames: on a GPU, kernels are compiled and graphs recorded in two
    frames before.

    Args:
        startup_seconds: Time to prepare the run [s], if known.
        budget: Time for the frames that are timed [s], about.
        cloud: All Gaussians that the run draws, if those of ``simulation`` are some of them.
    """
    solver, state, device = simulation.solver, simulation.start(), simulation.device
    at_rest, warm_up, seconds = solver.substeps(state, simulation.frame_dt), 0.0, 0.0
    each: list[float] = []
    taken: list[int] = []
    begin = Stopwatch()
    try:
        if device.type == "cuda":
            for _ in range(2):
                state, _ = simulation.advance(state)
            warm_up = min(begin.on(device), WARM_UP)
        else:
            seconds = _substep_seconds(simulation, state, at_rest)
        slow, begin = seconds * at_rest > 0.4 * budget, Stopwatch()  # then a frame would take too long
        while not slow and len(each) < MOST_FRAMES and (begin.wall < budget or len(each) < 2):
            frame = Stopwatch()
            state, health = simulation.advance(state)
            each.append(frame.on(device) / health.substeps)
            taken.append(health.substeps)
    except SimulationDiverged:
        seconds = seconds or begin.on(device) / at_rest
    substeps, seconds = max(at_rest, round(statistics.mean(taken or [0]))), statistics.median(each or [seconds])
    drawn = pictures and simulation.recorder.images
    return Cost(
        device=describe_device(device),
        particles=solver.points.count,
        dx=solver.dx,
        grid=tuple(solver.describe(state).get("grid", {}).get("resolution", ())),
        frames=frames,
        substeps=substeps,
        substep_seconds=seconds,
        simulation_seconds=seconds * substeps * (frames - 1),
        picture_seconds=_picture_seconds(simulation, state, cloud) if drawn else None,
        startup_seconds=startup_seconds + warm_up,
    )


def _substep_seconds(simulation: Simulation, state: State, at_rest: int) -> float:
    """Time for a substep [s], without compiling: of eight, the quicker of two trials."""
    steps, dt = min(8, at_rest), simulation.frame_dt / at_rest

    def rollout() -> None:
        simulation.solver.watched_rollout(state, dt, steps, simulation.forces, looks=1)

    return min(_seconds(simulation, rollout) for _ in range(2)) / steps


def _picture_seconds(simulation: Simulation, state: State, cloud: GaussianCloud | None) -> float:
    """Time that the pictures of a frame add [s]: to draw them, in proportion to all Gaussians, and to write them."""
    import imageio.v3 as iio

    painter = simulation.painter
    count = (1 + len(painter.cameras)) * len(simulation.recorder.renders)  # as if all were the first
    pixels = (painter.render(state, 0).color.clamp(0, 1) * 255).byte().cpu().numpy()
    more = 1.0 if cloud is None else len(cloud) / len(painter.scene.model.means)

    def encode() -> None:  # work similar to writing a picture and its part of the video
        for _ in range(2):
            iio.imwrite("<bytes>", pixels, extension=".png", **PNG)

    draw = more * min(_seconds(simulation, lambda: painter.render(state, 0)) for _ in range(2))
    write = min(_seconds(simulation, encode) for _ in range(2))
    return count * (draw + write / min(WORKERS, max(1, cores() - 1)))  # further threads write


def _seconds(simulation: Simulation, work: Callable[[], object]) -> float:
    """Time for some work [s] on an otherwise idle machine; on a GPU until it is finished."""
    begin = Stopwatch()
    work()
    return begin.on(simulation.device)


class Stopwatch:
    """Time since its creation [s], without compilation of kernels for a CPU, which the next run finds in a cache."""

    def __init__(self) -> None:
        self._begin = self._now()

    @staticmethod
    def _now() -> tuple[float, float]:
        _, wall, busy = compiled()
        return time.perf_counter() - wall, time.process_time() - busy

    @property
    def wall(self) -> float:
        return self._now()[0] - self._begin[0]

    @property
    def quiet(self) -> float:
        """The smaller of wall-clock and processor time, which excludes the load of other programs."""
        return min(now - then for now, then in zip(self._now(), self._begin, strict=True))

    def on(self, device: torch.device) -> float:
        """Time for work on a device: on a GPU until it is finished, else :attr:`quiet`."""
        if device.type == "cuda":
            torch.cuda.synchronize(device)
            return self.wall
        return self.quiet
