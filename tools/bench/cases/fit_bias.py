"""``bench.py fit --bias``: how far faults of the model alone move what a fit finds, without a fit and without pictures.

The simulation runs with the true values. What is left between it and the true motion, seen by the cameras of the video,
is a fault of the model. One step of Gauss and Newton from the truth says which values a fit would take for it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import torch

from bench.case import Measurement
from bench.cases.fit_reference import OWN, plan_of, read_motion, simulation_of, true_values
from bench.record import Row
from gaussian_swaying.fitting.evidence import Evidence, TrackEvidence, scales_of
from gaussian_swaying.fitting.fit import Fit
from gaussian_swaying.fitting.least_squares import normal_equations, sensitivities, step_from
from gaussian_swaying.fitting.tracks import Tracks
from gaussian_swaying.fitting.videos import read_videos
from gaussian_swaying.rendering.cameras.camera import project

ALONG = (20, 14)
"""Places on the cloth that are compared, along its width and height."""


def rows(options: argparse.Namespace, folders: Sequence[Path]) -> Iterator[Measurement]:
    """A row for each case and each ``--bias``."""
    for folder in folders:
        for text in options.bias:
            given = json.loads(text)
            changed = {"aero.law": options.law, **json.loads(options.known), **given}
            key = name_of(folder.name, given, options.until, options.motion)
            yield ("bias", key), partial(bias, folder, changed, options.until, options.device, options.motion)


def name_of(case: str, options: Row, until: float | None, motion: str = OWN) -> str:
    """The name of a row: the case, its options (of lists only which they are), and time and motion if given."""
    told = [f"{key} {value}" if isinstance(value, (int, float, str)) else key for key, value in options.items()]
    told += [] if until is None else [f"to {until:g} s"]
    return ", ".join([case, *told, *([] if motion == OWN else [f"beside {motion}"])])


def bias(folder: Path, changed: Row, until: float | None, device: str, motion: str = OWN) -> Row:
    """Where one step of Gauss and Newton leads from the truth.

    Args:
        folder: A case of ``make_fit_data.py``.
        changed: Options of ``sim`` that replace those of the case.
        until: Compare the frames up to this time [s]; half of the video if it is None.
        device: ``cpu`` or ``cuda``.
        motion: The motion to compare with, a file in the folder.
    """
    begin = time.process_time()
    plan, truth = plan_of(folder, changed, until)
    sought = plan.unknowns
    fit = Fit(simulation_of(plan, device), read_videos(str(folder)), plan)
    evidence = _true_tracks(fit, folder / motion)
    true = true_values(truth)
    place = torch.tensor([u.share(true[u.name]) for u in sought], dtype=torch.float64)
    blocks, steps = sensitivities(fit.residuals(evidence, fit.fitted), place)
    normal = normal_equations(blocks, scales_of(blocks, {"tracks": TrackEvidence.floor}), steps)
    found = fit.values(step_from(normal, place))
    return {
        "speed_error": found["wind.speed"] / truth["speed"] - 1,
        "azimuth_error_deg": found["wind.azimuth"] - truth["azimuth"],
        "material.E_error": found["material.E"] / truth["E"] - 1,
        "rms_px": float(torch.cat([b.values[0] for b in blocks]).square().sum(-1).mean().sqrt()),
        "points": fit.simulation.scene.points.count,
        "until_s": plan.until,
        "known": changed,
        "processor_s": time.process_time() - begin,
    }


def _true_tracks(fit: Fit, motion: Path) -> list[Evidence]:
    """Where the cameras would see places on the true cloth, hidden ones too."""
    cloth, scene = read_motion(motion), fit.simulation.scene
    rest = scene.model.means.detach()[scene.moving].cpu()
    low, high = rest.amin(0), rest.amax(0)
    flat = ((rest - low) / (high - low).clamp(min=1e-9))[:, [0, 2]]
    axes = [(torch.arange(count) + 0.5) / count for count in ALONG]
    index = torch.cdist(torch.cartesian_prod(*axes), flat).argmin(1)
    chosen = rest[index].double()
    # the cloth at rest is flat but for its ripple: its places are shares of width and height
    size = torch.tensor([cloth.settings["width"], cloth.settings["height"]], dtype=torch.float64)
    motion = torch.from_numpy(cloth.sample((chosen[:, [0, 2]] / size).numpy()))
    moved = (chosen + (motion - motion[:1])).float()
    found: list[Evidence] = []
    for video in fit.videos:
        frames = range(len(video.times))
        position = torch.stack([project(moved[k], video.cameras[k])[0].double() for k in frames])
        seen = torch.ones(len(frames), len(index), dtype=torch.bool)
        found.append(TrackEvidence(fit.simulation, video, Tracks(index, position, seen)))
    return found
