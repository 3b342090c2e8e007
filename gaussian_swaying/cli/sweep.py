"""Many runs of one configuration: ``gaussian-swaying sweep SWEEP.yaml``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_whole, first_line
from gaussian_swaying.cli.errors import DEVICE, command, guessing, run_command, sentence
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.simulation import Simulation

MEMORY = "fewer `--workers`, a smaller `scene.region`, a coarser `solver.dx` or a smaller picture"


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=program.name("sweep"),
        description="Do many runs of `sim`: a base configuration, and axes along which options differ. Each run has "
        "its own folder; sweep.csv has a row for each, and contact_sheet.png a picture.",
    )
    add = parser.add_argument
    add("sweep", help="YAML file with base, axes and, if needed, settings, draws and seed; or a shipped one by name")
    add("--output", help="folder for the results; outputs/sweeps/<name of the file> if left out")
    add("--resume", action="store_true", help="do what is missing in the folder; complete runs are never done again")
    add("--workers", type=int, help="runs at a time, each in a process; one per GPU or core if left out")
    add("--threads", type=int, help="threads of each run; cores / workers if left out")
    add("--retries", type=int, default=1, help="how often a failed run is tried again; thrice that if it was killed")
    add("--device", **DEVICE)
    together = "simulate up to N runs of equal shape as one, with substeps of the same length: faster on a GPU"
    add("--together", type=int, default=1, metavar="N", help=together)
    ray = "let Ray do the runs, on this machine or on the cluster at an address; needs gaussian-swaying[ray]"
    add("--ray", nargs="?", const="local", metavar="ADDRESS", help=ray)
    add("--parquet", action="store_true", help="also write sweep.parquet; needs gaussian-swaying[parquet]")
    shards = "also write WebDataset shards with N runs in each; needs gaussian-swaying[webdataset]"
    add("--shards", type=int, metavar="N", help=shards)
    add("--list", action="store_true", help="print the runs and end")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Parse and sweep."""
    parser = build_parser()
    return run_command(
        lambda: sweep(parser.parse_args(arguments), arguments),
        stopped="Stopped; complete runs are kept, and those that were running continue from their last frame. To do "
        f"what is missing:\n  {command(arguments, '--resume')}",
        memory=MEMORY,
        arguments=arguments,
    )


def explain(error: BaseException) -> str:
    """One sentence about an error of a run."""
    told = sentence(error, MEMORY)
    if told is not None:
        return told
    return f"{type(error).__name__}: {first_line(error)} This is a bug; its traceback is in the folder logs."


def sweep(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Do the runs that are missing, and report."""
    from gaussian_swaying.sweeps.dataset import PARQUET, SHARDS, TABLE, write_shards
    from gaussian_swaying.sweeps.plan import read_sweep
    from gaussian_swaying.sweeps.run import check_extra, run_sweep

    if options.shards is not None:
        check_whole("shards", options.shards, 1)
        check_extra("shards")
    file = Path(with_shipped(["--config", options.sweep], "sweep")[1])
    parser = Simulation.parser()
    with guessing(parser):
        plan = read_sweep(file, lambda name: with_shipped(["--config", name], "sim")[1], parser)
    if options.list:
        for name, run in zip(plan.names, plan.runs, strict=True):
            print(f"{name}  {', '.join(f'{axis} {value}' for axis, value in run.items())}")
        return 0
    folder = Path(options.output or Path("outputs") / "sweeps" / file.stem)
    others = {name: value for name, value in vars(options).items() if name not in ("sweep", "output", "shards", "list")}
    with stop_signals():
        results = run_sweep(plan, folder, explain=explain, **others)
    counts = Counter(result["status"] for result in results.values())
    print(f"{len(results)} runs: {', '.join(f'{count} {status}' for status, count in sorted(counts.items()))}")
    wrote = [folder / "runs", folder / TABLE, folder / "contact_sheet.png"]
    complete = [name for name, result in results.items() if result["status"] == "complete"]
    if options.shards is not None and complete:
        place = folder / "runs" / complete[0]  # with all that was recorded
        frames, positions = (place / "frames").is_dir(), (place / "trajectory.npz").exists()
        write_shards(folder, options.shards, frames=frames, positions=positions)
        wrote.append(folder / SHARDS)
    for file in (*wrote, *([folder / PARQUET] if options.parquet else [])):
        print(f"wrote {file}")
    failed = [name for name, result in sorted(results.items()) if result["status"] != "complete"]
    if failed:
        print(
            f"error: {len(failed)} of {len(results)} runs failed, the first because: {results[failed[0]]['reason']} "
            f"After a change on this machine, `{command(arguments, '--resume')}` tries them again.",
            file=sys.stderr,
        )
    return 2 if failed else 0
