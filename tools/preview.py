"""Preview a splat before simulating it: ``python tools/preview.py SCENE.ply``.

Prints the bounds, up axis and Gaussians of the splat and a guess for every number that a run needs, draws them over
the splat, and writes a first configuration. With ``--config`` it shows what that configuration does instead.
"""

from __future__ import annotations

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("preview")
