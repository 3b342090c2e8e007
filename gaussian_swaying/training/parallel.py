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

    Args:
        parameters: The parameters; their gradients are replaced.
        loss: The loss of this device, a scalar.

    Returns:
        The mean loss, so that all devices stop if one of them diverges.
    """
    mean = loss.detach().clone()
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad.contiguous()
    shared = [mean, *(parameter.grad for parameter in parameters if parameter.grad is not None)]
    work = [distributed.all_reduce(tensor, async_op=True) for tensor in shared]
    for part in work:
        part.wait()
    torch._foreach_div_(shared, float(distributed.get_world_size()))
    return mean


def sum_over_devices(tensors: Sequence[Tensor]) -> None:
    """Sum tensors over all devices, in place; nothing happens with one device."""
    if several_devices():
        for tensor in tensors:
            distributed.all_reduce(tensor)


def seen_by_any(seen: Tensor) -> Tensor:
    """Return a mask of the Gaussians in the picture of at least one device.

    Args:
        seen: Those in the picture of this device, bool (N,).
    """
    if not several_devices():
        return seen
    found = seen.to(torch.uint8)
    distributed.all_reduce(found, distributed.ReduceOp.MAX)
    return found.bool()


def several_devices() -> bool:
    """True if this process is one of several that train together."""
    return distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1


def this_device() -> tuple[int, int]:
    """Number of this process, and how many there are."""
    return (distributed.get_rank(), distributed.get_world_size()) if several_devices() else (0, 1)


def check_alike(parameters: Sequence[Tensor]) -> None:
    """Raise RuntimeError if the devices do not have the same parameters any more."""
    if not several_devices():
        return
    flat = [parameter.detach().double().flatten() for parameter in parameters]
    sums = [(values * torch.arange(1, len(values) + 1, device=values.device)).sum() for values in flat]  # with places
    own = torch.stack([sums[0].new_tensor(len(parameters[0])), *sums])
    found = [torch.empty_like(own) for _ in range(distributed.get_world_size())]
    distributed.all_gather(found, own)
    if any(not torch.equal(other, own) for other in found):
        raise RuntimeError(
            "The devices no longer hold the same Gaussians, which must not happen: please report it, and continue from "
            "the last checkpoint or with `trainer.devices: 1`."
        )


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
