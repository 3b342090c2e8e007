"""The folder of a training run. It is taken when training starts, so that a run that is refused changes nothing."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from gaussian_swaying._files import remove_temporaries
from gaussian_swaying.runs.folder import claim_folder, hold_folder
from gaussian_swaying.runs.lock import FolderLock


def default_loggers(folder: Path) -> list[Logger]:
    """A CSV file, beside one that is there, and, if tensorboard is installed, its event files, all in ``folder``."""
    version = None if (folder / "csv/metrics.csv").exists() else ""
    loggers: list[Logger] = [CSVLogger(folder, "csv", version, flush_logs_every_n_steps=1)]
    if any(importlib.util.find_spec(name) is not None for name in ("tensorboard", "tensorboardX")):
        loggers.append(TensorBoardLogger(folder, "tensorboard"))
    return loggers


class RunFolder(Callback):
    """Locks the folder of a training run, moves an earlier run in it aside, and writes a checkpoint at the end.

    ``begun`` once the folder was taken; then ``newest`` gives the last checkpoint, and if there are to be ``loggers``,
    :func:`default_loggers` are made.
    """

    def __init__(self) -> None:
        self.loggers, self.begun = False, False
        self.save_config: Callable[[Path], None] = lambda folder: None
        self.newest: Callable[[], str | None] = lambda: None
        self._lock: FolderLock | None = None

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        root, first = Path(trainer.default_root_dir), trainer.is_global_zero
        try:
            if first:  # of several processes
                self._lock = _take(root, trainer, pl_module.init_ply)
        finally:
            trainer.strategy.barrier()
        if self.loggers:
            trainer.loggers = default_loggers(root)
            for logger in trainer.loggers:
                _ = logger.experiment  # before the configuration lies in its folder, which Lightning would warn of
        place = Path(trainer.log_dir or root)  # the processes agree on it
        if first:
            self.save_config(place)
        self.begun, self.newest = True, pl_module.last_checkpoint

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        """Write a checkpoint after the last image, if ``every_n_train_steps`` does not divide their number."""
        kept = trainer.checkpoint_callback
        if kept is not None and kept._last_global_step_saved != trainer.global_step:
            trainer.save_checkpoint(Path(kept.dirpath) / f"step_{trainer.global_step:06d}.ckpt")

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        self._release()

    def teardown(self, trainer: Any, pl_module: Any, stage: str) -> None:
        self._release()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()


def _take(root: Path, trainer: Any, init_ply: str | None) -> FolderLock:
    remedy, continued = "choose another with --trainer.default_root_dir", trainer.ckpt_path
    if continued is None or not Path(continued).resolve().is_relative_to(root.resolve()):
        in_use = [path for path in (getattr(trainer.datamodule, "path", None), init_ply, continued) if path]
        return claim_folder(root, ["point_cloud.ply", "checkpoints"], remedy, [Path(str(path)) for path in in_use])
    lock = hold_folder(root, remedy)
    remove_temporaries(root)
    return lock
