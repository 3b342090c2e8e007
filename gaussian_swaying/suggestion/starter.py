"""Files of a first configuration, beside others that may have been edited."""

from __future__ import annotations

from pathlib import Path

from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.suggestion.suggestion import Suggestion, configuration


def write_starter(found: Suggestion, folder: Path, frames: int) -> list[str]:
    """Write the configuration and its parts; keep earlier ones aside, as they may have been edited."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = (folder / "parts.npz").resolve()
    assert found.path is not None
    keep_aside(folder / "starter.yaml", configuration(found, found.path, parts, frames))
    if found.parts is not None and parts.exists() and not _same(parts, found.parts.parts):
        _rename(parts)
    found.to_yaml(folder / "starter.yaml", frames)
    return [*(["parts.npz"] if found.parts is not None else []), "starter.yaml"]


def keep_aside(path: Path, text: str) -> None:
    """Rename a file with other content, as it may have been edited: ``fit.yaml`` to ``fit.1.yaml``, and so on."""
    if path.exists() and path.read_text(encoding="utf-8") != text:
        _rename(path)


def _same(file: Path, parts: Parts) -> bool:
    try:
        return Parts.load(file).digest() == parts.digest()
    except ValueError:
        return False


def _rename(path: Path) -> None:
    number = 1
    while (other := path.with_suffix(f".{number}{path.suffix}")).exists():
        number += 1
    path.rename(other)
