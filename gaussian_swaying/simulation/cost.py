"""What a run will cost: its substeps, and their time on this machine from a few that are tried."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from gaussian_swaying.mpm.timestep import wave_speed
from gaussian_swaying.simulation.pipeline import SimulationPipeline, describe_device


@dataclass(frozen=True)
class Cost:
    """Cost of a run, from its state at rest.

    A material that stiffens as it deforms, faster wind and a body that moves fast in ``updated`` take more substeps.

    Attributes:
        device: Where it was measured.
        particles: Material points.
        grid: Grid nodes along each axis.
        frames: Frames of the run.
        wave_speed: Fastest elastic wave [m/s].
        stable_substep: Longest stable substep [s].
        substep: The one that the run takes at rest [s].
        substeps: Substeps in a frame.
        substep_seconds: Time that one of them takes [s].
        simulation_seconds: Time that the frames take without their pictures [s].
        picture_seconds: Time that the pictures of a frame take, one from each camera [s]; None if there are none.
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

    @property
    def total_seconds(self) -> float:
        """Time of the whole run [s]."""
        return self.simulation_seconds + self.frames * (self.picture_seconds or 0.0)


@torch.inference_mode()
def estimate_cost(pipeline: SimulationPipeline, frames: int, tries: int = 3, picture: bool = True) -> Cost:
    """Start a run, and measure a few substeps of its first frame and a picture.

    Args:
        pipeline: The run.
        frames: How many frames it is to have.
        tries: Substeps to measure, after one that is not counted.
        picture: Whether the run draws pictures.

    Returns:
        The estimate.

    Raises:
        ValueError: If the run cannot start: a pin holds nothing, the grid is too large, a fixed substep is too long.
    """
    solver = pipeline.solver
    state = pipeline.start()
    steps = max(solver.substeps(state, pipeline.frame_dt), pipeline._drag_substeps(state))
    forces = pipeline.forces
    dt = pipeline.frame_dt / steps
    solver.rollout(state, dt, 1, forces)
    seconds = _seconds(pipeline, lambda: solver.rollout(state, dt, tries, forces)) / tries
    drawn = None
    if picture:  # the further cameras are taken to be as large as the first
        drawn = _seconds(pipeline, lambda: pipeline.render(state, 0)) * (1 + len(pipeline.cameras))
    return Cost(
        device=describe_device(pipeline.device),
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
    )


def _seconds(pipeline: SimulationPipeline, work: Callable[[], object]) -> float:
    """Time that some work takes [s], to its end on a GPU too."""
    begin = time.perf_counter()
    work()
    if pipeline.device.type == "cuda":
        torch.cuda.synchronize(pipeline.device)
    return time.perf_counter() - begin
