"""Train Gaussians from photos: ``python tools/train.py fit --config configs/train/quick_cpu.yaml``."""

import os
import sys

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as tools/sim.py, and for the same reason

from gaussian_swaying.training.cli import main

if __name__ == "__main__":
    sys.exit(main())
