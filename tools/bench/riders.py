"""A capture of a rider on a bicycle, made in code: tubes of flat Gaussians with the noise of a capture."""

from __future__ import annotations

import math
from pathlib import Path

import torch
import yaml

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.rotations import rotation_to_quat

SKIN, COAT, TROUSERS, STEEL, RUBBER = (
    (0.8, 0.6, 0.5),
    (0.7, 0.2, 0.15),
    (0.2, 0.25, 0.4),
    (0.5, 0.55, 0.6),
    (0.1, 0.1, 0.1),
)
FRAME = (
    ((-0.52, 0.34), (-0.15, 0.28)),
    ((-0.52, 0.34), (-0.2, 0.85)),
    ((-0.15, 0.28), (-0.22, 0.92)),
    ((-0.2, 0.85), (0.4, 0.82)),
    ((-0.15, 0.28), (0.38, 0.75)),
    ((0.36, 0.95), (0.52, 0.34)),
)
"""Ends of the tubes of the bicycle, x and z [m]."""
SPOKES = 24
SADDLE = 0.9  # m; what is below is held
NOISE = 0.002  # m, out of the surface


def _tubes() -> list[tuple[tuple[float, ...], tuple[float, ...], float, tuple[float, ...]]]:
    """The parts as tubes with round ends: both ends, radius [m], colour."""
    found = [((a, 0.0, b), (c, 0.0, d), 0.016, STEEL) for (a, b), (c, d) in FRAME]
    for centre in (-0.52, 0.52):
        at = [(centre + 0.32 * math.cos(turn), 0.0, 0.34 + 0.32 * math.sin(turn)) for turn in _turns()]
        found += [(one, other, 0.02, RUBBER) for one, other in zip(at, [*at[1:], at[0]], strict=True)]
    found += [
        ((0.38, -0.27, 0.98), (0.38, 0.27, 0.98), 0.016, STEEL),
        ((-0.2, 0.0, 0.95), (0.16, 0.0, 1.5), 0.17, COAT),
    ]
    found.append(((0.2, 0.0, 1.55), (0.24, 0.0, 1.82), 0.11, SKIN))
    for side, foot in ((-1.0, 0.12), (1.0, 0.42)):
        shoulder, elbow, hand = (0.14, 0.2 * side, 1.45), (0.2, 0.3 * side, 1.15), (0.38, 0.25 * side, 0.98)
        hip, knee, ankle = (-0.18, 0.1 * side, 0.95), (0.2, 0.13 * side, 0.62 + foot / 2), (-0.05, 0.12 * side, foot)
        found += [(shoulder, elbow, 0.06, COAT), (elbow, hand, 0.045, COAT)]
        found += [(hip, knee, 0.085, TROUSERS), (knee, ankle, 0.06, TROUSERS)]
    return found


def _turns() -> list[float]:
    return [2 * math.pi * k / SPOKES for k in range(SPOKES)]


def rider(count: int, seed: int = 0) -> GaussianCloud:
    """A rider on a bicycle, z up, 1.9 m high.

    Args:
        count: Number of Gaussians.
        seed: Of their places, sizes and colours.
    """
    draw = torch.Generator().manual_seed(seed)
    tubes = _tubes()
    first, last = (torch.tensor([tube[end] for tube in tubes]) for end in (0, 1))
    radius, colour = torch.tensor([tube[2] for tube in tubes]), torch.tensor([tube[3] for tube in tubes])
    length = (last - first).norm(dim=-1) + 2 * radius
    area = 2 * math.pi * radius * length
    own = torch.multinomial(area, count, replacement=True, generator=draw)
    along = 2 * torch.rand(count, 1, generator=draw) - 1
    axis = torch.nn.functional.normalize(last - first, dim=-1)[own]
    side = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.randn(count, 3, generator=draw)), dim=-1)
    wide = radius[own, None] * (1 - along**8).sqrt()  # round at the ends
    middle = 0.5 * (first + last)[own] + 0.5 * along * length[own, None] * axis
    means = middle + (wide + NOISE * torch.randn(count, 1, generator=draw)) * side
    turn = 2 * math.pi * torch.rand(count, 1, generator=draw)
    across = torch.linalg.cross(side, axis)
    tangent = turn.cos() * axis + turn.sin() * across
    frame = torch.stack([tangent, torch.linalg.cross(side, tangent), side], -1)
    size = 0.8 * math.sqrt(float(area.sum()) / count)
    scales = (size * torch.tensor([1.0, 0.6, 0.12])).log() + 0.4 * torch.randn(count, 3, generator=draw)
    shade = (colour[own] * (0.85 + 0.3 * torch.rand(count, 1, generator=draw))).clamp(0, 1)
    opacities = torch.randn(count, generator=draw) - 0.5
    return GaussianCloud(
        means, rotation_to_quat(frame), scales, opacities, ((shade - 0.5) / 0.28209479177387814)[:, None]
    )


def write_rider(folder: Path, count: int, dx: float) -> Path:
    """Write a rider and a configuration in which the wind blows from the side, and return the latter.

    Material and size are those of ``configs/sim/hanging_object.yaml``.

    Args:
        folder: Folder of the files.
        count: Number of Gaussians.
        dx: Spacing of the grid [m]; the rider's longest side is 1 m.
    """
    write_ply(folder / "rider.ply", rider(count))
    below = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [None, None, SADDLE]}}
    settings = {
        "background": [0.93, 0.94, 0.96],
        "scene": {"ply": str(folder / "rider.ply"), "longest_side": 1.0, "opacity_threshold": 0.0},
        "material": {"E": 3e5, "nu": 0.3, "density": 400.0, "thickness": 0.01},
        "solver": {
            "dx": dx,
            "damping": 1.0,
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": below}}],
        },
        "wind": {
            "flow": [0.0, 6.0, 0.0],
            "modulations": [
                {"class_path": "SineSway", "init_args": {"amplitude": 0.5, "period": 2.0}},
                {"class_path": "GaussianGust", "init_args": {"std": 0.3}},
            ],
        },
        "aero": {"C_D": 0.5, "C_F": 0.4, "C_L": 0.01, "law": "projected"},
        "camera": {
            "class_path": "OrbitCamera",
            "init_args": {"width": 960, "height": 540, "azimuth": -60.0, "radius": 1.9},
        },
    }
    file = folder / "rider.yaml"
    file.write_text(yaml.safe_dump(settings))
    return file
