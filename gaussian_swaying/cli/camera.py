"""Find the camera of a film: ``gaussian-swaying camera FILM SPLAT``."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying import _program as program
from gaussian_swaying._files import write_json
from gaussian_swaying._inputs import check_regular
from gaussian_swaying.cli.errors import run_command
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.origin import Origin
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput

PICTURE, CAMERAS = "registration.png", "transforms.json"
VIEW = 50.0
"""Vertical field of view with which a search begins if it is not known [degrees]."""
ROOM = 1.3
"""Distance of the first cameras, per that at which the object fills the picture."""
STILLS = (".png", ".jpg", ".jpeg")


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=program.name("camera"),
        description="Find the camera of a film from a tripod, from its first frame and the splat that it shows, and "
        f"write {CAMERAS}, which `fit` reads, with a picture of the frame beside the splat.",
    )
    add = parser.add_argument
    add("film", help="a film, or a picture, of the object at rest")
    add("splat", help="the splat, in any format that can be read")
    add("--output", help="folder of the results; outputs/registered/<name of the film> if left out")
    add("--fov", type=float, help="vertical field of view of the film [degrees]; found, too, if left out")
    add("--up", nargs=3, type=float, metavar=("X", "Y", "Z"), help="direction in the splat that is up; else guessed")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the options and find the camera.

    Returns:
        0 on success, 2 on bad input or if the splat is not found in the film.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = build_parser()
    return run_command(
        lambda: write_camera(parser.parse_args(arguments)),
        stopped="Stopped; nothing was written.",
        memory="a smaller film",
        arguments=arguments,
    )


def write_camera(options: argparse.Namespace) -> int:
    """Find the camera, write the files, and print how sure it is."""
    from PIL import Image

    from gaussian_swaying.gaussians.formats import read_gaussians
    from gaussian_swaying.inverse.cameras import find_camera

    if options.fov is not None and not 0 < options.fov < 180:
        raise ValueError(f"Expected `--fov` to be between 0 and 180 degrees, but got {options.fov:g}.")
    film = check_regular(Path(options.film), "the film")
    frame = first_frame(film)
    cloud = read_gaussians(options.splat, 0)
    draw = painter_of(cloud)
    start = first_cameras(cloud, options.up, options.fov or VIEW, frame.shape[1], frame.shape[0])
    found = find_camera(draw, frame, start, focal=options.fov is None)
    folder = Path(options.output or Path("outputs") / "registered" / film.stem)
    folder.mkdir(parents=True, exist_ok=True)
    shown = (draw(found.camera).color.clamp(0, 1) * 255).round().to(torch.uint8)
    half = ((frame.float() + shown.float()) / 2).round().to(torch.uint8)
    Image.fromarray(torch.cat([frame, half, shown], 1).numpy()).save(folder / PICTURE)
    write_json(folder / CAMERAS, transforms(found.camera, os.path.relpath(film, folder), cloud.origin))
    print(
        f"{found.agreeing} of {found.matches} points agree on the camera, {found.residual:.2f} pixels off; its "
        f"vertical field of view is {fov_of(found.camera):.1f} degrees"
    )
    print(f"look at {PICTURE}: the frame, both, and the splat from there have to show the same")
    for name in (CAMERAS, PICTURE):
        print(f"wrote {folder / name}")
    return 0


def first_frame(film: Path) -> Tensor:
    """The first frame of a film, or a picture, dtype uint8, shape (H, W, 3)."""
    from gaussian_swaying.captures.images import read_image

    if film.suffix.lower() in STILLS:
        return read_image(film)[..., :3].contiguous()
    from gaussian_swaying.inverse.videos import frames_of, next_of

    with closing(frames_of(film)) as frames:
        head, frame = next_of(frames, film), next_of(frames, film)
        if head is None or frame is None:
            raise ValueError(f"The film {film} has no frames: convert it to mp4.")
        width, height = head["size"]
        return torch.frombuffer(bytearray(frame), dtype=torch.uint8).reshape(height, width, 3)


def painter_of(cloud: GaussianCloud) -> Callable[[Camera], RenderOutput]:
    """A function that draws a splat on black, in the colours that it has from all sides."""
    from gaussian_swaying.geometry.covariances import covariance
    from gaussian_swaying.rendering.gsplat_renderer import make_renderer

    renderer = make_renderer(torch.device("cpu"))
    shape, colour = covariance(cloud.quats, cloud.scales), (0.5 + SH_DC * cloud.sh[:, 0]).clamp(0, 1)

    def draw(camera: Camera) -> RenderOutput:
        with torch.no_grad():
            return renderer(cloud.means, shape, cloud.opacities.sigmoid(), colour, camera.to(dtype=torch.float32))

    return draw


def first_cameras(
    cloud: GaussianCloud, up: Sequence[float] | None, fov: float, width: int, height: int
) -> list[Camera]:
    """Cameras around a splat, from which it fills the picture."""
    from gaussian_swaying.gaussians.measures import Gaussians
    from gaussian_swaying.inverse.cameras import cameras_around
    from gaussian_swaying.suggestion.up import guess_up

    splat, draw = Gaussians.of(cloud), torch.Generator().manual_seed(0)
    up = guess_up(splat)[0].direction if up is None else up
    chosen = cloud.means[torch.multinomial(torch.from_numpy(splat.weight), 10_000, replacement=True, generator=draw)]
    low, high = (torch.quantile(chosen, share, dim=0) for share in (0.02, 0.98))
    narrow = math.tan(math.radians(fov) / 2) * min(1.0, width / height)
    distance = ROOM * 0.5 * float((high - low).norm()) / narrow
    return cameras_around((0.5 * (low + high)).tolist(), distance, up, fov, width, height)


def fov_of(camera: Camera) -> float:
    """Vertical field of view [degrees]."""
    return 2 * math.degrees(math.atan(0.5 * camera.height / float(camera.intrinsics[1, 1])))


def transforms(camera: Camera, film: str, origin: Origin) -> dict[str, Any]:
    """The content of a transforms.json with one film, or one picture, at time 0; ``origin`` is that of the splat."""
    pose = torch.linalg.inv(camera.world_to_camera.double()) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())
    pose[:3, 3] += torch.tensor(origin, dtype=torch.float64)
    K = camera.intrinsics.double()
    kind = "file_path" if Path(film).suffix.lower() in STILLS else "video_path"
    return {
        "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2]),
        "w": camera.width, "h": camera.height,
        "frames": [{kind: Path(film).as_posix(), "transform_matrix": pose.tolist(), "time": 0.0}],
    }  # fmt: skip
