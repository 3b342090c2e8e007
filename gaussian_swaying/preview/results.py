"""The result of a preview, and its files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying.gaussians.parts import Parts


@dataclass(frozen=True)
class Preview:
    """All results, before anything is written.

    Attributes:
        report: Text for the user.
        data: The same as plain numbers, for preview.json.
        picture: 8-bit RGB, shape (H, W, 3).
        starter: The first configuration, as YAML; empty with ``--config``.
        things: What may move in a capture of a place, 8-bit RGB, shape (H, W, 3); None for an object.
        parts: The parts of the object; None if there is only one.
    """

    report: str
    data: dict[str, Any]
    picture: np.ndarray
    starter: str = ""
    things: np.ndarray | None = None
    parts: Parts | None = None


def splat_name(path: str | Path) -> str:
    """The name of a splat: that of its file, or of the folder of ``point_cloud.ply`` (training) or ``meta.json`` (SOG).

    Folders ``iteration_30000`` and ``point_cloud``, as 3DGS makes them, are skipped.
    """
    file = Path(path)
    if file.stem not in ("point_cloud", "meta", "lod-meta"):
        return file.stem
    folders = [part.name for part in file.resolve().parents]
    passed = ("point_cloud", "iteration_")
    return next((name for name in folders if name and not name.startswith(passed)), file.stem)


def write(preview: Preview, folder: Path) -> list[Path]:
    """Write preview.json and preview.png, and if there are any, things.png, parts.npz and starter.yaml.

    An existing configuration that differs is kept as ``starter.1.yaml``, ``starter.2.yaml``, ..., since it may have
    been edited; and so are parts.

    Returns:
        The files.
    """
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "preview.json", folder / "preview.png"]
    files[0].write_text(json.dumps(preview.data, indent=1) + "\n", encoding="utf-8")
    iio.imwrite(files[1], preview.picture)
    if preview.things is not None:
        files.append(folder / "things.png")
        iio.imwrite(files[-1], preview.things)
    if preview.parts is not None:
        path = folder / "parts.npz"
        if path.exists() and not _same(path, preview.parts):
            path.rename(_unused(folder, "parts", "npz"))
        files.append(preview.parts.save(path))
    if preview.starter:
        path = folder / "starter.yaml"
        keep_aside(path, preview.starter)
        path.write_text(preview.starter, encoding="utf-8")
        files.append(path)
    return files


def keep_aside(path: Path, text: str) -> None:
    """Rename a file that has another text, as it may have been edited: ``fit.yaml`` to ``fit.1.yaml``, and so on."""
    if path.exists() and path.read_text(encoding="utf-8") != text:
        path.rename(_unused(path.parent, path.stem, path.suffix[1:]))


def _same(path: Path, parts: Parts) -> bool:
    try:
        return Parts.load(path).digest() == parts.digest()
    except ValueError:
        return False


def _unused(folder: Path, name: str, suffix: str) -> Path:
    """The first of ``name.1.suffix``, ``name.2.suffix``, ... that does not exist."""
    number = 1
    while (folder / f"{name}.{number}.{suffix}").exists():
        number += 1
    return folder / f"{name}.{number}.{suffix}"
