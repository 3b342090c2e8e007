"""Convert a splat for viewers: ``python tools/export.py scene.ply scene.splat``, or a run's ``ply`` folder to USD."""

import argparse
import sys

from gaussian_swaying.gaussians.export import SUFFIXES, convert


def main(arguments: list[str] | None = None) -> int:
    """Parse and convert; 2 on bad input."""
    parser = argparse.ArgumentParser(prog="export.py", description=__doc__)
    parser.add_argument("source", help="A 3DGS .ply, or a folder of them for an animated USD.")
    parser.add_argument("target", help=f"File to write; its name ends in one of {', '.join(SUFFIXES.values())}.")
    parser.add_argument("--fps", type=float, default=25.0, help="Frames per second of a folder.")
    settings = parser.parse_args(arguments)
    try:
        convert(settings.source, settings.target, settings.fps)
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"wrote {settings.target}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
