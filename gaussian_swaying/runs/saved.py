"""Files of tensors, numbers and text, which are written whole or not at all; no code in them is executed."""

from __future__ import annotations

import errno
import pickle
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying._checks import first_line
from gaussian_swaying._files import atomic


def save_whole(path: Path, value: Any) -> None:
    """Save tensors for ``torch.load``, whole or not at all."""
    try:
        with atomic(path) as temporary:
            torch.save(value, temporary)
    except RuntimeError as error:  # PyTorch's writer names neither the file nor the cause
        raise OSError(errno.ENOSPC, f"the disk may be full: {first_line(error)}", str(path)) from error


def load_plain(path: Path, map_location: Any = "cpu") -> Any:
    """Read a file of :func:`save_whole`.

    Args:
        map_location: Device of its tensors, as for ``torch.load``.
    """
    try:
        return torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError:  # PyTorch's own message says how to execute what is in the file
        raise ValueError("it holds more than tensors, numbers and text, which is never loaded") from None
