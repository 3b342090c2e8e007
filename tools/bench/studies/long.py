"""An hour of a flag and of a plant in gusts: does anything grow or drift? Pictures are kept in ``outputs/long``."""

from __future__ import annotations

import time

import torch

from bench.runner import ROOT, Row, study
from gaussian_swaying import Simulation, suggest
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.scenes import DemoScene

FOLDER = ROOT / "outputs" / "long"
PARTS, MINUTES = 6, 60
"""Parts of the time that are compared, and its length."""
FLAG = ["--config=configs/sim/flag.yaml", "--solver.dx=0.1", "--scene.region=Everything", "--device=cpu",
        "--scene.generator.init_args={spacing: 0.025, stand: none}"]  # fmt: skip


def simulation_of(thing: str, damping: float) -> Simulation:
    """The README's flag on half as many cells with a damping [1/s], or the starter of a plant that is made in code."""
    if thing == "flag":
        parser = Simulation.parser()
        return Simulation.from_settings(parser, parser.parse_args([*FLAG, f"--solver.damping={damping}"]))
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_ply(FOLDER / "plant.ply", DemoScene("alocasia", spacing=0.01).generate())
    suggest(FOLDER / "plant.ply", look="gusts", device="cpu").to_yaml(FOLDER / "plant.yaml")
    return Simulation.from_yaml(FOLDER / "plant.yaml", device="cpu")


@study("long", [{"thing": "flag"}, {"thing": "plant"}, {"thing": "flag", "damping": 0.1, "minutes": 10}])
def long(thing: str, minutes: float = MINUTES, damping: float = 0.0) -> Row:
    """Means and extremes of each part of the time: energy [J], stretch, and where the middle is [m]."""
    simulation = simulation_of(thing, damping)
    begin, count, rows = time.perf_counter(), round(60 * minutes / simulation.frame_dt), []
    FOLDER.mkdir(parents=True, exist_ok=True)
    for frame in simulation.frames(count):
        health = frame.health
        rows.append([health.kinetic, health.elastic, health.stretch_max, *frame.state.position.mean(-2).tolist()])
        if frame.index in (count // PARTS, count - 1):
            frame.save(FOLDER / f"{thing}_{frame.time / 60:.0f}_minutes.png")
    parts = torch.tensor(rows, dtype=torch.float64)[: count // PARTS * PARTS].reshape(PARTS, -1, 6)
    mean, most = parts.mean(1), parts.amax(1)
    numbers = {
        "kinetic_J": mean[:, 0],
        "kinetic_most_J": most[:, 0],
        "elastic_J": mean[:, 1],
        "stretch_most": most[:, 2],
    }
    numbers |= {"middle_m": mean[:, 3:]}
    seconds = time.perf_counter() - begin
    return {name: value.tolist() for name, value in numbers.items()} | {"seconds": seconds, "frames": count}
