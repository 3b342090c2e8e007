"""The paper's scenes and those of docs/wind.md: ``bench.py gallery`` runs them, checks motion, and makes pictures."""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from bench.case import FRAMES, MORE, PICTURES, Case, Measurement, names, option
from bench.record import ROOT, Row
from bench.simulate import simulate

CONFIGS = ROOT / "configs" / "sim"

SCENES = {
    "ficus": "Ficus",
    "leaves": "Leaves",
    "sand": "Sand",
    "telephone": "Telephone",
    "alocasia": "Alocasia",
    "vase": "Vase",
    "flag1": "Flag, pattern 1",
    "flag2": "Flag, pattern 2",
    "flag3": "Flag, pattern 3",
    "solid_surface_wind": "Solid, wind on its surface",
    "solid_all_wind": "Solid, wind on all Gaussians",
    "sand_to_foam": "Sand turned into white foam",
    "flag_behind_pole": "Flag behind a pole",
    "plant_row": "Row of plants in a boundary layer",
    "ficus_behind_wall": "Ficus behind a wall",
    "flag1_pole": "Flag, pattern 1, and its pole",
    "cloth_over_ball": "Cloth over a ball",
    "ball_on_cloth": "Ball dropped on a cloth",
    "two_flags": "Two flags",
    "leaves_contact": "Leaves that touch",
    "ficus_apart": "Ficus, half as many cells, parts apart",
    "alocasia_apart": "Alocasia, half as many cells, parts apart",
    "leaves_apart": "Leaves, half as many cells, parts apart",
}
"""Name of the file in configs/sim, without suffix, and title."""

_BASES = {
    "solid_all_wind": "solid_surface_wind",
    "sand_to_foam": "sand",
    "flag1_pole": "flag1",
    "leaves_contact": "leaves",
    "ficus_apart": "ficus",
    "alocasia_apart": "alocasia",
    "leaves_apart": "leaves",
}
"""Files in configs/sim/variants, and the scenes that they vary."""

_SHOWN = (0.0, 0.08, 0.2, 0.45, 0.9)  # frames of a strip, as shares of the run
_STRIP_WIDTH = 360  # of one picture [pixels]
LEAST, MOST = 0.01, 0.5  # mean displacement of the surface, as a share of the object's size


def arguments(name: str, preset: str | None) -> list[str]:
    """Command line of tools/sim.py for a scene."""
    base = _BASES.get(name, name)
    files = [CONFIGS / f"{base}.yaml"]
    if preset and (overlay := CONFIGS / preset / f"{base}.yaml").exists():
        files.append(overlay)
    if name in _BASES:
        files.append(CONFIGS / "variants" / f"{name}.yaml")
    return [part for file in files for part in ("--config", str(file))]


def fingerprint(name: str, preset: str | None) -> str:
    """A few letters that change when a value in a configuration of a scene does; comments and modules do not count."""
    files = [Path(part) for part in arguments(name, preset) if part != "--config"]
    values = [_without_modules(yaml.safe_load(file.read_text())) for file in files]
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:12]


def _without_modules(value: Any) -> Any:
    """A configuration whose classes are named without their modules."""
    if isinstance(value, dict):
        return {k: v.split(".")[-1] if k == "class_path" else _without_modules(v) for k, v in value.items()}
    return [_without_modules(v) for v in value] if isinstance(value, list) else value


def strip(folders: Sequence[Path], target: Path) -> None:
    """Make a picture of five frames side by side, with a row for each folder of frames."""
    import numpy as np
    import torch
    from einops import rearrange
    from imageio.v3 import imread, imwrite

    rows = []
    for folder in folders:
        files, pictures = sorted(folder.glob("*.png")), []
        for share in _SHOWN:
            pixels = torch.from_numpy(imread(files[min(round(share * len(files)), len(files) - 1)])).float()
            height = round(pixels.shape[0] * _STRIP_WIDTH / pixels.shape[1])
            size = (height, _STRIP_WIDTH)
            small = torch.nn.functional.interpolate(rearrange(pixels, "h w c -> 1 c h w"), size, mode="area")
            pictures.append(rearrange(small, "1 c h w -> h w c").round().to(torch.uint8).numpy())
        rows.append(np.concatenate(pictures, axis=1))
    target.parent.mkdir(parents=True, exist_ok=True)
    imwrite(target, np.concatenate(rows))


def run_scene(name: str, options: argparse.Namespace) -> Row:
    """Run a scene as a user would, and return its summary."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        preset = preset_of(options)
        asked = [*arguments(name, preset), "--recorder.video=false", *options.more.split()]
        summary = simulate(asked, output, options.device, options.frames)
        if "failed" in summary:
            return summary
        summary.pop("per_frame")
        folders = [folder for folder in (output / "frames", output / "wind") if folder.is_dir()]
        strip(folders, Path(options.pictures) / f"gallery_{name}.png")
    moved = summary["displacement_mean_max_m"]
    share = None if moved is None else moved / summary["size_m"]
    noted = {"preset": preset, "configuration": fingerprint(name, preset)}
    return summary | noted | {"displacement_share": share}


def preset_of(options: argparse.Namespace) -> str | None:
    """The preset that is asked for, or the default of the device; None for ``none``."""
    if options.preset == "none":
        return None
    return options.preset or ("preview" if options.device == "cpu" else None)


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """Each scene."""
    yield from ((("scenes", name), partial(run_scene, name, options)) for name in options.scenes)


def whole(row: Row) -> bool:
    """Whether a run kept all its particles, computed all its frames, and moved neither too little nor too far."""
    share = row.get("displacement_share")
    complete = row.get("status") == "complete" and row["frames"] >= row["frames_wanted"] and not row["lost_particles"]
    return bool(complete and share is not None and LEAST <= share <= MOST)


def of_today(name: str, row: Row) -> bool:
    """Whether a run was recorded with the present configuration files."""
    return bool(row.get("configuration") == fingerprint(name, row.get("preset")))


PRESET = option("--preset", "folder of overlays below configs/sim, or none; `preview` by default on a CPU")
CASE = Case(
    "Run the paper's scenes and make pictures of them.",
    rows,
    (names("--scenes", SCENES), PRESET, FRAMES, PICTURES, MORE),
)
