"""Make a video for ``gaussian-swaying fit`` from a configuration of ``sim``: what its ``cameras`` see, with noise.

``python tools/datasets/make_fit_video.py --config configs/sim/printed_flag.yaml --output videos/printed_flag``

The answer is then known, so one can see what a fit finds. It is an easier case than a real video: the model is right.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gaussian_swaying.simulation.simulation import Simulation

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.problems.films import write_video


def main(arguments: list[str] | None = None) -> int:
    """Simulate and write the folder; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True, help="configuration of sim with `cameras`")
    parser.add_argument("--output", type=Path, required=True, help="folder for the video")
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation of each colour, of 255 (3)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (0)")
    parser.add_argument("--frames", type=int, help="number of frames; those of the configuration if left out")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    options = parser.parse_args(arguments)
    simulation = Simulation.from_yaml(options.config, device=options.device)
    painter = simulation.painter
    names = list(painter.cameras) or [""]
    cameras = {name or "main": painter.camera_at(0, name) for name in names}
    write_video(
        simulation, options.output, cameras, options.frames or simulation.frames_wanted, options.noise, options.seed
    )
    print(f"wrote {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
