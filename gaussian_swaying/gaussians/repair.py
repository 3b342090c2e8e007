"""What becomes of Gaussians that cannot be drawn, wherever they come from: the one rule of readers and writers."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.origin import origin_of

FARTHEST = 1e12
"""Largest coordinate and size [scene units]: its square is finite in float32, and a grid can count its cells."""
OPAQUE_LOGIT = 16.0  # of an opacity of 1: its sigmoid is 1 - 1.1e-7, the largest opacity below 1 in float32
FLAT = math.log(1e-3)
"""Logarithm of the thickness of a flat Gaussian, as a share of its largest size."""
_ZERO = -43.0  # logarithm of a size whose square is zero in float32
_MOST = 0.25  # share of the Gaussians that may be left out
_FEW = 10  # Gaussians whose units nobody can doubt
_SAMPLE = 1 << 17  # centres that are looked at


def faults(cloud: GaussianCloud) -> dict[str, Tensor]:
    """Properties with meaningless values, each with a mask (N,) of the Gaussians concerned."""
    turn, size = cloud.quats.square().sum(-1), cloud.scales.amax(-1)
    found = {
        f"`x`, `y` or `z` is NaN, infinite or beyond ±{FARTHEST:g}": ~(cloud.means.abs() <= FARTHEST).all(-1),
        "the quaternion `rot_0` to `rot_3` is zero, NaN or infinite": ~((turn > 0) & turn.isfinite()),
        "`scale_0`, `scale_1` or `scale_2` is NaN or infinite, or not a logarithm of a size": ~(
            (size > _ZERO) & (size <= math.log(FARTHEST))
        ),
        "`opacity` is NaN": cloud.opacities.isnan(),
        "`f_dc_*` or `f_rest_*` is NaN or infinite": ~cloud.sh.flatten(1).sum(-1).isfinite(),
    }
    if cloud.normals is not None:
        found["`nx`, `ny` or `nz` is NaN or infinite"] = ~cloud.normals.isfinite().all(-1)
    return found


def repaired(
    path: Path, cloud: GaussianCloud, most: float = _MOST, others: dict[str, Tensor] | None = None
) -> GaussianCloud:
    """Remove Gaussians with meaningless values.

    A size of zero becomes a thousandth of the largest one of its Gaussian. An infinite logit of the opacity becomes
    ±16.

    Raises:
        ValueError: If more have none.

    Warns:
        UserWarning: If Gaussians were left out or were flat.
    """
    found, count, told = (others or {}) | faults(cloud), len(cloud), []
    gone = torch.stack([*found.values()]).any(0)
    left_out = int(gone.sum())
    if left_out:
        kinds, seen = list[str](), torch.zeros_like(gone)
        for why, where in found.items():
            own = (where & ~seen).nonzero()[:, 0]
            if len(own):
                kinds.append(f"{why} for {len(own):,}, first at index {int(own[0])}")
            seen |= where
        what = ", ".join(kinds)
        told.append(f"left out {left_out:,} of {count:,} Gaussians: {what}")
        if left_out > most * count or left_out == count:
            raise ValueError(f"{path}: {left_out:,} of {count:,} Gaussians mean nothing: {what}; make the scene again.")
        cloud = cloud.select(~gone)
    flat = cloud.scales < _ZERO
    if bool(flat.any()):
        thin = cloud.scales.amax(-1, keepdim=True) + FLAT
        cloud = replace(cloud, scales=torch.where(flat, thin, cloud.scales))
        told.append(f"{int(flat.any(-1).sum()):,} of {count:,} Gaussians have a size of zero, and become flat")
    if told:
        warnings.warn(f"{path}: {'; '.join(told)}.", UserWarning, stacklevel=4)
    infinite = cloud.opacities.isinf()
    if bool(infinite.any()):
        finite = torch.where(infinite, cloud.opacities.clamp(-OPAQUE_LOGIT, OPAQUE_LOGIT), cloud.opacities)
        cloud = replace(cloud, opacities=finite)
    return cloud


def check_units(path: Path, cloud: GaussianCloud) -> None:
    """Warn of numbers no scene has, as in a file without logarithms or logits; ValueError if all are impossible."""
    wide, told = cloud.scales.amax(-1), list[str]()
    if len(cloud) < _FEW:
        return
    if bool(wide.amin() >= 0):
        low, high = np.quantile(cloud.means.numpy()[:: -(-len(cloud) // _SAMPLE)], (0.05, 0.95), axis=0)
        extent, least = float((high - low).max()), math.exp(float(wide.amin()))
        told.append(
            f"the smallest size of a Gaussian is {least:.3g}, while the centres lie within {extent:.3g}: `scale_0` to "
            "`scale_2` should be the logarithm of the size"
        )
        if least > extent > 0:
            raise ValueError(f"{path}: {told[0]}.")
        if float(wide.amax()) > 1 and math.exp(float(wide.median())) * len(cloud) ** (1 / 3) < 3 * extent:
            told.clear()
    low, high = torch.aminmax(cloud.opacities)
    if low >= 0 and high <= 1:
        told.append(
            f"opacities are {float(low.sigmoid()):.0%} to {float(high.sigmoid()):.0%}: `opacity` should be their logit"
        )
    for what in told:
        warnings.warn(f"{path}: {what}.", UserWarning, stacklevel=4)


def cloud_of(path: Path, others: dict[str, np.ndarray] | None = None, **columns: np.ndarray) -> GaussianCloud:
    """The Gaussians of a file as float32 tensors, :func:`repaired`.

    Args:
        columns: The fields of :class:`GaussianCloud` but its origin, with their shapes and units.
    """
    origin = origin_of(columns["means"])
    step = np.spacing(np.abs(origin).max().astype(np.float32)) if columns["means"].dtype == np.float32 else 0
    with np.errstate(over="ignore", invalid="ignore"):
        if any(origin):
            columns["means"] = columns["means"] - np.array(origin)
        columns = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in columns.items()}
    tensors: dict[str, Any] = {name: torch.from_numpy(value) for name, value in columns.items()}
    further = {what: torch.from_numpy(mask) for what, mask in (others or {}).items()}
    cloud = repaired(path, GaussianCloud(**tensors, origin=origin), others=further)
    if step > math.exp(float(cloud.scales.amax(-1).median())):
        warnings.warn(
            f"{path}: centres so far from zero have steps of {step:.3g} in float32: export them as double.",
            UserWarning,
            stacklevel=3,
        )
    return cloud
