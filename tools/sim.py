"""Simulate a scene in the wind: ``python tools/sim.py --config configs/sim/flag.yaml``."""

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("sim")
