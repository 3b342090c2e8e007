"""The folder of a training run. It is taken with the first image, so that a run that is refused changes nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger

from gaussian_swaying._files import remove_temporaries
from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder, mark
from gaussian_swaying.runs.lock import FolderLock

_FOLDERS = ["checkpoints", "panels", "csv", "tensorboard"]
_OURS = ["point_cloud.ply", *_FOLDERS]


class RunFolder(Callback):
    """Locks the folder of a training run from the first image to the end.

    An earlier run in it is moved aside, unless this run resumes from a checkpoint in it. Loggers are made and the
    configuration is written only after that.

    Attributes:
        root: The folder, ``trainer.default_root_dir``.
        loggers: Function that makes the loggers; None if the trainer has loggers.
        save_config: Function that writes the configuration to a folder.
        begun: Whether the folder is taken.
        keep: Lock it until :meth:`release`, not only to the end of Lightning's part.
    """

    def __init__(self) -> None:
        self.root = Path()
        self.loggers: Callable[[], list[Logger]] | None = None
        self.save_config: Callable[[Path], None] | None = None
        self.begun = self.keep = False
        self._locks: list[FolderLock] = []
        self._newest: Callable[[], str | None] = lambda: None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Take the folder before training on the first image."""
        self._begin(trainer, pl_module)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The same for a resumed run that validates first; a folder only for results is marked as ours."""
        if trainer.state.fn != "fit":
            self._mark(pl_module)
        elif not trainer.sanity_checking:
            self._begin(trainer, pl_module)

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Mark a folder only for results as ours."""
        self._mark(pl_module)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.release()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if not self.keep:
            self.release()

    def release(self) -> None:
        for lock in self._locks:
            lock.release()
        self._locks = []

    def newest_checkpoint(self) -> str | None:
        """The last checkpoint of a started run, or the one that it resumed; None if there is none."""
        return self._newest()

    def _mark(self, pl_module: Any) -> None:
        for folder in {self.root, pl_module.folder}:
            taken = any(os.path.lexists(folder / name) for name in (MARKER, *_OURS))
            if not taken and pl_module.trainer.is_global_zero:
                folder.mkdir(parents=True, exist_ok=True)
                mark(folder)

    def _begin(self, trainer: Any, pl_module: Any) -> None:
        if self.begun:
            return
        if trainer.world_size > 1:
            try:  # the first of several processes takes the folder
                if trainer.is_global_zero:
                    self._take_all(trainer, pl_module)
            finally:
                trainer.strategy.barrier()
        else:
            self._take_all(trainer, pl_module)
        if self.loggers is not None:
            trainer.loggers = self.loggers()
        place = Path(trainer.log_dir or self.root)  # the processes agree on it
        if self.save_config is not None and trainer.is_global_zero:
            self.save_config(place)
        self.begun = True
        self._newest = pl_module.last_checkpoint

    def _take_all(self, trainer: Any, pl_module: Any) -> None:
        continued = None if trainer.ckpt_path is None else Path(str(trainer.ckpt_path))
        in_use = [getattr(trainer.datamodule, "path", None), pl_module.init_ply, continued]
        for folder, option in _apart({pl_module.folder: "--model.output", self.root: "--trainer.default_root_dir"}):
            self._locks.append(_take(folder, option, continued, [Path(str(path)) for path in in_use if path]))


def _apart(options: dict[Path, str]) -> list[tuple[Path, str]]:
    """The folders, outer ones first, without those inside another."""
    kept: list[tuple[Path, str]] = []
    for folder in sorted(options, key=lambda folder: len(folder.resolve().parts)):
        if not any(folder.resolve().is_relative_to(other.resolve()) for other, _ in kept):
            kept.append((folder, options[folder]))
    return kept


def _take(folder: Path, option: str, continued: Path | None, in_use: Sequence[Path]) -> FolderLock:
    remedy = f"choose another with {option}"
    if continued is None or not continued.resolve().is_relative_to(folder.resolve()):
        return claim_folder(folder, _OURS, remedy, in_use)
    lock = hold_folder(folder, remedy)
    for name in (".", *_FOLDERS):
        remove_temporaries(folder / name)
    return lock
