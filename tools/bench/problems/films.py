"""Videos of a simulation, as ``gaussian-swaying fit`` reads them: to see whether a fit finds what is known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.simulation.simulation import Simulation


def write_video(
    simulation: Simulation, folder: Path, cameras: Mapping[str, Camera], frames: int, noise: float = 0.0, seed: int = 0
) -> None:
    """Simulate, and write what each camera sees: PNG files with silhouettes, and ``transforms.json``."""
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(seed)
    painter, entries = simulation.painter, []
    for frame in simulation.frames(frames):
        for name, camera in cameras.items():
            gaussians = painter.deformed(frame.state)
            own = camera.to(painter.device)
            picture = painter.draw(gaussians, painter.colors(gaussians, own), own)
            colour = picture.color.cpu() * 255
            colour = colour + noise * torch.randn(colour.shape, generator=generator)
            stem = f"{name}_{frame.index:04d}"
            iio.imwrite(folder / f"{stem}.png", _bytes(colour))
            iio.imwrite(folder / f"{stem}_mask.png", _bytes(255 * picture.alpha.cpu()).repeat(3, axis=-1))
            entries.append(
                {
                    "file_path": f"{stem}.png",
                    "mask_path": f"{stem}_mask.png",
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


__all__ = ["opengl", "write_video"]
