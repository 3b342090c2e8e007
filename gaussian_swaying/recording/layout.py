"""Names of the files and folders of a run."""

from __future__ import annotations

import re
from pathlib import Path

from gaussian_swaying.rendering.passes import PASSES

_FILES = ["run.json", "config.yaml", "checkpoint.pt", "summary.json", "diagnostics.csv", "film.html", "cameras"]
_FILES += ["certificate.svg"]
_FILES += ["trajectory", "nodes", "trajectory.npz", "nodes.npz"]


def names() -> list[str]:
    """Names that a run writes; a folder that was not made by a run must not contain them."""
    places = map(frame_folder, PASSES)
    return _FILES + [name for place in places for name in (place, raw_folder(place), video_file(place))]


def frame_folder(render: str = "color", camera: str = "") -> str:
    """Folder of a render's frames inside that of the run: ``frames``, ``depth``, ``cameras/<name>/frames`` ..."""
    own = "frames" if render == "color" else render
    return f"cameras/{camera}/{own}" if camera else own


def raw_folder(place: str) -> str:
    """Folder of the raw values that the folder ``place`` shows as colours."""
    return f"{place}_raw"


def video_file(place: str) -> str:
    """The video of the frames in the folder ``place``: ``video.mp4`` of ``frames``, ``depth.mp4`` of ``depth`` ..."""
    folder = Path(place)
    return folder.with_name("video.mp4" if folder.name == "frames" else f"{folder.name}.mp4").as_posix()


def check_camera_name(name: str) -> None:
    """Raise ValueError unless a camera's name is valid as a folder name on every system."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise ValueError(f"Expected the names of `cameras` to have only letters, digits, - and _, but got {name!r}.")
