"""Loads in a thread what a GPU needs before the first frame, while the processor builds the scene."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import torch

from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.rendering.gsplat_renderer import load_kernels, loaded_before


def load_ahead(device: torch.device) -> Callable[[], None]:
    """Begin to load what a device needs, in a thread: its context, Triton's compiler and gsplat's kernels.

    What cannot be loaded is left to those who need it, who meet the error. Nothing is compiled that takes long.

    Args:
        device: The device of a simulation; only a CUDA device needs anything.

    Returns:
        A function that waits for the end; call it before the device is used, as no other thread may use it while a
        graph is recorded.
    """
    if device.type != "cuda":
        return lambda: None
    current = torch.cuda.current_device() if torch.cuda.is_initialized() else 0  # a new thread begins with the first
    number = current if device.index is None else device.index
    thread = threading.Thread(target=_load, args=(number,), name="load-ahead")
    thread.start()
    return thread.join


def _load(number: int) -> None:
    for step in (
        lambda: torch.empty(1, device="cuda"),
        lambda: compiles("cuda"),
        lambda: loaded_before() and load_kernels(),
    ):
        with suppress(Exception), torch.cuda.device(number):
            step()
