"""A splat of a printed flag on its pole, and a film of it as a phone takes it: for ``fit FILM --splat``."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.scenes.procedural import FlagScene, both
from gaussian_swaying.simulation.simulation import Simulation

FOV = 55.0
"""Vertical field of view of the film [degrees]."""
WARM = (1.0, 0.94, 0.82)
"""Light of the film, which is not that of the splat."""
TRUTH = {"wind.speed": 9.0, "wind.azimuth": 35.0, "material.E": 5e4}
FLAG = (1.2, 0.8)
"""Length and height of the cloth [m]."""


def camera_of(width: int, height: int) -> Camera:
    return look_at_camera([1.3, -3.2, 0.5], [0.55, 0.0, 0.2], [0.0, 0.0, 1.0], FOV, width, height)


def write_case(folder: Path, size: tuple[int, int], still: float, moving: float, spacing: float) -> None:
    """Write the splat, ``my.ply``, the true scene, ``truth.yaml``, and ``film.mp4``, with noise and another light.

    Only the cloth moves, in a steady wind; it is at rest at first. A scene unit is a metre, and z is up.
    Units: ``size`` [pixels]; ``still``, ``moving`` [s]; ``spacing`` [m].
    """
    width, height = FLAG
    cloth = FlagScene(width, height, spacing, pattern="printed", ripple=0.05).generate()
    stand = FlagScene(width, height, spacing, stand="pole").generate()
    write_ply(folder / "my.ply", both(cloth, stand.select(torch.arange(len(stand)) >= len(cloth))))
    speed, azimuth = TRUTH["wind.speed"], torch.deg2rad(torch.tensor(TRUTH["wind.azimuth"]))
    pole = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.06, None, None]}}
    moves = {"class_path": "Box", "init_args": {"min": [-0.005, None, -0.1], "max": [None, None, height + 0.1]}}
    scene = {"ply": str(folder.resolve() / "my.ply"), "up": [0.0, 0.0, 1.0], "metres_per_unit": 1.0, "region": moves}
    settings = {
        "frame_dt": 1 / 30,
        "scene": scene,
        "material": {"E": TRUTH["material.E"], "nu": 0.3, "density": 400.0, "thickness": 0.012},
        "solver": {
            "dx": 0.05,
            "damping": 1.0,
            "gravity": [0.0, 0.0, 0.0],
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": pole}}],
        },
        "wind": {"flow": [speed * float(azimuth.cos()), speed * float(azimuth.sin()), 0.0]},
        "aero": {"C_D": 0.5, "C_F": 0.4, "C_L": 0.01, "law": "projected"},
        "background": [0.45, 0.5, 0.55],
    }
    (folder / "truth.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    simulation = Simulation.from_yaml(folder / "truth.yaml", device="cpu")
    painter, camera = simulation.painter, camera_of(*size)
    rate, drawn = 1 / simulation.frame_dt, torch.Generator().manual_seed(0)
    encoder = VideoEncoder(folder / "film.mp4", rate)
    for frame in simulation.frames(round(moving * rate)):
        colour = painter.picture(painter.deformed(frame.state), camera).color
        colour = 255 * 0.9 * colour * torch.tensor(WARM)
        for _ in range(1 + round(still * rate) if frame.index == 0 else 1):
            noisy = colour + 2.0 * torch.randn(colour.shape, generator=drawn)
            encoder.write(noisy.round().clamp(0, 255).to(torch.uint8).numpy())
    encoder.finish()
