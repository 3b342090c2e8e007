"""Checks of the files of an earlier part of a run, before the run continues, so that nothing fails at its end."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from gaussian_swaying._files import check_not_taken, kind_of
from gaussian_swaying.gaussians.export import read_usd_frame
from gaussian_swaying.recording.nodes import NODES
from gaussian_swaying.recording.trajectory import TRAJECTORY, check_trajectory


def check_pictures(folder: Path, place: str, frames: int, video: str | None = None) -> list[str]:
    """Check the PNGs of the frames so far.

    Args:
        folder: The folder of the run.
        place: Name of its folder of PNGs.
        frames: Number of frames that must exist.
        video: Name of the video made from them, if any.

    Returns:
        A sentence if some are missing.
    """
    from PIL import Image

    missing, first = [], None
    for index in range(frames):
        path = folder / place / f"{index:05d}.png"
        if kind_of(path) is None:
            missing.append(path)
            continue
        check_not_taken(path)
        try:
            with Image.open(path, formats=["PNG"]) as image:
                look = (image.size, image.mode)
                image.verify()  # the checksums of its chunks, without decoding
        except Exception as error:
            raise damaged(path, str(error) or type(error).__name__) from error
        first = first or look
        if look != first:
            shown = [f"{width} x {height} {mode}" for (width, height), mode in (look, first)]
            raise damaged(path, f"it is {shown[0]}, and the frames before it are {shown[1]}")
    return tell_missing(missing, video)


def check_frames(folder: Path, place: str, suffix: str, wanted: Iterable[int]) -> list[str]:
    """A sentence if files of the frames so far are missing."""
    files = [folder / place / f"{index:05d}{suffix}" for index in wanted]
    return tell_missing([file for file in files if kind_of(file) is None])


def check_arrays(folder: Path, name: str, frames: int, rows: int | None) -> list[str]:
    """Check the ``trajectory`` or the ``nodes`` of the frames so far; ValueError if a file is damaged."""
    arrays = {"trajectory": TRAJECTORY, "nodes": NODES}[name]
    complete = check_trajectory(folder / name, folder / f"{name}.npz", frames, rows, arrays)
    lost = sorted(set(range(frames)) - complete)
    return tell_missing([folder / name / f"{index:05d}.npz" for index in lost], f"{name}.npz")


def check_shards(folder: Path, wanted: Iterable[int]) -> list[str]:
    """Check the frames of a USD film: single ones that are not joined yet, and those already joined."""
    missing, film = [], folder / "animation.usdc"
    for index in wanted:
        path = folder / "usd" / f"{index:05d}.npz"
        if kind_of(path) is None:
            missing.append(path)
            continue
        try:
            with zipfile.ZipFile(path) as archive:
                broken = archive.testzip()
        except Exception as error:
            raise damaged(path, str(error) or type(error).__name__) from error
        if broken is not None:
            raise damaged(path, f"the checksum of {broken} is wrong")
    if missing and film.exists():
        try:
            read_usd_frame(film, int(missing[0].stem))
        except ValueError as error:
            raise damaged(film, str(error)) from error
        missing = []
    return tell_missing(missing, film.name)


def damaged(path: Path, why: str) -> ValueError:
    """The error for a damaged file of a run."""
    why = re.sub(r"\s+", " ", why).rstrip(".")
    return ValueError(f"{path} is damaged ({why}): remove it to go on without it, or start again without --resume.")


def tell_missing(files: Sequence[Path], film: str | None = None) -> list[str]:
    """Return a sentence that names the first missing file, if any, and the film made from them."""
    if not files:
        return []
    what, many = ("it", f"{files[0]} is") if len(files) == 1 else ("them", f"{files[0]} and {len(files) - 1} more are")
    so = f", so {film} will be without {what}" if film else ""
    return [f"{many} missing{so}; start again without --resume to have {what}."]
