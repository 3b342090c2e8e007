"""Train Gaussians from photos: ``python tools/train.py fit --config configs/train/quick_cpu.yaml``."""

import sys

from gaussian_swaying.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
