"""The command line of the training: ``fit``, ``validate`` and ``test`` of Lightning, with what they need here."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar, TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

import gaussian_swaying.data.datamodule
import gaussian_swaying.data.generated_datamodule
import gaussian_swaying.training.densification
import gaussian_swaying.training.losses  # noqa: F401
from gaussian_swaying.cli.errors import run_command
from gaussian_swaying.cli.suggestions import guessing
from gaussian_swaying.cli.yaml_limits import check_config_files, limit_yaml
from gaussian_swaying.training.module import SplatTrainer, TrainingDiverged

_STOPPED = "Stopped; --ckpt_path with the last checkpoint continues."

TRAINER_DEFAULTS: dict[str, Any] = {
    "max_steps": 60_000,
    "max_epochs": -1,  # images are counted, not rounds of them
    "accelerator": "auto",
    "devices": 1,
    "check_val_every_n_epoch": None,
    "num_sanity_val_steps": 0,
    "enable_model_summary": False,
    "default_root_dir": "outputs/train/run",
}
"""What ``tools/train.py`` sets where a YAML does not."""


def default_loggers(folder: Path) -> list[Logger]:
    """A CSV file and, if tensorboard is installed, its event files, all in ``folder``."""
    # rows come every `log_every` images only, and are worth keeping if the run is killed
    loggers: list[Logger] = [CSVLogger(folder, name="", version="csv", flush_logs_every_n_steps=1)]
    if any(importlib.util.find_spec(name) is not None for name in ("tensorboard", "tensorboardX")):
        loggers.append(TensorBoardLogger(folder, name="", version="tensorboard"))
    return loggers


class TrainCLI(LightningCLI):
    """LightningCLI with the trainer's defaults, loggers and checkpoints of a splat training."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the checkpoints as options of their own."""
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults(
            {
                "checkpoint.filename": "step_{step:06d}",
                "checkpoint.auto_insert_metric_name": False,
                "checkpoint.every_n_train_steps": 1000,
                "checkpoint.save_top_k": 1,
            }
        )

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Make the trainer, with loggers and a folder of checkpoints below its folder."""
        settings = self._get(self.config_init, "trainer", default={})
        root = Path(settings["default_root_dir"])
        if settings.get("logger") in (None, True):
            kwargs["logger"] = default_loggers(root)
        checkpoint = self._get(self.config_init, "checkpoint")
        if checkpoint is not None and checkpoint.dirpath is None:
            checkpoint.dirpath = str(root / "checkpoints")
        callbacks = settings.get("callbacks") or []
        if settings.get("enable_progress_bar") is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            # Lightning would draw it anew after every image
            kwargs["callbacks"] = [*callbacks, TQDMProgressBar(refresh_rate=20)]
        return super().instantiate_trainer(**kwargs)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse, and refuse a checkpoint that cannot be read."""
        with guessing(parser):
            super().parse_arguments(parser, args)
        command = self.config.get("subcommand")
        path = self.config.get(command, {}).get("ckpt_path") if command else None
        if path is None or not Path(str(path)).suffix:  # best, last ...
            return
        try:
            held = torch.load(path, map_location="cpu", weights_only=False, mmap=True)
        except FileNotFoundError:
            raise
        except Exception as error:
            raise ValueError(f"{path} is no checkpoint, or not whole: give another `--ckpt_path`.") from error
        if not isinstance(held, dict) or "splat_training" not in held:
            raise ValueError(f"{path} is no checkpoint of this training: give another `--ckpt_path`.")

    def after_fit(self) -> None:
        """Keep a checkpoint of the last image too, where ``every_n_train_steps`` does not divide their number."""
        checkpoint = self._get(self.config_init, "checkpoint")
        if checkpoint is None or checkpoint.dirpath is None:
            return
        kept: Any = self.trainer.checkpoint_callback
        if getattr(kept, "_last_global_step_saved", None) != self.trainer.global_step:
            self.trainer.save_checkpoint(Path(checkpoint.dirpath) / f"step_{self.trainer.global_step:06d}.ckpt")


def make_cli(arguments: Sequence[str] | None = None, run: bool = True) -> TrainCLI:
    """Parse a command line and, with ``run``, do what it says.

    Args:
        arguments: Command line; that of the process if None. Without ``run`` it has no subcommand.
        run: Whether to run the subcommand.

    Returns:
        The command line interface, with its ``model``, ``datamodule`` and ``trainer``.

    Raises:
        ArgumentError: If an option is unknown or a value has the wrong type.
        ValueError: If a value is out of range or the data are bad.
        TrainingDiverged: If a loss or a Gaussian is not finite any more.
    """
    limit_yaml()
    check_config_files(sys.argv[1:] if arguments is None else arguments)
    return TrainCLI(
        SplatTrainer,
        LightningDataModule,
        subclass_mode_data=True,
        trainer_defaults=dict(TRAINER_DEFAULTS),
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
        parser_kwargs={"exit_on_error": False, "description": "Train surface-aligned Gaussians from photos."},
        args=None if arguments is None else list(arguments),
        run=run,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run.

    Args:
        arguments: Command line; that of the process if None.

    Returns:
        0 if all went well, 2 on bad input or a training that diverged, 130 if stopped with Ctrl-C. With the
        environment variable ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
    return run_command(
        lambda: _train(arguments),
        stopped=_STOPPED,
        memory="smaller images (`data.init_args.downscale`)",
        expected=(TrainingDiverged, MisconfigurationException),
        arguments=arguments,
    )


def _train(arguments: Sequence[str] | None) -> int:
    """Parse and run, and say what was written."""
    # checkpoints are written after the step, which is what a resumed run needs
    warnings.filterwarnings("ignore", message="Using ModelCheckpoint with manual optimization")
    warnings.filterwarnings("ignore", message="(?s).*does not have many workers")
    warnings.filterwarnings("ignore", message=".*LeafSpec")
    try:
        cli = make_cli(arguments)
    except SystemExit as stop:
        if stop.code != 1:  # Lightning leaves with 1 after Ctrl-C
            raise
        print(_STOPPED, file=sys.stderr)
        return 130
    if cli.subcommand == "fit":
        for name in ("point_cloud.ply", "panels", "checkpoints", "csv", "tensorboard"):
            path = cli.model.folder / name
            if path.exists():
                print(f"wrote {path}")
    return 130 if cli.trainer.interrupted else 0
