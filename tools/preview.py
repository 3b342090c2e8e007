"""Look at a splat before it is simulated: ``python tools/preview.py SCENE.ply``.

Prints its bounds, up axis, Gaussians, and a guess at every number that a run needs; draws them over the splat; and
writes a first configuration. With ``--config`` it shows what that configuration would do instead.
"""

from __future__ import annotations

import sys

import gaussian_swaying.cli  # noqa: F401  (sets up threads, before torch is imported)
from gaussian_swaying.cli.preview import main

if __name__ == "__main__":
    sys.exit(main())
