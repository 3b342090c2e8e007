"""Films for a browser: how long one takes to make, and how large it is."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.runner import ROOT, Row, study
from bench.speed.timing import seconds
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import write_film


@study("pages", [{"config": "flag", "frames": 75}, {"config": "leaves", "frames": 75}])
def pages(config: str, frames: int, device: str) -> Row:
    """A run of a configuration, and its film."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulation = Simulation.from_yaml(ROOT / "configs" / "sim" / f"{config}.yaml", device=device)
        run = seconds(lambda: simulation.run(folder / "run", frames, progress=False), "cpu")
        made = seconds(lambda: write_film(folder / "run", folder / "film.html"), "cpu")
        return {"run_s": run, "film_s": made, "bytes": (folder / "film.html").stat().st_size}
