"""Several runs in one rollout: their states have a batch dimension, so a GPU does all of them at once."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.run import Run
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.stepper import Stepper


def batch_of(members: Sequence[Simulation]) -> Stepper:
    """A stepper that advances simulations of one scene together.

    Args:
        members: A simulation, and variants of it (``Simulation.variant``) that differ in wind and material.
    """
    first = members[0]
    if any(member.stepper.copies is not None for member in members):
        raise ValueError("These cannot be simulated as a batch: they have `copies`, which are one already.")
    if any(member.editor.edits for member in members):
        raise ValueError("These cannot be simulated as a batch: they have `edits`; put their material into `material`.")
    solver = first.solver.like(first.setup.solver)
    return Stepper(solver, [member.setup for member in members], first.frame_dt, turn=first.turn)


@torch.inference_mode()
def run_batch(
    members: Sequence[Simulation], folders: Sequence[Path | None], frames: int, settings: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any] | None]:
    """Simulate, draw and record simulations of one scene together, as ``Simulation.run`` does for one.

    There are no checkpoints: what is interrupted starts again.

    Args:
        members: As for :func:`batch_of`.
        folders: Folder of each; None for one that is only simulated.
        frames: Number of frames.
        settings: Further entries of each summary.

    Returns:
        The summaries.
    """
    batch = batch_of(members)
    state = batch.start()
    opened, runs = [], dict[int, Run]()
    try:
        for index, (member, folder) in enumerate(zip(members, folders, strict=True)):
            if folder is not None:
                cameras = tuple(member.painter.cameras)
                member.recorder.open(folder, member.config, False, 1 / batch.frame_dt, cameras, alone=False)
                opened.append(member.recorder)
                runs[index] = Run(member.painter, member.editor, member.recorder, frames, member.config)
        begin = time.perf_counter()
        if batch.device.type == "cuda" and frames > 1:  # compiles the kernels; the real frame reports an error
            with suppress(SimulationDiverged):
                batch.advance(state)
        startup = (time.perf_counter() - begin) / len(members)
        begin = time.perf_counter()
        each = batch.at_first(state).each()
        for frame in range(frames):
            launched = batch.launch(state) if frame + 1 < frames else None
            for index, run in runs.items():
                if run.recording:
                    run.record(state.scene(index), frame)
                run.log.append(each[index].as_dict())
            if launched is not None:
                state, _ = launched.finish()
                each = launched.each
        for recorder in opened:
            recorder.wait()
        seconds = (time.perf_counter() - begin) / len(members)
        found: list[dict[str, Any] | None] = [None] * len(members)
        for index, run in runs.items():
            drawn = sum(value for part, value in run.walls.read(wait=True).items() if part != "writing")
            run.walls.seconds["simulation"] = max(seconds - drawn, 0.0)  # its share of what they took together
            run.walls.seconds["startup"] = startup
            found[index] = run.close("complete", None, state.scene(index), frames, dict(settings[index]))
        return found
    finally:
        for recorder in opened:
            recorder.release()
