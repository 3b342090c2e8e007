"""Files that are written completely or not at all: first under a temporary name, then renamed."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

PNG: dict[str, Any] = {"compress_level": 1, "compress_type": zlib.Z_RLE}
"""Options with which pictures are compressed: in two thirds of the time of zlib's level 3, and smaller."""

_TEMPORARY = re.compile(r"\..+\.gs-writing-\d+(\.[A-Za-z0-9_]+)?")


def temporary_name(path: Path) -> Path:
    """Temporary name in the same folder under which this process writes ``path`` until it is complete."""
    return path.with_name(f".{path.stem}.gs-writing-{os.getpid()}{path.suffix}")


def remove_temporaries(folder: Path) -> None:
    """Remove temporary files (see :func:`temporary_name`) that a killed process left behind; all other files stay."""
    for path in folder.glob(".*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file():
            path.unlink()


def check_page(path: Path, what: str) -> None:
    """Raise ValueError if a page cannot be written to a path: its name ends in .html, and its folder exists."""
    if path.suffix.lower() != ".html":
        raise ValueError(f"Expected the name of a {what} to end in .html, but got {path}.")
    if not path.parent.is_dir():
        raise ValueError(f"The folder {path.parent} of the {what} does not exist: make it, or name another one.")


def sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; it becomes ``path`` if the block succeeds and is removed if not.

    An error of the system names the path that was asked for.
    """
    temporary = temporary_name(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Folder of the compiled kernels: ``GAUSSIAN_SWAYING_CACHE``, or ``gaussian_swaying`` where caches are kept."""
    given = os.environ.get("GAUSSIAN_SWAYING_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Path(base) / "gaussian_swaying"


def save_png(path: Path, pixels: np.ndarray) -> None:
    """Write a picture, uint8 (H, W, 3) or uint16 (H, W), as PNG; imageio would load all formats that Pillow knows."""
    from PIL import Image

    Image.fromarray(pixels).save(path, "PNG", **PNG)


def is_blank(pixels: np.ndarray) -> bool:
    """True if all pixels of a picture (H, W, ...) are the same."""
    return all(bool((part == pixels[0, 0]).all()) for part in (pixels[::16, ::16], pixels))


def write_text(path: Path, text: str) -> None:
    """Write text in UTF-8, completely or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON, completely or not at all; NaN and infinity, which JSON does not have, become null."""
    write_text(path, json.dumps(without_nan(value), indent=2, allow_nan=False) + "\n")


def without_nan(value: Any) -> Any:
    """The same with None for numbers that JSON does not have: NaN and infinity."""
    if isinstance(value, dict):
        return {name: without_nan(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write dicts as CSV with a header, completely or not at all; missing values stay empty."""
    names = list({name: None for row in rows for name in row})
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)
