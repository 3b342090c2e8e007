"""The cost of a run: its number of substeps, and their time on this machine, measured on a few."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._provenance import describe_device
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import wave_speed
from gaussian_swaying.simulation.simulation import Simulation


@dataclass(frozen=True)
class Cost:
    """Cost of a run, estimated from its state at rest.

    More substeps are needed if the material stiffens as it deforms, if the wind is faster, or if a body moves fast in
    ``updated``.

    Attributes:
        device: The device on which it was measured.
        particles: Material points.
        grid: Grid nodes along each axis.
        frames: Frames of the run.
        wave_speed: Fastest elastic wave [m/s].
        stable_substep: Longest stable substep [s].
        substep: Substep of the run at rest [s].
        substeps: Substeps per frame.
        substep_seconds: Time for one substep [s].
        simulation_seconds: Time for all frames without pictures [s].
        picture_seconds: Time for the pictures of a frame, one from each camera, including files and video [s]; None
            without pictures.
        startup_seconds: Time to read the splat and prepare the scene [s]; 0 if unknown.
    """

    device: str
    particles: int
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
    simulation: Simulation, frames: int, tries: int = 9, picture: bool = True, startup_seconds: float = 0.0
) -> Cost:
    """Start a run, and measure a few substeps of its first frame and a picture.

    Args:
        simulation: The run.
        frames: Number of frames of the run.
        tries: Number of substeps to measure, after one that is not counted; on a GPU a frame is measured.
        picture: Whether the run draws pictures.
        startup_seconds: Time to prepare the run [s], if known.

    Returns:
        The estimate.

    Raises:
        ValueError: If the run cannot start, because a pin holds nothing, the grid is too large or a fixed substep is
            too long.
    """
    solver = simulation.solver
    state = simulation.start()
    steps = max(solver.substeps(state, simulation.frame_dt), _drag_substeps(simulation, state, frames))
    forces = simulation.forces
    dt = simulation.frame_dt / steps
    if simulation.device.type == "cuda":  # kernels are compiled and graphs recorded in the first frames
        state, _ = simulation.advance(state)
        state, _ = simulation.advance(state)
        seconds = _seconds(simulation, lambda: simulation.advance(state)) / steps
    else:
        solver.rollout(state, dt, 1, forces)
        seconds = min(_seconds(simulation, lambda: solver.rollout(state, dt, 1, forces)) for _ in range(tries))
    drawn = None
    if picture:  # assumes that all cameras have the size of the first
        simulation.painter.render(state, 0)
        work = min(_seconds(simulation, lambda: _encode(simulation.painter.render(state, 0).color)) for _ in range(2))
        drawn = work * (1 + len(simulation.painter.cameras))
    return Cost(
        device=describe_device(simulation.device),
        particles=solver.points.count,
        grid=tuple(state.grid.resolution),
        frames=frames,
        wave_speed=float(wave_speed(solver.points).amax()),
        stable_substep=solver.stable_substep(),
        substep=dt,
        substeps=steps,
        substep_seconds=seconds,
        simulation_seconds=seconds * steps * max(frames - 1, 0),
        picture_seconds=drawn,
        startup_seconds=startup_seconds,
    )


def _drag_substeps(simulation: Simulation, state: MPMState, frames: int) -> int:
    """Substeps per frame needed for explicit drag at rest, on average over the wind of the run."""
    if simulation.idle or simulation.aero.drag_step == "semi_implicit":
        return 1
    winds = simulation.wind_force.samples(state, simulation.frame_dt, frames)
    speed = torch.linalg.vector_norm(winds, dim=-1).reshape(frames, -1).amax(1)
    area, mass = simulation.wind_force.area, simulation.solver.points.mass
    rates = [
        float(simulation.aero.rate(one.to(mass).expand_as(mass), area, mass).amax()) for one in speed.sort().values
    ]
    return math.ceil(statistics.mean(rates) * simulation.frame_dt)


def _encode(image: Tensor) -> None:
    """Work similar to writing a picture and its part of the video: the picture is compressed twice."""
    import imageio.v3 as iio

    pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
    for _ in range(2):
        iio.imwrite("<bytes>", pixels, extension=".png", compress_level=3)


def _seconds(simulation: Simulation, work: Callable[[], object]) -> float:
    """Time for some work [s] on an otherwise idle machine; on a GPU until it is finished."""
    begin = Stopwatch()
    work()
    if simulation.device.type == "cuda":
        torch.cuda.synchronize(simulation.device)
        return begin.wall
    return begin.quiet


class Stopwatch:
    """Time since it was created [s]."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    @property
    def wall(self) -> float:
        """Wall-clock time."""
        return time.perf_counter() - self._wall

    @property
    def quiet(self) -> float:
        """The smaller of wall-clock and processor time, to exclude the time used by other programs."""
        return min(self.wall, time.process_time() - self._cpu)
