"""Does the error of a certificate hold? Flags that Blender's cloth moves, soft posts that Newton moves.

The distance to them has the error of both solvers and the difference of their models. Needs ``bpy``, ``newton`` and
``warp-lang``; a motion that is made is kept in ``outputs/coverage``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from bench.runner import ROOT, Row, study
from gaussian_swaying import AeroForce, Box, Material, MPMSolver, PinnedRegion, Recorder, Scene, Simulation
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.mpm.laws.elastic import NeoHookean, SpringNetwork
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.certificate import Certificate

sys.path.append(str(ROOT / "tools" / "datasets"))
from blender_cloth import SPRING_TIME
from flag_motion import read_cloth, solve_pattern
from flag_reference import FlagPattern, least_quality
from soft_case import SoftPattern, moved_places, read_soft, solve_soft, splat

MOTIONS = ROOT / "outputs" / "coverage"
FLAGS = [
    {"held": held, "E": E, "flow": flow}
    for held in ("top", "left")
    for E in (3e3, 8e3, 2e4)
    for flow in ([0.6, 1.4, 0.0], [0.8, -1.8, 0.0], [1.5, 1.0, 0.0], [2.5, 1.0, 0.0])
]
POSTS = [{"held": "foot", "E": E, "flow": flow} for E in (1.5e4, 3e4) for flow in
         ([3.0, 1.0, 0.0], [4.4, 2.6, 0.0], [5.5, -1.0, 0.0], [2.0, 3.0, 0.0])]  # fmt: skip
WIDE, HIGH, SPACING, FRAMES = 0.6, 0.4, 0.005, 38  # m


def _between(lines: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line below each place, and how far it is to the next one, 0 to 1."""
    below = np.clip(np.searchsorted(lines, at, side="right") - 1, 0, len(lines) - 2)
    return below, ((at - lines[below]) / (lines[below + 1] - lines[below]))[:, None]


def flag(held: str, E: float, flow: list[float]) -> tuple[Simulation, np.ndarray]:
    """A flag of 24 cells by ours, and where its Gaussians are by Blender's cloth (frames, N, 3) [m]."""
    pattern = FlagPattern(E, 0.3, 20.0, tuple(flow), held, width=WIDE, height=HIGH, cells=48, frames=FRAMES)  # type: ignore[arg-type]
    pattern = replace(pattern, quality=least_quality(pattern))
    path = MOTIONS / f"flag_{held}_{E:g}_{'_'.join(map(str, flow))}.npz"
    solve_pattern(pattern, path)
    low = [None, None, HIGH - SPACING] if held == "top" else [None, None, None]
    region = Box(low, [None if held == "top" else SPACING, None, None])  # a row of points, Blender's of vertices
    sheet = FlagScene(WIDE, HIGH, spacing=SPACING, ripple=0.0)
    simulation = Simulation(
        Scene(generator=sheet, area="coverage", layers=3),
        Material(E=E, density=20.0, thickness=0.01, law=SpringNetwork()),
        solver=MPMSolver(
            0.025, damping=pattern.damping, stiffness_damping=SPRING_TIME, boundaries=[PinnedRegion(region)]
        ),
        wind=flow,
        aero=AeroForce(C_D=pattern.drag, C_F=0.0, C_L=0.0, law="linear"),
        frame_dt=1 / pattern.fps,
        device="cpu",
    )
    rest = simulation.scene.model.means.double().numpy()
    cloth = read_cloth(path)
    mesh = cloth.positions.reshape(FRAMES, cloth.columns + 1, cloth.rows + 1, 3)
    (i, u), (j, v) = (
        _between(lines, at)
        for lines, at in (
            (cloth.uv[:: cloth.rows + 1, 0], rest[:, 0] / WIDE),
            (cloth.uv[: cloth.rows + 1, 1], rest[:, 2] / HIGH),
        )
    )
    lower, upper = ((1 - u) * mesh[:, i, k] + u * mesh[:, i + 1, k] for k in (j, j + 1))
    return simulation, (1 - v) * lower + v * upper


def post(held: str, E: float, flow: list[float]) -> tuple[Simulation, np.ndarray]:
    """A soft post, three cells across, by ours and by Newton."""
    pattern = SoftPattern(tuple(flow), E, frames=FRAMES, cells=6)  # type: ignore[arg-type]
    path = MOTIONS / f"post_{E:g}_{'_'.join(map(str, flow))}.npz"
    solve_soft(pattern, path)
    foot = Box([None] * 3, [None, None, pattern.held])
    simulation = Simulation(
        Scene(generator=GivenScene(splat(pattern, 0.006)), area="coverage", filling=InteriorFilling(spacing=0.006)),
        Material(E=E, nu=0.3, density=pattern.density, law=NeoHookean()),
        solver=MPMSolver(0.02, damping=pattern.damping, boundaries=[PinnedRegion(foot)]),
        wind=flow,
        aero=AeroForce(C_D=pattern.drag, C_F=0.0, C_L=0.0, law="projected"),
        frame_dt=1 / pattern.fps,
        device="cpu",
    )
    return simulation, moved_places(pattern, read_soft(path)[0], simulation.scene.model.means.double().numpy())


@study("coverage", [*FLAGS, *POSTS])
def coverage(held: str, E: float, flow: list[float]) -> Row:
    """The share of frames before the time of chaos in which the true distance is inside the error."""
    simulation, true = (post if held == "foot" else flag)(held, E, flow)
    quiet = Recorder(trajectory=False, nodes=False, checkpoint_every=0, renders=())
    with TemporaryDirectory() as name:
        summary = simulation.run(Path(name) / "run", FRAMES, progress=False, recorder=quiet, certify=True)
    found = summary["certificate"]
    if "error_m" not in found:
        return {"failed": found["sentence"]}
    certificate = Certificate(simulation, FRAMES)
    true = true[:, certificate.index.numpy()] - certificate.rest.double().numpy()
    rows = [frame.gaussians.means[certificate.index].double() - certificate.rest for frame in simulation.frames(FRAMES)]
    apart = (torch.stack(rows) - torch.from_numpy(true)).square().sum(-1).mean(-1).sqrt()
    frames = FRAMES if found["chaos_s"] is None else round(found["chaos_s"] / simulation.frame_dt)
    error = torch.tensor(found["error_m"], dtype=torch.float64)
    within = (apart <= error)[1:frames].double()
    numbers = {"frames": len(within), "covered": float(within.mean()), "true_m": float(apart[1:frames].mean())}
    numbers |= {"error_m": float(error[1:frames].mean())}
    numbers |= {name: found[name] for name in ("chaos_s", "trusted_s", "size_m", "cost")}
    each = {"each_true_mm": apart, "each_error_mm": error}
    return numbers | {name: (1e3 * row).round(decimals=3).tolist() for name, row in each.items()}
