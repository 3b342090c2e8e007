"""Files of an earlier part of a run that are missing when the run goes on."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path

from gaussian_swaying._inputs import check_archive


def packed_frames(path: Path) -> set[int]:
    """Frames already packed into a file such as ``trajectory.npz``."""
    if not path.exists():
        return set()
    with zipfile.ZipFile(check_archive(path, "the run")) as archive:
        return {int(Path(name).stem[-5:]) for name in archive.namelist()}


def tell_missing(folder: Path, suffix: str, frames: Iterable[int], film: str | None = None) -> list[str]:
    """A sentence if files of frames are missing."""
    paths = (folder / f"{index:05d}{suffix}" for index in sorted(frames))
    files = [path for path in paths if not path.exists()]
    if not files:
        return []
    what, many = ("it", f"{files[0]} is") if len(files) == 1 else ("them", f"{files[0]} and {len(files) - 1} more are")
    so = f", so {film} will be without {what}" if film else ""
    return [f"{many} missing{so}; start again without --resume to have {what}."]
