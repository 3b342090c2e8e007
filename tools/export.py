"""Convert a splat for viewers: ``python tools/export.py scene.ply scene.splat``, or a run's ``ply`` folder to USD."""

import argparse
import sys

from gaussian_swaying.cli.errors import run_command  # first, as it sets up threads
from gaussian_swaying.gaussians.export import SUFFIXES, convert


def main(arguments: list[str] | None = None) -> int:
    """Parse and convert; 2 on bad input."""
    parser = argparse.ArgumentParser(prog="export.py", description=__doc__)
    parser.add_argument("source", help="A 3DGS .ply, or a folder of them for an animated USD.")
    parser.add_argument("target", help=f"File to write; its name ends in one of {', '.join(SUFFIXES.values())}.")
    parser.add_argument("--fps", type=float, default=25.0, help="Frames per second of a folder.")
    return run_command(
        lambda: export(parser.parse_args(arguments)), stopped="Stopped; nothing was written.", memory="fewer Gaussians"
    )


def export(settings: argparse.Namespace) -> None:
    """Convert, and say what was written."""
    convert(settings.source, settings.target, settings.fps)
    print(f"wrote {settings.target}")


if __name__ == "__main__":
    sys.exit(main())
