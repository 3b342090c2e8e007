"""Convert a splat for viewers: ``python tools/export.py scene.ply scene.splat``."""

import sys

from gaussian_swaying.cli.export import main

if __name__ == "__main__":
    sys.exit(main())
