"""The command line for training: ``fit``, ``validate`` and ``test`` of Lightning, adapted to splats."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jsonargparse import Namespace
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar, TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.plugins.io import CheckpointIO
from lightning.pytorch.utilities.exceptions import MisconfigurationException

import gaussian_swaying.training.data.datamodule  # noqa: F401
import gaussian_swaying.training.data.generated_datamodule  # noqa: F401
import gaussian_swaying.training.densification  # noqa: F401
import gaussian_swaying.training.losses  # noqa: F401
from gaussian_swaying import _program as program
from gaussian_swaying._files import atomic
from gaussian_swaying._yaml_limits import limit_yaml
from gaussian_swaying.cli.errors import command, guessing, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.material_names import with_named_materials
from gaussian_swaying.config.parser import with_lists
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.training.checkpoints import PlainCheckpoints, read_training_checkpoint
from gaussian_swaying.training.csv_log import CsvLog
from gaussian_swaying.training.finite import TrainingDiverged
from gaussian_swaying.training.module import SplatTrainer
from gaussian_swaying.training.parallel import steps_of
from gaussian_swaying.training.quiet import silence_advertisements, silence_warnings
from gaussian_swaying.training.run_folder import RunFolder
from gaussian_swaying.training.strategy import SplatParallel

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


def default_loggers(folder: Path) -> list[Logger]:
    """A CSV file and, if tensorboard is installed, its event files, all in ``folder``."""
    loggers: list[Logger] = [CsvLog(folder / "csv")]
    if any(importlib.util.find_spec(name) is not None for name in ("tensorboard", "tensorboardX")):
        loggers.append(TensorBoardLogger(folder, name="", version="tensorboard"))
    return loggers


def _may_be_several(trainer: Namespace) -> bool:
    return trainer.get("devices") not in (None, 1, "1") or trainer.get("num_nodes") not in (None, 1)


class TrainCLI(LightningCLI):
    """LightningCLI with trainer defaults, loggers and checkpoints for training splats.

    Args:
        run_folder: Callback that takes the folder of the run.
        settings: Arguments of LightningCLI.
    """

    def __init__(self, *settings: Any, run_folder: RunFolder | None = None, **more: Any) -> None:
        self.run_folder = run_folder or RunFolder()
        super().__init__(*settings, **more)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults(
            {
                "checkpoint.filename": "step_{step:06d}",
                "checkpoint.auto_insert_metric_name": False,
                "checkpoint.every_n_train_steps": 1000,
                "checkpoint.save_top_k": 1,
            }
        )

    def before_instantiate_classes(self) -> None:
        """Turn numbers of images into numbers of Lightning's steps, each of which takes an image on every device."""
        self.asked = self.config.clone()
        settings = self._chosen(self.config)
        trainer, checkpoint = settings["trainer"], settings.get("checkpoint")
        if not _may_be_several(trainer):
            return
        machines = {name: trainer[name] for name in ("accelerator", "devices", "num_nodes")}
        devices = Trainer(**machines, logger=False, enable_checkpointing=False, enable_progress_bar=False).world_size
        for part, name in (
            (trainer, "max_steps"),
            (trainer, "val_check_interval"),
            (checkpoint, "every_n_train_steps"),
        ):
            if part is not None and isinstance(part[name], int) and part[name] > 0:
                part[name] = steps_of(part[name], devices)

    def _chosen(self, config: Namespace) -> Namespace:
        """The part of a configuration that belongs to the subcommand."""
        part: Namespace = config.get(str(self.subcommand), config)
        return part

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Make the trainer, with loggers and a folder of checkpoints inside its folder."""
        settings = self._chosen(self.config_init)["trainer"]
        root = Path(settings["default_root_dir"])
        evaluating = self.subcommand not in (None, "fit")
        self.run_folder.root, self.run_folder.keep = root, self.subcommand == "fit"
        self.run_folder.save_config = self._save_config
        if settings.get("logger") in (None, True):
            kwargs["logger"] = default_loggers(root) if evaluating else False
            self.run_folder.loggers = lambda: default_loggers(root)
        checkpoint = self._chosen(self.config_init).get("checkpoint")
        if checkpoint is not None and checkpoint.dirpath is None:
            checkpoint.dirpath = str(root / "checkpoints")
        callbacks = [*(settings.get("callbacks") or []), self.run_folder]
        if settings.get("enable_progress_bar") is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            # Lightning would redraw it after every image
            callbacks.append(TQDMProgressBar(refresh_rate=20))
        kwargs["callbacks"] = callbacks
        plugins = settings.get("plugins") or []
        plugins = list(plugins) if isinstance(plugins, (list, tuple)) else [plugins]
        if not any(isinstance(plugin, CheckpointIO) for plugin in plugins):
            kwargs["plugins"] = [*plugins, PlainCheckpoints()]
        if _may_be_several(settings):
            if settings.get("strategy") in (None, "auto", "ddp"):
                kwargs["strategy"] = SplatParallel()
            kwargs["use_distributed_sampler"] = False  # the data know which images are whose
        return super().instantiate_trainer(**kwargs)

    def _save_config(self, folder: Path) -> None:
        """Write the whole configuration, for the record."""
        config = self._chosen(self.asked)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic(folder / "config.yaml") as temporary:
            self._parser(self.subcommand).save(config, temporary, skip_unset=False, overwrite=True, multifile=False)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        with guessing(parser):
            super().parse_arguments(parser, args)
        command = self.config.get("subcommand")
        path = self.config.get(command, {}).get("ckpt_path") if command else None
        if path is not None and (Path(str(path)).suffix or os.path.lexists(path)):  # not best, last ...
            read_training_checkpoint(Path(str(path)))

    def after_fit(self) -> None:
        """Also write a checkpoint after the last image, if ``every_n_train_steps`` does not divide their number."""
        if not self.run_folder.begun:
            raise ValueError(
                f"The run has already trained on {self.trainer.global_step * self.trainer.world_size} images, and "
                f"`trainer.max_steps` is {self.trainer.max_steps * self.trainer.world_size}: raise it."
            )
        try:
            checkpoint = self._chosen(self.config_init).get("checkpoint")
            if checkpoint is None or checkpoint.dirpath is None:
                return
            if self.model.saved_step != self.trainer.global_step:
                self.trainer.save_checkpoint(Path(checkpoint.dirpath) / f"step_{self.trainer.global_step:06d}.ckpt")
        finally:
            self.run_folder.release()


def make_cli(arguments: Sequence[str] | None = None, run: bool = True, run_folder: RunFolder | None = None) -> TrainCLI:
    """Parse a command line and, with ``run``, run it.

    Args:
        arguments: Command line; that of the process if None. Without ``run`` it has no subcommand.
        run: Whether to run the subcommand.
        run_folder: Callback that takes the folder of the run, to be asked afterwards.

    Returns:
        The command line interface, with its ``model``, ``datamodule`` and ``trainer``.
    """
    limit_yaml(with_named_materials)
    given = with_lists(with_shipped(sys.argv[1:] if arguments is None else arguments, "train"))
    return TrainCLI(
        SplatTrainer,
        LightningDataModule,
        subclass_mode_data=True,
        trainer_defaults=dict(TRAINER_DEFAULTS),
        seed_everything_default=0,
        save_config_callback=None,  # the run folder writes it, once training has started
        run_folder=run_folder,
        parser_kwargs={
            "prog": program.name("train"),
            "exit_on_error": False,
            "description": "Train surface-aligned Gaussians from photos.",
        },
        args=given,
        run=run,
    )


def next_step(folder: Path, data: object) -> str:
    """The command that previews a trained splat with the cameras of its photos.

    Args:
        folder: Folder of the training run.
        data: The training data; its ``path`` is the folder of the photos.
    """
    path = getattr(data, "path", None)
    return program.command("preview", folder / "point_cloud.ply", *([] if path is None else ["--capture", path]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run.

    Args:
        arguments: Command line; that of the process if None.

    Returns:
        0 if all went well, 2 on bad input or if training diverged, 130 if stopped with Ctrl-C, 143 by SIGTERM, 129 by
        SIGHUP. With the environment variable ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
    run_folder = RunFolder()
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return run_command(
            lambda: _train(arguments, run_folder),
            stopped="Stopped.",
            memory="smaller images (`data.init_args.downscale`)",
            expected=(TrainingDiverged, MisconfigurationException),
            arguments=given,
            advice=lambda _: how_to_continue(run_folder, given),
        )
    finally:
        run_folder.release()


def _train(arguments: Sequence[str] | None, run_folder: RunFolder) -> int:
    silence_warnings()
    silence_advertisements()
    try:
        with stop_signals():
            cli = make_cli(arguments, run_folder=run_folder)
    except SystemExit as stop:
        if stop.code != 1:  # Lightning exits with 1 after Ctrl-C
            raise
        raise (stop.__context__ if isinstance(stop.__context__, KeyboardInterrupt) else KeyboardInterrupt()) from None
    run_folder.release()
    if not cli.trainer.is_global_zero:
        return 130 if cli.trainer.interrupted else 0
    made = ("point_cloud.ply", "panels", "checkpoints", "csv", "tensorboard") if cli.subcommand == "fit" else ("csv",)
    for name in made:
        path = cli.model.folder / name
        if path.exists():
            print(f"wrote {path}")
    if cli.subcommand == "fit" and (cli.model.folder / "point_cloud.ply").exists():
        print(f"next: {next_step(cli.model.folder, cli.datamodule)}")
    return 130 if cli.trainer.interrupted else 0


def how_to_continue(run_folder: RunFolder, arguments: Sequence[str]) -> str | None:
    """A sentence with the last checkpoint of a run that ended early, and the command that continues it."""
    path = run_folder.newest_checkpoint()
    if path is None:
        return None
    path = os.path.relpath(path) if Path(path).is_relative_to(Path.cwd()) else path
    again = command(arguments, "--ckpt_path", path, without="--ckpt_path")
    return f"{path} is the last checkpoint; to continue:\n  {again}"
