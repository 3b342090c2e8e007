"""A checksum at the end of a file, so that a file with even one changed bit is noticed."""

from __future__ import annotations

import hashlib
import os
import pickle
import re
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying._files import atomic, check_not_taken

_TRAILER = re.compile(rb"\ngaussian_swaying sha256 ([0-9a-f]{64})\n")
_LENGTH = len(b"\ngaussian_swaying sha256 \n") + 64
_BLOCK = 1 << 20


def sha256(path: Path, size: int | None = None) -> str:
    """SHA-256 of a file, or of its first ``size`` bytes, in hexadecimal."""
    left = os.path.getsize(path) if size is None else size
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while left > 0 and (block := file.read(min(_BLOCK, left))):
            digest.update(block)
            left -= len(block)
    return digest.hexdigest()


def seal(path: Path) -> None:
    """Append the checksum of a file to it; ``torch.load`` still reads the file."""
    digest = sha256(path)
    with path.open("ab") as file:
        file.write(b"\ngaussian_swaying sha256 " + digest.encode() + b"\n")


def save_sealed(path: Path, value: Any) -> None:
    """Write what ``torch.load`` reads, with its checksum, whole or not at all."""
    with atomic(path) as temporary:
        torch.save(value, temporary)
        seal(temporary)


def check_seal(path: Path) -> None:
    """Raise ValueError unless a file ends with the checksum of everything before it."""
    check_not_taken(path)
    size = max(os.path.getsize(path) - _LENGTH, 0)
    with path.open("rb") as file:
        file.seek(size)
        found = _TRAILER.fullmatch(file.read())
    if found is None:
        raise ValueError("it has no checksum at its end, so it is incomplete or was not written by this package")
    if sha256(path, size).encode() != found[1]:
        raise ValueError("its checksum does not match its content, so it is damaged")


def load_sealed(path: Path, map_location: Any = "cpu") -> Any:
    """Read what :func:`save_sealed` wrote; no code in the file is executed.

    Args:
        path: The file.
        map_location: Device of its tensors, as for ``torch.load``.
    """
    check_seal(path)
    try:
        return torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError:  # PyTorch's own message says how to execute what is in the file
        raise ValueError("it holds more than tensors, numbers and text, which is never loaded") from None
