"""Compare a run with a reference: ``gaussian-swaying eval RUN REFERENCE --output DIR``.

RUN is an output folder of ``gaussian-swaying sim``. REFERENCE has ``frames/*.png`` and, for the Chamfer distance,
``cloth.npz`` with ``positions`` (T, V, 3) [m] and ``faces``. Writes eval.json, eval.md and comparison.mp4.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import DEVICE, run_command
from gaussian_swaying.simulation.model import resolve_device


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=program.name("eval"), description="Compare a run with a reference, frame by frame."
    )
    add = parser.add_argument
    add("run", help="folder of a run")
    add("reference", help="folder with frames/*.png and, for the Chamfer distance, cloth.npz")
    add("--output", help="where to write eval.json, eval.md and comparison.mp4; RUN/eval if left out")
    add("--reference-offset", type=int, default=0, help="frame of the reference to compare with frame 0 of the run")
    add("--frames", type=int, help="compare only this many frames")
    add("--side", type=float, help="longer side of the surface [m]; that of cloth.npz if left out")
    add("--points", type=int, default=10_000, help="points on the surface, and largest number of particles")
    add("--seed", type=int, default=0, help="seed of the points")
    add("--no-video", action="store_true", help="do not make comparison.mp4")
    add("--device", **DEVICE)
    fvd = parser.add_argument_group("Fréchet video distance")
    fvd.add_argument("--i3d", metavar="FILE", help="I3D network as TorchScript; without it there is no FVD")
    fvd.add_argument("--clip-length", type=int, default=16, help="frames in a clip")
    fvd.add_argument("--clip-stride", type=int, default=1, help="frames between the starts of clips")
    fvd.add_argument("--resize", type=int, default=224, help="side of the frames given to the network [pixels]")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Parse and compare."""
    parser = build_parser()
    return run_command(
        lambda: compare(parser.parse_args(arguments)),
        stopped="Stopped; nothing was written.",
        memory="fewer `--points`, or `--device cpu`",
    )


def compare(options: argparse.Namespace) -> None:
    """Compare, print the table and report the files."""
    from gaussian_swaying.evaluation.compare import evaluate, table

    output = Path(options.output or Path(options.run) / "eval")
    device = resolve_device(options.device)
    network = None
    if options.i3d:
        from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance  # torchmetrics takes seconds to load

        network = FrechetVideoDistance(options.i3d, options.clip_length, options.clip_stride, options.resize)
    result = evaluate(
        options.run,
        options.reference,
        output,
        video=not options.no_video,
        device=device,
        fvd=network,
        progress=sys.stderr.isatty(),
        **{name: getattr(options, name) for name in ("reference_offset", "frames", "side", "points", "seed")},
    )
    print(table(result), end="")
    for name in ("eval.json", "eval.md", "comparison.mp4"):
        if (output / name).exists() and not (name == "comparison.mp4" and (options.no_video or not result["size"])):
            print(f"wrote {output / name}")
