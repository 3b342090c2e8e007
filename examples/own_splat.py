"""A splat of your own: ``python examples/own_splat.py my_splat.ply`` looks at it and lets it move in a breeze.

:func:`suggest`, like ``gaussian-swaying preview``, guesses which way is up, what moves, where it is held and what kind
of thing it is, explains each guess, and makes a simulation. Without a path, the example makes a flag on its pole.
"""

import sys
from pathlib import Path

from PIL import Image

from gaussian_swaying import suggest
from gaussian_swaying.gaussians.formats import export_cloud
from gaussian_swaying.scenes import FlagScene


def main(folder: Path, splat: Path | None = None, frames: int | None = None, spacing: float = 0.03) -> float:
    """Look at a splat, run what is suggested, and return how far the Gaussians moved on average at most [m].

    Args:
        folder: Where everything goes: the picture, the configuration, and the run with its video.
        splat: File in any format that can be read; None for a flag that is made here.
        frames: Frames of the starter; 10 s if None.
        spacing: Distance between the Gaussians of that flag [m].
    """
    folder.mkdir(parents=True, exist_ok=True)
    if splat is None:
        splat = folder / "capture.ply"
        export_cloud(splat, FlagScene(spacing=spacing, stand="pole").generate())
    found = suggest(splat)
    print("\n".join(f"{name}: {reason}" for name, reason in found.reasons.items()))
    Image.fromarray(found.picture()).save(folder / "preview.png")
    found.to_yaml(folder / "starter.yaml")  # to change its numbers, and run it again
    simulation = found.to_simulation()
    return simulation.run(folder / "run", frames=frames)["displacement_mean_max_m"]


if __name__ == "__main__":
    to = Path("outputs/own_splat")
    moved = main(to, Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    print(f"{moved:.2f} m on average; see {to}/preview.png and {to}/run/video.mp4")
