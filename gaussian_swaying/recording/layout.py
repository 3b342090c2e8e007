"""Names of the files and folders of a run."""

from __future__ import annotations

import re
from pathlib import Path

# names that a run writes; a folder that was not made by a run must not contain them
OURS = [
    "run.json",
    "config.yaml",
    "checkpoint.pt",
    "trajectory.npz",
    "nodes.npz",
    "summary.json",
    "diagnostics.csv",
]
OURS += ["frames", "trajectory", "nodes", "video.mp4", "cameras", "depth", "depth_raw", "normal", "force"]
OURS += ["wind", "wind.mp4"]
OURS += ["depth.mp4", "normal.mp4", "force.mp4", "film.html"]


def frame_folder(render: str = "color", camera: str = "") -> str:
    """Folder of a render's frames inside that of the run: ``frames``, ``depth``, ``cameras/<name>/frames`` ...

    Args:
        render: One of ``color``, ``depth``, ``normal``, ``force`` and ``wind``.
        camera: Name of a further camera; empty for the main camera.
    """
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
