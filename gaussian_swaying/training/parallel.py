"""Training on several devices: every device has all Gaussians and its own image, and they share their gradients.

A step then takes as many images as there are devices, so there are fewer steps, with larger learning rates (as in
Grendel, Zhao et al. 2024, arXiv 2406.18533: rates times the square root of the images in a step, and the momenta of as
many steps). All devices compute the same parameters to the bit, so any of them can write the splat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, distributed, nn


def share_gradients(parameters: Sequence[nn.Parameter], loss: Tensor) -> Tensor:
    """Average the gradients over all devices; a parameter without a gradient counts as zero.

    Returns:
        The mean loss, so that all devices stop if one of them diverges.
    """
    shared = [loss.detach().clone()]
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad.contiguous()
        shared.append(parameter.grad)
    sum_over_devices(shared)
    torch._foreach_div_(shared, float(this_device()[1]))
    return shared[0]


def sum_over_devices(tensors: Sequence[Tensor]) -> None:
    """Sum tensors over all devices, in place; nothing happens with one device."""
    if this_device()[1] > 1:
        for tensor in tensors:
            distributed.all_reduce(tensor)


def this_device() -> tuple[int, int]:
    """Number of this process, and how many there are."""
    several = distributed.is_available() and distributed.is_initialized()
    return (distributed.get_rank(), distributed.get_world_size()) if several else (0, 1)


def scaled_adam(rate: float, devices: int) -> dict[str, Any]:
    """Options of Adam for a step of several images: learning rate, momenta and epsilon."""
    return {
        "lr": rate * math.sqrt(devices),
        "betas": (max(0.0, 1 - devices * (1 - 0.9)), max(0.0, 1 - devices * (1 - 0.999))),
        "eps": 1e-15 / math.sqrt(devices),
    }


def steps_of(images: int, devices: int) -> int:
    """Steps that take so many images, rounded up."""
    return -(-images // devices)
