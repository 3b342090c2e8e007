"""``bench.py handheld``: cameras, exposure and wind found from films by a hand that shakes, against the truth."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench.case import Case, Measurement, option
from bench.cases.fit import errors
from bench.problems.handheld import TRUTH, drift, off, shaken, tripod, write_base, write_film
from bench.record import Row
from gaussian_swaying.fitting.fit import run_fit
from gaussian_swaying.fitting.plan import Plan, read_unknown
from gaussian_swaying.fitting.prepared import prepared
from gaussian_swaying.fitting.videos import read_videos
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.simulation.parameters import flow_of
from gaussian_swaying.simulation.simulation import Simulation

SIZE, FRAMES = (480, 270), 46
SOUGHT = {"wind.speed": [2, 12], "wind.azimuth": [-20, 100], "material.E": [2e3, 5e4]}
ON_FLAG = torch.tensor([[0.2, 0.0, 0.15], [0.4, 0.0, 0.3], [0.4, 0.0, 0.0]], dtype=torch.float64)
"""Places on the flag at rest where the error of a camera is seen [m]."""

ROWS: dict[str, dict[str, Any]] = {
    "tripod": {"degrees": 0.0},
    "tripod, exposure drifts": {"degrees": 0.0, "drifts": True},
    "hand": {},
    "hand, exposure drifts": {"drifts": True},
    "hand, exposure drifts, splat with faults": {"drifts": True, "worn": True},
    "hand, exposure drifts, real walls": {"drifts": True, "real": True},
    "hand, exposure drifts, only a wall beside the flag": {"drifts": True, "back": False},
    "hand, taken for a tripod": {"hand_held": False},
}


def measured(
    degrees: float = 1.0,
    drifts: bool = False,
    worn: bool = False,
    real: bool = False,
    back: bool = True,
    hand_held: bool | None = None,
    search: int = 24,
) -> Row:
    """One film, its cameras and gains, and the fit.

    Args:
        degrees: Shake of the hand, root mean square; 0 for a tripod.
        drifts: Whether exposure and white balance drift.
        worn: Whether the splat that is fitted has faults which the film has not.
        real: Whether the walls of the film are photographed by rays, and the splat's are twice as fine.
        back: Whether there is a wall behind the flag.
        hand_held: The option of the fit.
        search: Simulations of the coarse search.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder, wall = Path(scratch), 0.01 if real else 0.02
        filmed = Simulation.from_yaml(write_base(folder / "filmed", wall=wall, back=back), device="cpu")
        still = tripod(*SIZE)
        true = shaken(still, FRAMES, degrees) if degrees else [still] * FRAMES
        gains = drift(FRAMES) if drifts else torch.ones(FRAMES, 3, dtype=torch.float64)
        write_film(filmed, folder / "film", true, gains, real=real)
        base = write_base(folder / "known", wall=wall, back=back, worn=worn)
        videos, begin = read_videos(folder / "film"), time.process_time()
        (video,), (judged,) = prepared(Simulation.from_yaml(base, device="cpu"), videos, hand_held)
        took = time.process_time() - begin
        pairs = list(zip(video.cameras, true, strict=True))
        angle, place = torch.tensor([off(found, other) for found, other in pairs], dtype=torch.float64).T
        shift = torch.stack([project(ON_FLAG, a)[0] - project(ON_FLAG, b)[0] for a, b in pairs]).norm(dim=-1)
        mean = videos[0].images.double().mean((1, 2)) / video.images.double().mean((1, 2))
        sought = [read_unknown(name, ends) for name, ends in SOUGHT.items()]
        plan = Plan([str(base)], [str(folder / "film")], sought, search=search, hand_held=hand_held)
        begin = time.process_time()
        result = run_fit(plan, folder / "fit", device="cpu", progress=False)
        return {
            "degrees": float(angle.median()),
            "most_degrees": float(angle.max()),
            "distance": float(place.median()),
            "most_distance": float(place.max()),
            "px": float(shift.square().mean().sqrt()),
            "gain": float((mean / gains - 1).abs().max()),
            "unseen": judged.unseen,
            "moved_px": judged.moved,
            "prepare_s": took / FRAMES,
            **errors(flow_of(TRUTH["flow"], result.values), TRUTH["flow"]),
            "material.E_error": result.values["material.E"] / TRUTH["material.E"] - 1,
            "verdict": result.verdict,
            "processor_s": time.process_time() - begin,
        }


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The films that are wanted."""
    for name in options.row or ROWS:
        yield ("rows", name), partial(measured, **ROWS[name], search=options.search)


CASE = Case(
    "Measure what a fit finds from films by a hand that shakes, with exposure that drifts.",
    rows,
    (
        option("--row", "only this one; repeatable", action="append", choices=list(ROWS)),
        option("--search", "simulations of the coarse search", type=int, default=24),
    ),
    page="fit.md",
    device=False,
)
