"""Several images in one step of Lightning, which still counts images.

Lightning's work around a step (hooks, loggers, its data fetcher) takes as long as a tenth of a small image. With the
iterator of the data as argument of ``training_step`` a step may train on several images. Here they are added to all
counters of Lightning, so that steps, checkpoints, validation and a resumed run are those of one image at a time.
"""

from __future__ import annotations

import math
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from gaussian_swaying.training.parallel import steps_of

_INNER_HOOKS = ("on_before_backward", "on_after_backward", "on_before_optimizer_step", "on_before_zero_grad")


def images_until_hooks(trainer: Trainer, every: int) -> int:
    """Return the number of images to train on before Lightning's hooks are called.

    Hooks come at multiples of ``every``, and wherever Lightning has something to do: the last image, a checkpoint, a
    validation, the end of an epoch. On several devices each trains on so many images, and all call the hooks together.

    Args:
        trainer: The trainer, at the start of a step.
        every: Most images between two calls, of all devices together (rounded up).
    """
    every = steps_of(every, trainer.world_size)
    seen = trainer.global_step
    ends = [every - seen % every]
    if trainer.max_steps > 0:
        ends.append(trainer.max_steps - seen)
    for callback in trainer.checkpoint_callbacks:
        steps = callback._every_n_train_steps if isinstance(callback, ModelCheckpoint) else 1
        if steps > 0:
            ends.append(steps - seen % steps)
    loop = trainer.fit_loop.epoch_loop
    # the loop has counted the first of the images already
    in_epoch, in_all = loop.batch_progress.current.ready - 1, loop.batch_progress.total.ready - 1
    if math.isfinite(trainer.num_training_batches):
        ends.append(int(trainer.num_training_batches) - in_epoch)
    if math.isfinite(trainer.val_check_batch or math.inf):
        batches = int(trainer.val_check_batch)  # type: ignore[arg-type]
        ends.append(batches - (in_all if trainer.check_val_every_n_epoch is None else in_epoch) % batches)
    return max(min(ends), 1)


def count_further_image(trainer: Trainer) -> None:
    """Count an image that is not the first of its step as a batch; Lightning counts only the first."""
    loop = trainer.fit_loop.epoch_loop
    counted = loop.batch_progress
    for count in (counted.increment_ready, counted.increment_started, counted.increment_processed):
        count()
    counted.increment_completed()
    loop._batches_that_stepped += 1


def number_batch(trainer: Trainer, dataloader_iter: Any) -> None:
    """Tell the hooks after this step the number of its last image; Lightning would restart with 0 in a resumed run."""
    fetcher = getattr(dataloader_iter, "data_fetcher", None)
    if fetcher is not None:
        fetcher._batch_idx = trainer.fit_loop.epoch_loop.batch_idx


def inner_hooks_used(trainer: Trainer, module: Any) -> bool:
    """True if a callback or the module has a hook within a step, such as one at each backward pass."""
    if any(getattr(type(module), name) is not getattr(LightningModule, name) for name in _INNER_HOOKS):
        return True
    return any(
        getattr(type(callback), name) is not getattr(Callback, name)
        for callback in trainer.callbacks  # type: ignore[attr-defined]
        for name in _INNER_HOOKS
    )
