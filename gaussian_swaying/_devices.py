"""Devices without double precision: where its numbers live then, and how modules move there.

Apple's GPUs (``mps``) compute in single precision only. Numbers that need double precision, such as times, sums over
many substeps and places far from the origin, stay on the CPU there. Everywhere else they are on the device.
"""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor, nn

ModuleT = TypeVar("ModuleT", bound=nn.Module)


def double_home(device: torch.device | str) -> torch.device:
    """The device for the numbers in double precision of a computation on ``device``.

    Example:
        >>> double_home("cuda"), double_home("mps")
        (device(type='cuda'), device(type='cpu'))
    """
    device = torch.device(device)
    return torch.device("cpu") if device.type == "mps" else device


def in_double(tensor: Tensor) -> Tensor:
    """A tensor in float64: on its device, or on the CPU if its device has no double precision. Same shape."""
    return tensor.to(double_home(tensor.device), torch.float64)


def sum_in_double(tensor: Tensor, dim: int) -> Tensor:
    """The sum along an axis in float64: on the tensor's device, or of its values on the CPU, as :func:`in_double`."""
    return tensor.to(double_home(tensor.device)).sum(dim, dtype=torch.float64)


def on_device(tensor: Tensor, device: torch.device | str) -> Tensor:
    """A tensor on a device, or on the CPU if it is float64 and the device has none."""
    return tensor.to(double_home(device) if tensor.dtype == torch.float64 else device)


def move(module: ModuleT, device: torch.device | str) -> ModuleT:
    """As ``module.to(device)``, but buffers in float64 go to :func:`double_home`; returns the module."""
    return module._apply(lambda tensor: on_device(tensor, device))


__all__ = ["double_home", "in_double", "move", "on_device", "sum_in_double"]
