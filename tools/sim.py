"""Simulate a scene in the wind: ``python tools/sim.py --config configs/sim/flag.yaml``."""

import os
import sys

# Threads that spin while they wait make a run ten and more times slower as soon as another program wants a core.
# OpenMP reads this once, so it has to be set before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from gaussian_swaying.simulation.config import main

if __name__ == "__main__":
    sys.exit(main())
