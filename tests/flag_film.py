"""A splat of a printed flag on its pole, and a film of it as a phone takes it: for ``fit FILM --splat``."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.scenes.procedural import FlagScene, both
from gaussian_swaying.simulation.simulation import Simulation

FOV = 55.0
"""Vertical field of view of the film [degrees]."""
WARM = (1.0, 0.94, 0.82)
"""Light of the film, which is not that of the splat."""
TRUTH = {"wind.speed": 9.0, "wind.azimuth": 35.0, "material.E": 5e4}
POLE = 2.5
"""Height of the pole [m]."""
FLAG = (1.2, 0.8)
"""Length and height of the cloth [m]."""


def flag_on_pole(spacing: float = 0.015) -> GaussianCloud:
    """The splat, z up; a scene unit is a metre."""
    width, height = FLAG
    cloth = FlagScene(width, height, spacing, pattern="printed", ripple=0.05).generate()
    stand = FlagOnStandScene(width, height, spacing).generate()
    return both(cloth, stand.select(torch.arange(len(stand)) >= len(cloth)))


def scene_text(splat: Path, dx: float = 0.05) -> str:
    """The true scene: only the cloth moves, in a steady wind."""
    speed, azimuth = TRUTH["wind.speed"], torch.deg2rad(torch.tensor(TRUTH["wind.azimuth"]))
    pole = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.06, None, None]}}
    cloth = {"class_path": "Box", "init_args": {"min": [-0.005, None, -0.1], "max": [None, None, FLAG[1] + 0.1]}}
    return yaml.safe_dump(
        {
            "frame_dt": 1 / 30,
            "scene": {"ply": str(splat.resolve()), "up": [0.0, 0.0, 1.0], "metres_per_unit": 1.0, "region": cloth},
            "material": {"E": TRUTH["material.E"], "nu": 0.3, "density": 400.0, "thickness": 0.012},
            "solver": {
                "dx": dx,
                "damping": 1.0,
                "gravity": [0.0, 0.0, 0.0],
                "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": pole}}],
            },
            "wind": {"flow": [speed * float(azimuth.cos()), speed * float(azimuth.sin()), 0.0]},
            "aero": {"C_D": 0.5, "C_F": 0.4, "C_L": 0.01, "law": "projected"},
            "background": [0.45, 0.5, 0.55],
        }
    )


def camera_of(width: int, height: int) -> Camera:
    """The true camera."""
    return look_at_camera([1.3, -3.2, 0.5], [0.55, 0.0, 0.2], [0.0, 0.0, 1.0], FOV, width, height)


def write_film(
    path: Path, scene: Path, size: tuple[int, int] = (540, 960), still: float = 0.5, moving: float = 2.5
) -> None:
    """Render a film: the thing is at rest for some time [s], then it moves; with noise and another light.

    Units: ``size`` [pixels]; ``still``, ``moving`` [s].
    """
    simulation = Simulation.from_yaml(scene, device="cpu")
    painter, camera = simulation.painter, camera_of(*size)
    rate, drawn = 1 / simulation.frame_dt, torch.Generator().manual_seed(0)
    encoder = VideoEncoder(path, rate)
    try:
        for frame in simulation.frames(round(moving * rate)):
            gaussians = painter.deformed(frame.state)
            colour = painter.draw(gaussians, painter.colors(gaussians, camera), camera).color
            colour = 255 * 0.9 * colour * torch.tensor(WARM)
            for _ in range(1 + round(still * rate) if frame.index == 0 else 1):
                noisy = colour + 2.0 * torch.randn(colour.shape, generator=drawn)
                encoder.write(noisy.round().clamp(0, 255).to(torch.uint8).numpy())
        encoder.finish()
    finally:
        encoder.abort()


def write_case(
    folder: Path,
    size: tuple[int, int] = (540, 960),
    still: float = 0.5,
    moving: float = 2.5,
    spacing: float = 0.015,
) -> None:
    """Write ``my.ply``, ``truth.yaml`` and ``film.mp4`` into a folder."""
    write_ply(folder / "my.ply", flag_on_pole(spacing))
    (folder / "truth.yaml").write_text(scene_text(folder / "my.ply"), encoding="utf-8")
    write_film(folder / "film.mp4", folder / "truth.yaml", size, still, moving)


__all__ = ["POLE", "TRUTH", "flag_on_pole", "write_case", "write_film"]
