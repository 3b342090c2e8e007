"""Trained flags: options of their training, and how far their normals are tilted."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from bench.record import ROOT, Row
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.surface_normals import neighbour_normals
from gaussian_swaying.metrics.patch_normals import patch_normal_error

SIZES = (0.1, 0.2, 0.4)
"""Sides of the patches [m]."""

NORMALS = {"smallest_axis": "of the smallest axes", "neighbours": "of neighbouring centres"}


def two_views(
    fade: int = 0, every: int = 1, samples: int = 102_400, contrast: float = 0.01, weight: float = 1.0
) -> tuple[str, ...]:
    """Options of tools/train.py for the two-view losses in the second half of a training run, for :func:`filled`.

    Args:
        fade: Images at the end over which the losses fade to nothing.
        every: They are computed for one image in so many.
        samples: Pixels and patches of an image.
        contrast: Least standard deviation of a patch that counts.
        weight: Factor of the weights in configs/train/surface.yaml.
    """
    options = [f"--config={ROOT}/configs/train/surface.yaml"]
    for name, usual in (("geometric", 0.03), ("photometric", 0.15)):
        term = f"--model.loss_terms.{name}.init_args"
        options += [f"{term}.start={{half}}", f"{term}.every={every}", f"{term}.samples={samples}"]
        options += [f"{term}.stop={{steps}}", f"{term}.fade={fade}"] if fade else []
        options += [f"--model.loss_weights.{name}={weight * usual:g}"]
    return (*options, f"--model.loss_terms.photometric.init_args.contrast={contrast:g}")


GENTLE = two_views(fade=1500, every=2, contrast=0.03)
"""Cheaper and gentler than configs/train/surface.yaml."""


def filled(options: Iterable[str], steps: int) -> list[str]:
    """Options with ``{steps}`` and ``{half}`` replaced by the images of the training run, and half of them."""
    return [option.replace("{steps}", str(steps)).replace("{half}", str(steps // 2)) for option in options]


def train_command(photos: Path, options: Iterable[str], steps: int, target: Path, seed: int | None = None) -> list[str]:
    """Command line of tools/train.py for the splat of a flag."""
    command = [sys.executable, str(ROOT / "tools" / "train.py"), "fit"]
    command += [f"--config={ROOT}/configs/train/default.yaml", f"--config={ROOT}/configs/bench/train.yaml"]
    command += [f"--trainer.max_steps={steps}", f"--trainer.val_check_interval={steps}"]
    command += [f"--checkpoint.every_n_train_steps={steps}", "--trainer.enable_progress_bar=false"]
    command += [] if seed is None else [f"--model.seed={seed}", f"--data.init_args.seed={seed}"]
    command += [f"--data.init_args.path={photos}", f"--trainer.default_root_dir={target}"]
    return [*command, *filled(options, steps)]


def last_psnr(run: Path) -> float | None:
    """PSNR of the held-out views at the end of a training run [dB]; None if it was not measured."""
    path = run / "csv" / "metrics.csv"
    if not path.exists():
        return None
    with path.open(newline="") as text:
        found = [row["val/psnr"] for row in csv.DictReader(text) if row.get("val/psnr")]
    return float(found[-1]) if found else None


def tilts(splat: Path, cloth: Path) -> Row:
    """How far the normals of a trained flag are tilted [degrees], by size of the patch and by where they come from."""
    cloud = read_gaussians(splat)
    cloud = cloud.select((torch.sigmoid(cloud.opacities) >= 0.1).nonzero()[:, 0])
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
    with np.load(cloth) as reference:
        vertices = torch.from_numpy(reference["positions"][0].astype(np.float64))
        normals = torch.from_numpy(reference["rest_normals"].astype(np.float64))
    distance, index = nearest_neighbours(vertices, 1, model.means.double())
    near = (distance[:, 0] < 0.05).nonzero()[:, 0]
    model = GaussianSurfaceModel.from_cloud(cloud.select(near), requires_grad=False)
    true, area = normals[index[near, 0]], model.areas()
    height = ((model.means.double() - vertices[index[near, 0]]) * true).sum(-1)
    own = model.normals()
    weight = model.opacity() * patch_area(model.scales)
    found = {"smallest_axis": own, "neighbours": neighbour_normals(model.means, own, weight)}
    row: Row = {"gaussians": len(model.means), "height_rms_mm": 1e3 * float(height.square().mean().sqrt())}
    for name, normal in found.items():
        cosine = (normal.double() * true).sum(-1).abs().clamp(max=1.0)
        row[name] = {"median_deg": float(torch.rad2deg(cosine.acos()).median())}
        for size in SIZES:
            parts = model.means.double(), normal.double(), true, size, area.double()
            row[name][f"tilt_{round(100 * size)}cm_deg"] = patch_normal_error(*parts)
    return row
