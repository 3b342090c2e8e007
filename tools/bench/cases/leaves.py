"""``bench.py leaves``: how leaves of a plant move against each other, on shared nodes and on nodes of their own."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from bench.case import Case, Measurement, numbers, option
from bench.record import Row
from gaussian_swaying.gaussians.connectivity import attached_pairs
from gaussian_swaying.simulation.simulation import Simulation

SEEDS, TURNS = 9000, 20
CONNECTED = ("grid", "surface")


def neighbours(simulation: Simulation, least: float, most: float) -> Tensor:
    """Pairs of Gaussians on leaves that lie beside each other, as places in ``scene.moving``, shape (K, 2).

    Of each of an even sample of the moving Gaussians, those of a part named leaf if there is one, the nearest one that
    is nearer than ``most`` in space and farther than ``least`` along the surface [longest sides].
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    scene = simulation.scene
    moving = scene.moving.cpu()
    place, size = scene.model.means.detach().cpu().double()[moving], scene.size
    opaque = torch.isin(moving, scene.simulated.cpu())
    leaf = opaque.clone()
    if scene.parts is not None and "leaf" in [part.name for part in scene.parts.parts]:
        leaf &= scene.parts.mask("leaf")[moving]
    own = opaque.nonzero()[:, 0]
    pairs = own[attached_pairs(place[own], scene.rest_normals.cpu().double()[moving][own])]
    way = (place[pairs[:, 0]] - place[pairs[:, 1]]).norm(dim=-1).numpy()
    graph = coo_matrix((way, pairs.T.numpy()), (len(place), len(place))).tocsr()
    some = leaf.nonzero()[:, 0]
    some = some[:: max(1, len(some) // SEEDS)]
    found = []
    for part in some.split(100):
        along = torch.from_numpy(dijkstra(graph, directed=False, indices=part.numpy(), limit=2 * least * size))
        across = torch.cdist(place[part], place).where((along > least * size) & leaf, torch.inf)
        near, other = across.min(1)
        beside = near < most * size
        found.append(torch.stack([part[beside], other[beside]], 1))
    return torch.cat(found)


def _of(config: Path, connected: str, cells: int | None, device: str) -> Simulation:
    settings: dict[str, Any] = yaml.safe_load(config.read_text())
    settings["solver"]["formulation"] = "total"  # which the finest grid needs; a starter has modes
    settings["scene"]["connected"] = connected
    for name in ("ply", "parts"):
        if settings["scene"].get(name):
            settings["scene"][name] = str((config.parent / settings["scene"][name]).resolve())
    if cells is not None:
        settings["solver"]["dx"] = settings["scene"]["longest_side"] / cells
    with tempfile.TemporaryDirectory() as folder:
        changed = Path(folder) / "changed.yaml"
        changed.write_text(yaml.safe_dump(settings, sort_keys=False))
        return Simulation.from_yaml(changed, device=device)


def motion(config: Path, connected: str, cells: int, frames: int, device: str, far: float, near: float) -> Row:
    """How far neighbouring leaves move against each other in some frames, and what a substep takes.

    Lengths are shares of the longest side: root mean squares over frames and pairs.
    """
    simulation = _of(config, connected, cells, device)
    scene = simulation.scene
    pairs = neighbours(simulation, far, near).to(scene.moving.device)
    state = simulation.start()
    relative, own = [], []
    for _ in range(frames):
        state, _frame = simulation.advance(state)
        moved = scene.frame.displacement_to_scene(scene.follow.motion(state)[0]) / scene.size
        relative.append((moved[pairs[:, 0]] - moved[pairs[:, 1]]).square().sum(-1).mean())
        own.append(moved[pairs[:, 0]].square().sum(-1).mean())
    return {
        "pairs": len(pairs),
        "points": scene.points.count,
        "nodes": int((simulation.solver.bound.node_inverse_mass > 0).sum()),  # type: ignore[attr-defined]
        "relative": float(torch.stack(relative).mean().sqrt()),
        "motion": float(torch.stack(own).mean().sqrt()),
    }


def cost(config: Path, cells: int, device: str) -> Row:
    """Time of a substep on shared nodes and on nodes of their own, in the fastest of some frames, in turns."""
    runs = {connected: _of(config, connected, cells, device) for connected in CONNECTED}
    states = {connected: run.advance(run.start())[0] for connected, run in runs.items()}  # makes the kernels
    least = dict.fromkeys(CONNECTED, float("inf"))
    for _ in range(TURNS):
        for connected, run in runs.items():
            start = time.perf_counter()
            states[connected], frame = run.advance(states[connected])
            float(states[connected].position.sum())
            least[connected] = min(least[connected], (time.perf_counter() - start) / frame.substeps)
    return {f"{connected}_ms": 1e3 * seconds for connected, seconds in least.items()} | {
        "cost": least["surface"] / least["grid"]
    }


def whole(config: Path, connected: str, cells: int, device: str) -> Row:
    """Seconds of the whole run with its pictures."""
    simulation = _of(config, connected, cells, device)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        simulation.run(Path(folder) / "out", progress=False)
        return {"seconds": time.perf_counter() - start, "simulated_s": simulation.frames_wanted * simulation.frame_dt}


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The motion on each grid, on the finest one with shared nodes only; the time of substeps, and of a whole run."""
    grids = sorted(options.cells)
    for cells in grids:
        for connected in CONNECTED[: 1 if cells == grids[-1] else 2]:
            place = {"cells": cells, "connected": connected}
            given = connected, cells, options.frames, options.device, options.far, options.near
            work = partial(motion, options.config, *given)
            yield ("rows", place), work
    for cells in grids[:-1]:
        yield ("costs", {"cells": cells}), partial(cost, options.config, cells, options.device)
    for connected in CONNECTED:
        place = {"cells": grids[0], "connected": connected}
        yield ("runs", place), partial(whole, options.config, connected, grids[0], options.device)


CASE = Case(
    "Measure how leaves of a plant move against each other, on shared nodes and on nodes of their own.",
    rows,
    (
        option("--config", "a plant, with `scene.longest_side`", type=Path, required=True),
        numbers("--cells", "cells along the longest side", default="24,48,96"),
        option("--near", "neighbours are nearer in space [longest sides]", type=float, default=1 / 24),
        option("--far", "and farther along the surface [longest sides]", type=float, default=0.18),
        option("--frames", "frames of each motion", type=int, default=40),
    ),
    page="validation.md",
)
