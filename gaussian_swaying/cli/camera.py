"""Find the camera of a film: ``gaussian-swaying camera FILM SPLAT``."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying._files import write_json
from gaussian_swaying._inputs import check_regular
from gaussian_swaying.cli.errors import run_command


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=program.name("camera"),
        description="Find the camera of a film from a tripod, from its first frame and the splat that it shows, and "
        "write transforms.json, which `fit` reads, with a picture of the frame beside the splat.",
    )
    add = parser.add_argument
    add("film", help="a film, or a picture, of the object at rest")
    add("splat", help="the splat, in any format that can be read")
    add("--output", help="folder of the results; outputs/registered/<name of the film> if left out")
    add("--fov", type=float, help="vertical field of view of the film [degrees]; found, too, if left out")
    add("--up", nargs=3, type=float, metavar=("X", "Y", "Z"), help="direction in the splat that is up; else guessed")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Parse the options and find the camera.

    Returns:
        0 on success, 2 on bad input or if the splat is not found in the film.
    """
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

    from gaussian_swaying.captures.images import read_image
    from gaussian_swaying.gaussians.formats import read_gaussians
    from gaussian_swaying.inverse import registration
    from gaussian_swaying.inverse.from_film import open_film
    from gaussian_swaying.inverse.report import side_by_side

    if options.fov is not None and not 0 < options.fov < 180:
        raise ValueError(f"Expected `--fov` to be between 0 and 180 degrees, but got {options.fov:g}.")
    film = check_regular(Path(options.film), "the film")
    still = film.suffix.lower() in registration.STILLS
    frame = read_image(film)[..., :3].contiguous() if still else open_film(film, math.inf).first
    cloud = read_gaussians(options.splat, 0)
    found, picture = registration.register(frame, cloud, options.up, options.fov)
    folder = Path(options.output or Path("outputs") / "registered" / film.stem)
    folder.mkdir(parents=True, exist_ok=True)
    pictures, cameras = (folder / name for name in (registration.PICTURE, registration.CAMERAS))
    Image.fromarray(side_by_side(frame, picture)).save(pictures)
    write_json(cameras, registration.transforms(found.camera, os.path.relpath(film, folder), cloud.origin))
    print(
        f"{found.agreeing} of {found.matches} points agree on the camera, {found.residual:.2f} pixels off; its "
        f"vertical field of view is {registration.fov_of(found.camera):.1f} degrees"
    )
    print(f"look at {registration.PICTURE}: the frame, both, and the splat from there have to show the same")
    print(f"wrote {cameras}\nwrote {pictures}")
    return 0
