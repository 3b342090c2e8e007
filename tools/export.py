"""Convert a splat for viewers: ``python tools/export.py scene.ply scene.splat``."""

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("export")
