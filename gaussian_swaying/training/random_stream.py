"""The state of the random generators of the CPU and of one device."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def mixed_seed(*numbers: int) -> int:
    """A seed made from several numbers."""
    found = 0
    for number in numbers:
        found = (found * 1_000_003 + number + 1) % 2**63
    return found


def random_state(device: torch.device) -> dict[str, Tensor]:
    """The states of the generators of the CPU and, if the device is a GPU, of the device."""
    state = {"cpu": torch.get_rng_state()}
    return state | {"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else state


def set_random_state(state: Mapping[str, Tensor], device: torch.device) -> None:
    """Restore the states from :func:`random_state`."""
    torch.set_rng_state(state["cpu"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
