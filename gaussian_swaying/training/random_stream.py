"""The state of the random generators of the CPU and of one device."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

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


@contextmanager
def random_stream(held: dict[str, Tensor], device: torch.device, seed: int) -> Iterator[None]:
    """Draw random numbers from a separate stream, and leave those of others as they were.

    Args:
        held: The state of the stream, by :func:`random_state`; updated at the end. Empty before its start.
        device: The device.
        seed: Seed of the stream.
    """
    outside = random_state(device)
    if held:
        set_random_state(held, device)
    else:
        torch.manual_seed(seed)
    try:
        yield
    finally:
        held.update(random_state(device))
        set_random_state(outside, device)
