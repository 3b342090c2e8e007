"""``gaussian-swaying sim``: parse, build, run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying.cli.errors import guessing, how_to_resume, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.computed_air import resolution
from gaussian_swaying.wind.field import WindField

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, build, run."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = Simulation.parser()
    started: list[Simulation] = []

    def advice(error: BaseException) -> str | None:
        """Return the command that continues from the last checkpoint of the run, if there is one."""
        if not started or started[0].resumable is None:
            return None
        return how_to_resume(*started[0].resumable, arguments, isinstance(error, SimulationDiverged))

    return run_command(
        lambda: _simulate(parser, arguments, started),
        stopped="Stopped; everything recorded so far is kept.",
        advice=advice,
        memory="a smaller `scene.region`, a coarser `solver.dx` or a smaller picture",
        expected=(SimulationDiverged,),
        arguments=arguments,
    )


def _simulate(parser: ArgumentParser, arguments: Sequence[str], started: list[Simulation]) -> None:
    arguments = with_shipped(arguments, "sim")
    with guessing(parser):
        settings = parser.parse_args(arguments)
    simulation = Simulation.from_settings(parser, settings)
    folder = output_folder(settings)
    scene = simulation.scene
    by = f" by {scene.points.count:,} points" if scene.points.count != len(scene.simulated) else ""
    print(f"{len(scene.simulated):,} of {len(scene.model.means):,} Gaussians simulated{by} on {simulation.device}")
    if simulation.stepper.copies is not None:
        print(f"{len(simulation.stepper.copies)} copies of them")
    if scene.loose:
        print(f"{scene.loose:,} loose ones follow their neighbours")
    if scene.filled:
        print(f"{scene.filled:,} points fill the inside")
    print(scene.frame.describe())
    if any(scene.model.origin):
        print(counted_from(scene.model.origin))
    if simulation.model.air is not None and isinstance(simulation.wind, WindField):
        print(resolution(simulation.model.air, simulation.wind, simulation.frame_dt, scene.points.position))
    extra: dict[str, Any] = {"config": [str(file) for file in settings.config or []]}
    started.append(simulation)
    with stop_signals():
        summary = simulation.run(folder, resume=settings.resume, settings=extra, certify=settings.certify)
    seconds = ", ".join(f"{part} {value:.1f} s" for part, value in summary["wall_s"].items())
    print(f"{summary['frames']} frames, {summary['substeps']:,} substeps: {seconds}")
    if settings.certify:
        print(summary["certificate"]["sentence"])
    if summary["torn_particles"]:
        print(
            f"warning: {summary['torn_particles']} particles are farther than two cells from a neighbour, so the "
            "material fell apart numerically: use `solver.formulation: total`, or a coarser `solver.dx`.",
            file=sys.stderr,
        )
    beside = [folder / name for name in ("diagnostics.csv", "checkpoint.pt", "config.yaml")]
    for file in [*simulation.files, *(file for file in beside if file.exists())]:
        print(f"wrote {file}")


def output_folder(settings: Namespace) -> Path:
    """The given folder, or one named after the config file."""
    if settings.output:
        return Path(settings.output)
    files = [str(file) for file in settings.config or []]
    return Path("outputs") / (Path(files[-1]).stem if files else "run")
