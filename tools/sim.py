"""Simulate a scene in the wind: ``python tools/sim.py --config configs/sim/flag.yaml``."""

import sys

from gaussian_swaying.cli.simulate import main

if __name__ == "__main__":
    sys.exit(main())
