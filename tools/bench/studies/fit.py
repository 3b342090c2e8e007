"""Fits of videos whose answer is known: cases of ``tools/datasets/make_fit_data.py`` and ``make_hand_films.py``."""

from __future__ import annotations

import json
import time

from bench.runner import ROOT, Row, study
from gaussian_swaying.cli.fit import main

FOLDERS = (ROOT / "outputs" / "fit_data", ROOT / "outputs" / "hand_films")


def cases(device: str) -> list[Row]:
    """All folders with a configuration of a fit and an answer."""
    del device
    found = sorted(path.parent for folder in FOLDERS for path in folder.rglob("fit.yaml"))
    return [{"case": path.relative_to(ROOT).as_posix()} for path in found if (path / "truth.json").exists()]


@study("fit", cases)
def fitted(case: str, device: str) -> Row:
    """Relative errors of what is sought, that of the azimuth in degrees, and the verdict."""
    folder = ROOT / case
    truth, begin = json.loads((folder / "truth.json").read_text()), time.process_time()
    main(["--config", str(folder / "fit.yaml"), "--output", str(folder / "result"), "--device", device])
    found = json.loads((folder / "result" / "result.json").read_text())
    errors = {}
    for row in found["values"]:
        key = row["name"].split(".")[-1]
        if key in truth:
            errors[key] = row["value"] - truth[key] if key == "azimuth" else row["value"] / truth[key] - 1
    return {"processor_s": time.process_time() - begin, "errors": errors, "verdict": found["verdict"]}
