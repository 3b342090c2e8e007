"""A flag in front of walls, filmed by a hand that shakes, with exposure and white balance that drift, as H.264."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
import yaml
from bench.problems.films import FPS, MIDDLE, opengl
from small_films import base
from torch import Tensor

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.scenes.printed_cloth import printed_colours
from gaussian_swaying.scenes.procedural import FlagScene, both
from gaussian_swaying.simulation.simulation import Simulation

WALLS = ((2.4, 1.6, 0.0, (-0.9, 0.6, -0.7)), (0.5, 1.6, 65.0, (0.75, 0.1, -0.7)))
"""Width, height [m], turn from the x axis [degrees] and lower corner [m] of the walls behind and beside the flag."""


def write_base(folder: Path, wall: float = 0.02) -> Path:
    """Write the splat of a flag before two walls, ``room.ply``, and the configuration of its simulation.

    Units: ``wall`` [m], the distance of the Gaussians of the walls; infinite for none.
    """
    cloud = FlagScene(0.4, 0.3, 0.025, ripple=0.01, pattern="printed").generate()
    for width, height, yaw, corner in WALLS if math.isfinite(wall) else ():
        part = FlagScene(width, height, wall, ripple=0.0, pattern="printed", yaw=yaw).generate()
        cloud = both(cloud, replace(part, means=part.means + torch.tensor(corner)))
    write_ply(folder / "room.ply", cloud)
    sheet = {"class_path": "Box", "init_args": {"min": [None, -0.06, None], "max": [0.5, 0.06, None]}}
    scene = {"generator": None, "ply": str(folder / "room.ply"), "region": sheet, "area": "coverage"}
    (folder / "base.yaml").write_text(yaml.safe_dump(base(frame_dt=1 / FPS, scene=scene)), encoding="utf-8")
    return folder / "base.yaml"


def tripod(width: int, height: int) -> Camera:
    return look_at_camera((0.05, -0.95, 0.35), MIDDLE, (0, 0, 1), 38.0, width, height, dtype=torch.float64)


def drift(frames: int) -> Tensor:
    """Gains of red, green and blue in each frame, as a phone changes them: darker by a quarter, and warmer; (F, 3)."""
    way = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None]
    ripple = 0.02 * torch.sin(2 * math.pi * 4 * way)
    return 1 + way * torch.tensor([-0.15, -0.25, -0.35], dtype=torch.float64) + ripple


def photographed(camera: Camera, walls: Sequence[tuple[float, float, float, tuple[float, ...]]] = WALLS) -> Tensor:
    """The walls themselves, by three rays a pixel and side and not as Gaussians, black elsewhere, uint8, (H, W, 3)."""
    rows, columns = ((torch.arange(3 * n) + 0.5).double() / 3 for n in (camera.height, camera.width))
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    local = torch.stack([column, row, torch.ones_like(row)], -1) @ camera.intrinsics.double().inverse().T
    ray, eye = local @ camera.world_to_camera[:3, :3].double(), camera.position.double()
    nearest, colour = torch.full_like(row, math.inf), torch.zeros_like(ray)
    for width, height, yaw, corner in walls:
        turn, first = math.radians(yaw), eye.new_tensor(corner)
        along, normal = eye.new_tensor([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0]])
        distance = (first - eye) @ normal / (ray @ normal)
        place = eye + distance[..., None] * ray - first
        x, z = place @ along, place[..., 2]
        seen = (distance > 0) & (distance < nearest) & (x > 0) & (x < width) & (z > 0) & (z < height)
        nearest[seen], colour[seen] = distance[seen], printed_colours(x[seen], z[seen]).double()
    return (255 * colour.unflatten(0, (-1, 3)).unflatten(2, (-1, 3)).mean((1, 3))).round().to(torch.uint8)


def write_film(
    simulation: Simulation,
    folder: Path,
    cameras: Sequence[Camera],
    gains: Tensor | None = None,
) -> None:
    """Simulate, and write what a moving camera sees as ``film.mp4`` with the camera of its first frame alone."""
    from imageio_ffmpeg import write_frames

    folder.mkdir(parents=True, exist_ok=True)
    first, painter = cameras[0], simulation.painter
    generator = torch.Generator().manual_seed(0)
    film = write_frames(
        str(folder / "film.mp4"),
        (first.width, first.height),
        fps=1 / simulation.frame_dt,
        macro_block_size=2,
        quality=None,
        output_params=["-crf", "23"],
    )
    film.send(None)
    for frame in simulation.frames(len(cameras)):
        gaussians = painter.deformed(frame.state)
        own = cameras[frame.index].to(painter.device, torch.float32)
        colour = painter.picture(gaussians, own).color.cpu().double()
        colour = colour * (1 if gains is None else gains[frame.index])
        colour = 255 * colour + 2.0 * torch.randn(colour.shape, generator=generator)
        film.send(colour.round().clamp(0, 255).to(torch.uint8).numpy().tobytes())
    film.close()
    lens = {name: float(first.intrinsics[at]) for name, at in
            {"fl_x": (0, 0), "fl_y": (1, 1), "cx": (0, 2), "cy": (1, 2)}.items()}  # fmt: skip
    entry = {"video_path": "film.mp4", "time": 0.0, "transform_matrix": opengl(first).tolist()}
    fields = lens | {"w": first.width, "h": first.height, "frames": [entry]}
    (folder / "transforms.json").write_text(json.dumps(fields), encoding="utf-8")


def off(found: Camera, true: Camera) -> tuple[float, float]:
    """Angle between two cameras [degrees], and their distance as a share of that to what they look at."""
    turn = found.world_to_camera[:3, :3].double() @ true.world_to_camera[:3, :3].double().T
    sine = (turn - turn.T)[[2, 0, 1], [1, 2, 0]].norm() / 2
    distance = (true.position.double() - torch.tensor(MIDDLE, dtype=torch.float64)).norm()
    apart = (found.position.double() - true.position.double()).norm()
    return math.degrees(math.asin(min(1.0, float(sine)))), float(apart / distance)
