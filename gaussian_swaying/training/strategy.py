"""Lightning's strategy for training on several devices, see :mod:`~gaussian_swaying.training.parallel`."""

from __future__ import annotations

from typing import Any

from lightning.pytorch.strategies import DDPStrategy


class SplatParallel(DDPStrategy):
    """Lightning's DDP without its wrapper, which would keep the Gaussians of the start.

    Densification replaces them, so :class:`~gaussian_swaying.training.module.SplatTrainer` shares the gradients itself.
    """

    def configure_ddp(self) -> None:
        """Nothing is wrapped."""


def check_strategy(trainer: Any) -> None:
    """Raise ValueError if a trainer of several devices has another strategy."""
    if trainer.world_size > 1 and not isinstance(trainer.strategy, SplatParallel):
        raise ValueError(
            "Expected `trainer.strategy` to be auto, or SplatParallel in Python, for several devices, but got "
            f"{type(trainer.strategy).__name__}: Lightning's own ones keep the Gaussians of the start."
        )
