"""Videos of a simulation, as ``gaussian-swaying fit`` reads them: to see whether a fit finds what is known."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.simulation.simulation import Simulation


def write_video(
    simulation: Simulation, folder: Path, cameras: Mapping[str, Camera], frames: int, noise: float = 0.0, seed: int = 0
) -> None:
    """Simulate, and write what each camera sees: PNG files, and ``transforms.json``."""
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(seed)
    painter, entries = simulation.painter, []
    for frame in simulation.frames(frames):
        for name, camera in cameras.items():
            gaussians = painter.deformed(frame.state)
            own = camera.to(painter.device)
            picture = painter.picture(gaussians, own)
            colour = picture.color.cpu() * 255
            colour = colour + noise * torch.randn(colour.shape, generator=generator)
            stem = f"{name}_{frame.index:04d}"
            iio.imwrite(folder / f"{stem}.png", _bytes(colour))
            entries.append(
                {
                    "file_path": f"{stem}.png",
                    "camera": name,
                    "time": frame.index * simulation.frame_dt,
                    "transform_matrix": opengl(camera).tolist(),
                    "fl_x": float(camera.intrinsics[0, 0]),
                    "fl_y": float(camera.intrinsics[1, 1]),
                    "cx": float(camera.intrinsics[0, 2]),
                    "cy": float(camera.intrinsics[1, 2]),
                    "w": camera.width,
                    "h": camera.height,
                }
            )
    (folder / "transforms.json").write_text(json.dumps({"frames": entries}, indent=1), encoding="utf-8")


def _bytes(picture: Tensor):  # type: ignore[no-untyped-def]
    return picture.round().clamp(0, 255).to(torch.uint8).numpy()


def opengl(camera: Camera) -> Tensor:
    """Camera-to-world matrix with OpenGL axes."""
    return torch.linalg.inv(camera.world_to_camera.cpu().double()) * torch.tensor([1.0, -1.0, -1.0, 1.0])


FPS = 30
MIDDLE = (0.2, 0.05, 0.15)
"""The point at which the hand aims [m]."""


def shaken(
    camera: Camera, frames: int, degrees: float, seed: int = 0, middle: Sequence[float] = MIDDLE
) -> list[Camera]:
    """The camera in a hand: it turns by as many degrees (root mean square) and moves by a hundredth of the distance.

    Each of six numbers is a sum of waves of 0.4 to 2 Hz, as a hand sways, and one of 9 Hz, a tenth as large, as it
    trembles.

    Units: ``middle`` [m].
    """
    generator = torch.Generator().manual_seed(seed)
    time = torch.arange(frames, dtype=torch.float64) / FPS
    phase = 2 * math.pi * torch.rand(5, 6, generator=generator, dtype=torch.float64)
    waves = zip((0.4, 0.8, 1.3, 2.0, 9.0), (1.0, 0.7, 0.5, 0.35, 0.1), strict=True)
    own = sum(size * torch.sin(2 * math.pi * hz * time[:, None] + phase[n]) for n, (hz, size) in enumerate(waves))
    assert isinstance(own, Tensor)
    own = own - own[:1]
    distance = float((camera.position - torch.tensor(middle, dtype=torch.float64)).norm())
    turn, shift = (part / part.square().sum(1).mean().sqrt() for part in own.split(3, 1))
    turned = rotation_of(math.radians(degrees) * turn)
    found = []
    for k in range(frames):
        view = camera.world_to_camera.clone()
        view[:3] = turned[k] @ view[:3]
        view[:3, 3] += 0.01 * degrees * distance * shift[k]
        found.append(replace(camera, world_to_camera=view))
    return found
