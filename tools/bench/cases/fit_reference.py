"""``bench.py fit --reference``: how sharp the frames are that a splat predicts without a fit.

It takes the true motion of the cloth, or that of the same cloth solved otherwise, from the folder ``uncertainty`` of a
case. The first says what the splat can show at best, the others how far the reference is from itself. And it is
simulated with the true values, which says what the model can predict at best.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from bench.case import Measurement
from bench.record import ROOT, Row
from gaussian_swaying.fitting.plan import Plan, parse_base, read_unknown
from gaussian_swaying.fitting.report import predictions
from gaussian_swaying.fitting.variants import states_of
from gaussian_swaying.fitting.videos import frame_times, read_videos
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.simulation.simulation import Simulation

OWN = "cloth.npz"
"""The motion that a case shows."""
BESIDE = 0.01
"""Distance on the cloth over which its tangents are taken [m]."""


def rows(options: argparse.Namespace, folders: Sequence[Path]) -> Iterator[Measurement]:
    """A row for each case and motion, and for the options of ``known``."""
    known = json.loads(options.known)
    for folder in folders:
        plan, truth = plan_of(folder, {"aero.law": options.law, **known})
        simulation, videos = simulation_of(plan, options.device), read_videos(str(folder))
        times = frame_times(videos)
        fitted = sum(moment <= truth["fit_until"] + 1e-6 for moment in times)
        files = [] if known else [folder / OWN, *sorted((folder / "uncertainty").glob("*.npz"))]
        motions = {str(path.relative_to(folder).with_suffix("")): moved(simulation, path) for path in files}
        ours = ", ".join(f"`{name.split('.')[-1]}` {value}" for name, value in known.items()) or "as in `scene.yaml`"
        motions[f"simulated {ours}"] = simulated(simulation, truth, times)
        for name, motion in motions.items():
            work = partial(_sharpness, simulation, videos, times, fitted, motion)
            yield ("reference", f"{folder.name}, {name}"), work


def _sharpness(*shown: Any) -> Row:
    begin = time.process_time()
    found = predictions(*shown)
    return {
        "psnr_fitted_db": min(one.fitted for one in found),
        "psnr_predicted_db": min(one.predicted for one in found),
        "processor_s": time.process_time() - begin,
    }


def plan_of(folder: Path, known: Row, until: float | None = None, search: int = 48) -> tuple[Plan, Row]:
    """The plan of a case of ``make_fit_data.py``, with other options of ``sim``, and the truth."""
    truth = json.loads((folder / "truth.json").read_text())
    given = yaml.safe_load((folder / "fit.yaml").read_text())
    sought = [read_unknown(name, entry) for name, entry in given["unknowns"].items()]
    base, data = [str(folder / "scene.yaml")], [str(folder)]
    return Plan(base, data, sought, known=known, until=until or truth["fit_until"], search=search), truth


def simulation_of(plan: Plan, device: str) -> Simulation:
    """The simulation of a plan, without cameras of its own."""
    parser = Simulation.parser()
    settings = parse_base(plan, parser)
    settings.device, settings.camera, settings.cameras = device, None, None
    return Simulation.from_settings(parser, settings)


def simulated(simulation: Simulation, truth: Row, times: Sequence[float]) -> Iterator[DeformedGaussians]:
    """The Gaussians of a simulation with the true values, at each time."""
    for (state,) in states_of(simulation, [true_values(truth)], times, alike=False):
        yield simulation.painter.deformed(state)


def true_values(truth: Row) -> dict[str, float]:
    """What is sought, as ``truth.json`` has it."""
    return {"wind.speed": truth["speed"], "wind.azimuth": truth["azimuth"], "material.E": truth["E"]}


def moved(simulation: Simulation, path: Path) -> Iterator[DeformedGaussians]:
    """The Gaussians of a flat flag, moved as a cloth, in each of its frames."""
    model, cloth = simulation.scene.model, read_motion(path)
    rest = model.means.detach().double().cpu()
    size = torch.tensor([cloth.settings["width"], cloth.settings["height"]], dtype=torch.float64)
    places = rest[:, [0, 2]] / size

    def sampled(shift: tuple[float, float]) -> Tensor:
        return torch.from_numpy(cloth.sample((places + torch.tensor(shift) / size).numpy())).double()

    position = sampled((0.0, 0.0))
    along = (sampled((BESIDE, 0.0)) - sampled((-BESIDE, 0.0))) / (2 * BESIDE)
    upward = (sampled((0.0, BESIDE)) - sampled((0.0, -BESIDE))) / (2 * BESIDE)
    normal = torch.nn.functional.normalize(torch.linalg.cross(along, upward), dim=-1)
    axes = torch.stack([along, normal, upward], -1)
    for frame in range(len(position)):
        gradient = axes[frame] @ torch.linalg.inv(axes[0])
        place = rest + position[frame] - position[0]
        yield model.deformed(place.to(model.means), gradient.to(model.means))


def read_motion(path: Path) -> Any:
    """A motion of ``make_fit_data.py``, see ``flag_motion.Cloth``."""
    sys.path.append(str(ROOT / "tools" / "datasets"))
    from flag_motion import read_cloth

    return read_cloth(path)
