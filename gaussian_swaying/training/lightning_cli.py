"""Lightning's command line with a folder for each run, and counts of images where several devices train."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from jsonargparse import Namespace
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar, TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from gaussian_swaying._checks import first_line
from gaussian_swaying._files import atomic
from gaussian_swaying.runs.saved import load_plain
from gaussian_swaying.training.module import SplatParallel
from gaussian_swaying.training.parallel import steps_of
from gaussian_swaying.training.run_folder import RunFolder, default_loggers

TRAINER_DEFAULTS: dict[str, Any] = {
    "max_steps": 60_000,
    "max_epochs": -1,  # training counts images, not epochs
    "accelerator": "cuda" if torch.cuda.is_available() else "cpu",
    "devices": 1,
    "check_val_every_n_epoch": None,
    "num_sanity_val_steps": 0,
    "enable_model_summary": False,
    "default_root_dir": "outputs/train/run",
}
"""Defaults of ``tools/train.py``."""
CHECKPOINT_DEFAULTS = {"filename": "step_{step:06d}", "auto_insert_metric_name": False, "every_n_train_steps": 1000}


class TrainCLI(LightningCLI):
    """LightningCLI with a :class:`RunFolder`, which counts images where several devices train."""

    def __init__(self, *settings: Any, run_folder: RunFolder | None = None, **more: Any) -> None:
        self.run_folder = run_folder or RunFolder()
        super().__init__(*settings, **more)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults({f"checkpoint.{name}": value for name, value in CHECKPOINT_DEFAULTS.items()})

    def _chosen(self, config: Namespace) -> Namespace:
        part: Namespace = config.get(str(self.subcommand), config)
        return part

    def before_instantiate_classes(self) -> None:
        """Turn numbers of images into numbers of Lightning's steps, each of which takes an image on every device."""
        self.asked = self.config.clone()
        settings = self._chosen(self.config)
        trainer, checkpoint = settings["trainer"], settings.get("checkpoint")
        machines = {name: trainer[name] for name in ("accelerator", "devices", "num_nodes")}
        self.several = machines["devices"] not in (None, 1, "1") or machines["num_nodes"] not in (None, 1)
        if self.several:
            quiet: dict[str, Any] = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
            devices = Trainer(**machines, **quiet).world_size
            counts = ((trainer, "max_steps"), (trainer, "val_check_interval"), (checkpoint, "every_n_train_steps"))
            for part, name in counts:
                if part is not None and isinstance(part[name], int) and part[name] > 0:
                    part[name] = steps_of(part[name], devices)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Make the trainer, with loggers that begin once the folder is taken."""
        settings = self._chosen(self.config_init)["trainer"]
        self.run_folder.save_config = self._save_config
        if settings.get("logger") in (None, True):
            self.run_folder.loggers = self.subcommand in (None, "fit")
            kwargs["logger"] = not self.run_folder.loggers and default_loggers(Path(settings["default_root_dir"]))
        callbacks = [*(settings.get("callbacks") or []), self.run_folder]
        if settings.get("enable_progress_bar") is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            callbacks.append(TQDMProgressBar(refresh_rate=20))  # Lightning would redraw it after every image
        kwargs["callbacks"] = callbacks
        if self.several:
            kwargs["use_distributed_sampler"] = False  # the data know which images are whose
            if settings.get("strategy") in (None, "auto", "ddp"):
                kwargs["strategy"] = SplatParallel()
        return super().instantiate_trainer(**kwargs)

    def _save_config(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with atomic(folder / "config.yaml") as temporary:
            parser, config = self._parser(self.subcommand), self._chosen(self.asked)
            parser.save(config, temporary, skip_unset=False, overwrite=True, multifile=False)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        super().parse_arguments(parser, args)
        path = (self.config.get(self.config.get("subcommand") or "") or {}).get("ckpt_path")
        if path is not None and (Path(str(path)).suffix or os.path.lexists(path)):  # not best, last ...
            try:
                if not isinstance(load_plain(Path(str(path))).get("splat_training"), dict):
                    raise ValueError("it is not a checkpoint of this package")
            except Exception as error:
                told = f"cannot be read as a checkpoint ({first_line(error).rstrip('.')}): give another `--ckpt_path`."
                raise ValueError(f"{path} {told}") from error

    def after_fit(self) -> None:
        if not self.run_folder.begun:
            done, wanted = (n * self.trainer.world_size for n in (self.trainer.global_step, self.trainer.max_steps))
            raise ValueError(
                f"The run has already trained on {done} images, and `trainer.max_steps` is {wanted}: raise it."
            )
