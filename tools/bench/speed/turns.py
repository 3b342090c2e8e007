"""Compare the speed of two checkouts on one machine, turn by turn.

    python tools/bench/speed/turns.py OLD NEW [--runs 5] [--cases flag,sand] [--device cpu]

Each run is a process of its own that imports the package of its checkout: OLD, NEW, OLD, NEW, ... after one run of each
that is not counted, which fills the kernel caches. Prints medians and ratios NEW / OLD, below 1 where NEW is quicker.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

FRAMES = {"flag": 20, "captured": 20, "sheet": 20, "sand": 3}
"""Timed frames of each case."""

NUMBERS = {"start_s": "start [s]", "frame_ms": "frame [ms]", "picture_ms": "picture [ms]"}


def captured() -> Any:
    """Uneven Gaussians with noisy normals on a body with a long neck, as a capture of a guitar has them."""
    from gaussian_swaying import GaussianCloud

    seed = torch.Generator().manual_seed(0)
    lobes = ((0.0, 0.2, 9000), (0.28, 0.14, 5000), (0.75, 0.3, 4000))  # height [m], half a width [m], Gaussians
    means, normals = [], []
    for height, half, count in lobes:
        size = torch.tensor([half, 0.05, half] if height < 0.5 else [0.03, 0.02, half])
        sphere = torch.nn.functional.normalize(torch.randn(count, 3, generator=seed), dim=-1)
        means.append(sphere * size + torch.tensor([0.0, 0.0, height]) + 0.002 * torch.randn(count, 3, generator=seed))
        normals.append(torch.nn.functional.normalize(sphere / size + torch.randn(count, 3, generator=seed), dim=-1))
    mean, normal = torch.cat(means), torch.cat(normals)
    half_way = torch.cat([1.0 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], torch.zeros(len(mean), 1)], dim=-1)
    scales = torch.tensor([0.008, 0.006, 0.0008]) * torch.exp(0.4 * torch.randn(len(mean), 3, generator=seed))
    opacity = 3.0 * torch.randn(len(mean), generator=seed) + 2.0
    colour = 0.3 * torch.randn(len(mean), 16, 3, generator=seed)
    return GaussianCloud(mean, half_way, scales.log(), opacity, colour)


def simulation(case: str, device: str) -> Any:
    """The simulation of a case."""
    from gaussian_swaying import (
        Box,
        GaussianGust,
        Material,
        MPMSolver,
        PinnedRegion,
        Scene,
        Simulation,
        SineSway,
        WindField,
    )  # fmt: skip
    from gaussian_swaying.scenes import FlagScene

    if case == "sand":
        return Simulation.from_yaml("configs/sim/sand.yaml", device=device)
    if case == "captured":
        top = Box([None, None, 0.95], [None, None, None])
        return Simulation(captured(), Material(E=1e5, density=200.0), hold=top, wind=[6, 3, 0], device=device)
    pole = Box([None, None, None], [0.03, None, None])
    if case == "sheet":
        cloth = Material(E=3e3, density=30.0)
        return Simulation(FlagScene(spacing=0.007), cloth, hold=pole, wind=[4, 2, 0], device=device)
    return Simulation(
        Scene(generator=FlagScene(spacing=0.016), metres_per_unit=1.0),
        Material(E=5e4, density=30.0),
        solver=MPMSolver(dx=0.032, boundaries=[PinnedRegion(pole)]),
        wind=WindField([6.0, 1.5, 0.0], modulations=[SineSway(0.5, 1.5), GaussianGust(0.3)]),
        device=device,
    )


def measure(case: str, device: str) -> dict[str, float]:
    """Seconds until the first frame is there, and milliseconds for each further frame and picture."""
    begin = time.perf_counter()
    frames = iter(simulation(case, device).frames(FRAMES[case] + 1))
    next(frames).state.position.sum().item()
    start = time.perf_counter()
    for frame in frames:
        last = frame
    last.state.position.sum().item()
    end = time.perf_counter()
    last.render().color.sum().item()  # the first one compiles
    drawn = time.perf_counter()
    last.render().color.sum().item()
    took = time.perf_counter() - drawn
    return {"start_s": start - begin, "frame_ms": 1e3 * (end - start) / FRAMES[case], "picture_ms": 1e3 * took}


def run(checkout: Path, case: str, device: str) -> dict[str, float]:
    """The numbers of one process that imports the package of a checkout."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "GOMP_SPINCOUNT": "3000"}
    words = [sys.executable, str(Path(__file__).resolve()), "--measure", case, "--device", device]
    done = subprocess.run(words, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    row: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return row


def main() -> None:
    """Measure one case in this process, or two checkouts in turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="*", type=Path, metavar="CHECKOUT")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--cases", default=",".join(FRAMES))
    parser.add_argument("--device", default="cpu,cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--measure", choices=list(FRAMES), help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.measure:
        print(json.dumps(measure(words.measure, words.device)))
        return
    if len(words.checkouts) != 2:
        parser.error("Expected two checkouts.")
    old, new = (path.resolve() for path in words.checkouts)
    print(f"{'':24}{'old':>10}{'new':>10}{'new / old':>12}")
    for device in words.device.split(","):
        for case in words.cases.split(","):
            rows: dict[Path, list[dict[str, float]]] = {old: [], new: []}
            try:
                for _ in range(words.runs + 1):
                    for checkout, measured in rows.items():
                        measured.append(run(checkout, case, device))
            except subprocess.CalledProcessError:
                print(f"{device:5}{case:9} failed, see above")
                continue
            for name, label in NUMBERS.items():
                before, after = (statistics.median(row[name] for row in rows[path][1:]) for path in (old, new))
                print(f"{device:5}{case:9}{label:>10}{before:10.3g}{after:10.3g}{after / before:12.3f}", flush=True)


if __name__ == "__main__":
    main()
