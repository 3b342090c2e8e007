"""Does a configuration sway? ``python tools/sway.py STARTER.yaml`` prints a score and draws the motion."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from gaussian_swaying import Simulation
from gaussian_swaying._files import without_nan
from gaussian_swaying.evaluation.sway import contact_sheet, space_time, sway_score

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", help="a configuration, such as a starter.yaml of the preview")
    parser.add_argument("--frames", type=int, default=250, help="frames to simulate; the first 2 s do not count")
    parser.add_argument("--output", type=Path, help="folder for sheet.png (8 frames) and slice.png (a line over time)")
    given = parser.parse_args()
    places, times, film = [], [], []
    for frame in Simulation.from_yaml(given.config).frames(given.frames):
        means = frame.gaussians.means.detach()
        if not places:  # a sample is enough
            seen = np.random.default_rng(0).choice(len(means), min(len(means), 6000), replace=False)
        places.append(means.cpu().numpy()[seen])
        times.append(frame.time)
        if given.output is not None:
            film.append((frame.render().color.detach().clamp(0, 1) * 255 + 0.5).byte().cpu().numpy())
    score = sway_score(places[0], np.stack(places) - places[0], np.array(times))
    print(json.dumps(without_nan({name: round(value, 4) for name, value in asdict(score).items()}), indent=2))
    if given.output is not None:
        given.output.mkdir(parents=True, exist_ok=True)
        shown = np.linspace(0, len(film) - 1, min(8, len(film))).astype(int)
        iio.imwrite(given.output / "sheet.png", contact_sheet([film[number] for number in shown], columns=4))
        iio.imwrite(given.output / "slice.png", space_time(film, row=len(film[0]) // 3))
