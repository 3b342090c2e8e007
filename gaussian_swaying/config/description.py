"""The arguments of a simulation as plain data, so that two that differ can be told apart, also if made in Python."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn


def describe(value: Any) -> Any:
    """Class and values of an argument, down to numbers and text.

    Args:
        value: A number, text, tensor, list, mapping, dataclass, module or any other object with public attributes.

    Returns:
        Plain data for YAML; a tensor becomes its shape and a checksum. Equal values give equal data, in every process.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Tensor):
        held = value.detach().cpu().contiguous()
        return {"shape": list(held.shape), "sha256": hashlib.sha256(held.numpy().tobytes()).hexdigest()}
    if isinstance(value, Mapping):
        return {str(name): describe(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [describe(part) for part in value]
    if isinstance(value, type) or not (hasattr(value, "__dict__") or dataclasses.is_dataclass(value)):
        return getattr(value, "__qualname__", repr(value))
    return {"class": f"{type(value).__module__}.{type(value).__qualname__}", **_parts(value)}


def _parts(value: Any) -> dict[str, Any]:
    """The public attributes of an object, and the tensors and parts of a module."""
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        parts = {name: part for name, part in vars(value).items() if not name.startswith("_") and name != "training"}
    if isinstance(value, nn.Module):
        parts |= dict(value.named_parameters(recurse=False)) | dict(value.named_buffers(recurse=False))
        parts |= dict(value.named_children())
    return {name: describe(part) for name, part in sorted(parts.items())}
