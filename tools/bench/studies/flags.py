r"""Flags beside the motions of Blender's cloth: ways to simulate them, and finer grids.

``python tools/datasets/make_flag_dataset.py`` makes the motions and photos in ``outputs/flags``. Splats are trained by

    python tools/train.py fit --config configs/train/default.yaml --config configs/bench/train.yaml \
        --data.init_args.path outputs/flags/pattern1/train --trainer.default_root_dir outputs/flags/pattern1/trained

and so on; those that compare ``two_views`` also with ``--config configs/train/surface.yaml --config
configs/bench/two_views.yaml``, and three of flag 2 with ``--seed_everything`` 0, 1 (``two_views_1``) and 2.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from bench.runner import ROOT, Row, study
from gaussian_swaying.evaluation.compare import compare_run
from gaussian_swaying.simulation.simulation import Simulation

DATA = ROOT / "outputs" / "flags"
FLAGS = ("1", "2", "3", "4", "5", "curtain", "light", "pennant")
CHANGES = ("--material.volume=cell", "--scene.layers=1", "--material.law=FixedCorotated", "--scene.area=equal")
WAYS: dict[str, tuple[list[str], list[str], bool]] = {
    "ours": ([], [], False),
    "to_volume": ([], [*CHANGES[:1]], True),
    "to_layer": ([], [*CHANGES[:2]], True),
    "to_law": ([], [*CHANGES[:3]], True),
    "to_area": ([], [*CHANGES], True),
    "to_wind": (["no_normals"], [*CHANGES], True),
    "particle": (["particle"], [], True),
    "own_volumes": (["particle"], [], False),
    "no_surface": (["no_surface"], [], False),
    "no_shading": (["no_shading"], [], False),
    "neighbours": ([], ["--scene.normals=neighbours"], False),
}
"""Files of configs/bench/variants, options, and whether the flag gets the mass of ours."""


def arguments(flag: str, splats: str, way: str) -> list[str]:
    """Options of ``tools/sim.py``; pattern 4 and later hang by their top edge like pattern 3."""
    files, options, _ = WAYS[way]
    base, own = (flag, []) if flag in "123" else ("3", [f"bench/flag{flag}" if flag.isdigit() else f"bench/{flag}"])
    names = [f"sim/flag{base}", f"bench/flag{base}", *own, *(f"bench/variants/{name}" for name in files)]
    words = [word for name in names for word in ("--config", f"configs/{name}.yaml")] + options
    if splats != "made":
        words += [f"--scene.ply={folder(flag) / splats / 'point_cloud.ply'}"]
    if splats.startswith("two_views"):
        words += ["--scene.normals=neighbours"]
    if {"particle", "no_surface", "no_normals"} & set(files):  # friction equals drag
        words += [f"--aero.C_F={0.8 if flag == '2' else 1.28}"]
    return words


def folder(flag: str) -> Path:
    """The reference of a flag."""
    return DATA / (f"pattern{flag}" if flag.isdigit() else flag)


def mass_of(words: list[str]) -> tuple[float, float, float]:
    """Mass, Young's modulus and density of a flag."""
    parser = Simulation.parser()
    settings = parser.parse_args([*words, "--device=cpu"])
    points = Simulation.from_settings(parser, settings).scene.points
    return float(points.mass.sum()), settings.material.E, settings.material.density


def compared(words: list[str], flag: str, device: str, frames: int | None = None) -> Row:
    """Simulate, and compare the surfaces, and the pictures where the reference has all of them."""
    with tempfile.TemporaryDirectory() as name:
        output = Path(name)
        command = [sys.executable, "tools/sim.py", *words, "--device", device, "--output", name]
        command += ["--recorder.video=false", "--recorder.trajectory=true"] + [f"--frames={frames}"] * bool(frames)
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        summary = json.loads((output / "summary.json").read_text())
        found = compare_run(output, folder(flag), frames=frames or summary["frames"], device=device)
    row = {key: summary[key] for key in ("particles", "frames", "substeps", "torn_particles", "stretch_max", "mass_kg")}
    return row | {"chamfer_share": found["chamfer_share"], "psnr_db": found["mean"].get("psnr_db")}


SPLATS = ("made", "trained", "two_views", "two_views_1", "two_views_2")


@study("flags", [{"splats": s, "variant": w, "flag": f} for s in SPLATS for w in WAYS for f in FLAGS])
def flags(splats: str, variant: str, flag: str, device: str) -> Row:
    """One flag in one way."""
    words = arguments(flag, splats, variant)
    if WAYS[variant][2]:
        own, E, density = mass_of(words)
        factor = mass_of(arguments(flag, splats, "ours"))[0] / own
        words += [f"--material.E={factor * E!r}", f"--material.density={factor * density!r}"]
    return compared(words, flag, device)


@study("tilts", [{"splats": s, "normals": n} for s in SPLATS[1:] for n in ("smallest_axis", "neighbours")])
def tilts(splats: str, normals: str) -> Row:
    """Tilt of the normals of flag 2 at rest, averaged over squares of 4 cm, inside and at the edges (rms)."""
    parser = Simulation.parser()
    words = [*arguments("2", splats, "ours"), f"--scene.normals={normals}", "--device=cpu"]
    scene = Simulation.from_settings(parser, parser.parse_args(words)).scene
    place, found = scene.model.means[scene.moving].double(), scene.rest_normals[scene.moving].double()
    with np.load(folder("2") / "cloth.npz") as reference:  # a flat one, 1.2 x 0.8 m
        true = torch.from_numpy(reference["rest_normals"][0]).double()
    own = found * (found @ true).sign()[:, None] * scene.model.areas()[scene.moving].double()[:, None]
    column, row = ((place[:, axis] / 0.04).long().clamp(0, many - 1) for axis, many in ((0, 30), (2, 20)))
    mean = torch.zeros(600, 3, dtype=torch.float64).index_add(0, 20 * column + row, own).view(30, 20, 3)
    tilt = torch.rad2deg((torch.nn.functional.normalize(mean, dim=-1) @ true).clamp(max=1).acos()).square()
    inside = tilt[1:-1, 1:-1]
    edges = (tilt.sum() - inside.sum()) / (tilt.numel() - inside.numel())
    height = (place @ true).square().mean().sqrt()
    return {
        "inside_deg": float(inside.mean().sqrt()),
        "edges_deg": float(edges.sqrt()),
        "height_mm": 1e3 * float(height),
    }
