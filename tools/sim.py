"""Simulate a scene in the wind: ``python tools/sim.py --config configs/sim/flag.yaml``."""

import os
import sys

# How long OpenMP's threads spin before they sleep. The default, much longer, is no faster on a quiet machine, but makes
# a run tens of times slower as soon as another program wants a core. Read once, so set before torch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

from gaussian_swaying.simulation.config import main

if __name__ == "__main__":
    sys.exit(main())
