"""Lightning's strategy for training on several devices, see :mod:`~gaussian_swaying.training.parallel`."""

from __future__ import annotations

from typing import Any

from lightning.pytorch.strategies import DDPStrategy

from gaussian_swaying.training.parallel import steps_of


class SplatParallel(DDPStrategy):
    """Lightning's DDP without its wrapper, which would keep the Gaussians of the start.

    Densification replaces them, so :class:`~gaussian_swaying.training.module.SplatTrainer` shares the gradients itself.
    """

    def configure_ddp(self) -> None:
        """Nothing is wrapped."""


def count_steps(trainer: Any) -> None:
    """Turn the numbers of images of a trainer into numbers of steps, each of which takes an image on every device.

    Args:
        trainer: A trainer before its first step.

    Raises:
        ValueError: If it has another strategy for several devices.
    """
    devices = trainer.world_size
    if devices == 1:
        return
    if not isinstance(trainer.strategy, SplatParallel):
        raise ValueError(
            "Expected `trainer.strategy` to be auto, or SplatParallel in Python, for several devices, but got "
            f"{type(trainer.strategy).__name__}: Lightning's own ones keep the Gaussians of the start."
        )
    trainer.fit_loop.epoch_loop.max_steps = steps_of(trainer.max_steps, devices)
    if isinstance(trainer.val_check_interval, int):
        trainer.val_check_interval = steps_of(trainer.val_check_interval, devices)
    for callback in trainer.checkpoint_callbacks:
        every = getattr(callback, "_every_n_train_steps", 0)
        if every:
            callback._every_n_train_steps = steps_of(every, devices)


__all__ = ["SplatParallel", "count_steps"]
