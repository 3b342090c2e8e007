"""The photos on disk that the names in the files of a capture mean, and whether they are turned."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable
from pathlib import Path

UNREADABLE = (".heic", ".heif", ".avif")
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", *UNREADABLE)


def clean_name(name: str) -> str:
    """A name of a photo with forward slashes, relative to its folder."""
    return name.replace("\\", "/").removeprefix("./")


class Photos:
    """The files below a folder, by the names that a capture has for them.

    Args:
        folder: The folder that names are relative to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[str, list[Path]] | None = None

    def find(self, name: str) -> Path | None:
        """The file that a name means, or None.

        It is the file of this name, or else one whose name differs in case, spaces, Unicode form or, for photos, the
        ending, which may be missing. Of a path from another computer, the longest end that exists here counts.

        Raises:
            ValueError: If several files fit.
        """
        exact = next((self.folder / n for n in (name, clean_name(name)) if (self.folder / n).is_file()), None)
        if exact is not None and exact.suffix.lower() not in UNREADABLE:
            return exact
        parts = clean_name(name).strip("/").split("/")
        for start in range(len(parts)):
            end = "/".join(parts[start:])
            for key in (_key(end), _key(end, stem=True)):
                found = self._index().get(key, [])
                if len(found) > 1:
                    raise ValueError(
                        f"The name {name} of a photo fits {len(found)} files, such as {found[0]} and {found[1]}: "
                        "rename or remove all but one."
                    )
                if found:
                    return found[0]
        return exact

    def _index(self) -> dict[str, list[Path]]:
        if self._files is None:
            self._files = {}
            for path in photos_below(self.folder):
                name = path.relative_to(self.folder).as_posix()
                if path.suffix.lower() not in UNREADABLE:
                    for key in {_key(name), _key(name, stem=True)}:
                        self._files.setdefault(key, []).append(path)
        return self._files


def _key(name: str, stem: bool = False) -> str:
    if stem:
        start, end = os.path.splitext(name)
        name = (start if end.lower() in SUFFIXES else name) + "/"
    return " ".join(unicodedata.normalize("NFC", clean_name(name)).casefold().split())


def photos_below(folder: Path) -> list[Path]:
    """All files with the ending of a picture below a folder, sorted."""
    found = (Path(top) / name for top, _, names in os.walk(folder) for name in names)
    return sorted(path for path in found if path.suffix.lower() in SUFFIXES)


def photos_beside(folder: Path, used: Iterable[Path], masks: Iterable[Path | None]) -> list[Path]:
    """Photos in the folders of a capture that the capture does not list.

    Pictures made of a photo do not count: their names begin with its name, as ``r_0_depth_0001.png`` with ``r_0``.
    """
    used = set(used)
    inside = [path.relative_to(folder).parts for path in used if path.is_relative_to(folder)]
    known, stems = used.union(masks), {path.with_suffix("") for path in used}
    beside = set(folder.iterdir()) if any(len(parts) == 1 for parts in inside) else set()
    for top in {parts[0] for parts in inside if len(parts) > 1}:
        beside |= set(photos_below(folder / top))

    def made(path: Path) -> bool:
        ends = (k for k, letter in enumerate(path.name) if letter in "_.")
        return any(path.with_name(path.name[:k]) in stems for k in ends if k)

    return sorted(path for path in beside - known if path.suffix.lower() in SUFFIXES and not made(path))


def is_turned(size: tuple[int, int], orientation: int, wanted: tuple[float, float]) -> bool | None:
    """Whether a camera describes the photo as rotated by its EXIF tag; None if sizes do not tell.

    Args:
        size: Width and height of the pixels in the file.
        orientation: The tag, 1 to 8.
        wanted: Width and height of the camera, to less than a pixel.
    """
    if orientation == 1:
        return False
    turned = turned_size(size, orientation)
    stored, fits = (max(abs(a - b) for a, b in zip(s, wanted, strict=True)) < 1 for s in (size, turned))
    return None if stored and fits else fits


def turned_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Width and height after the rotation of an EXIF tag."""
    return size[::-1] if orientation >= 5 else size
