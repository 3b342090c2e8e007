"""Does a configuration sway? ``python tools/sway.py STARTER.yaml`` prints a score."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

import numpy as np

from gaussian_swaying import Simulation
from gaussian_swaying._files import without_nan
from gaussian_swaying.evaluation.sway import sway_score

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", help="a configuration, such as a starter.yaml of the preview")
    parser.add_argument("--frames", type=int, default=250, help="frames to simulate; the first 2 s do not count")
    given = parser.parse_args()
    places, times = [], []
    for frame in Simulation.from_yaml(given.config).frames(given.frames):
        means = frame.gaussians.means.detach()
        if not places:  # a sample is enough
            seen = np.random.default_rng(0).choice(len(means), min(len(means), 6000), replace=False)
        places.append(means.cpu().numpy()[seen])
        times.append(frame.time)
    score = sway_score(places[0], np.stack(places) - places[0], np.array(times))
    print(json.dumps(without_nan({name: round(value, 4) for name, value in asdict(score).items()}), indent=2))
