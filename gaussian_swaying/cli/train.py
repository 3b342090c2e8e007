"""The command line for training: ``fit``, ``validate`` and ``test`` of Lightning, adapted to splats."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch import LightningDataModule
from lightning.pytorch.cli import LightningArgumentParser
from lightning.pytorch.utilities.exceptions import MisconfigurationException

import gaussian_swaying.training.data.datamodule  # noqa: F401
import gaussian_swaying.training.data.generated_datamodule  # noqa: F401
from gaussian_swaying import _program as program
from gaussian_swaying._yaml_limits import limit_yaml
from gaussian_swaying.cli.errors import command, guessing, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.gone import refuse_gone
from gaussian_swaying.config.material_names import with_named_materials
from gaussian_swaying.config.parser import with_lists
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.training.lightning_cli import TRAINER_DEFAULTS, TrainCLI
from gaussian_swaying.training.module import SplatTrainer, TrainingDiverged
from gaussian_swaying.training.run_folder import RunFolder


class _Command(TrainCLI):
    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        with guessing(parser):
            super().parse_arguments(parser, args)


def make_cli(arguments: Sequence[str], run: bool = True, run_folder: RunFolder | None = None) -> TrainCLI:
    """Parse a command line and, with ``run``, do its subcommand; without, it has none."""
    limit_yaml(lambda found: with_named_materials(refuse_gone(found)))
    kwargs = {"prog": program.name("train"), "exit_on_error": False}
    return _Command(
        SplatTrainer,
        LightningDataModule,
        subclass_mode_data=True,
        trainer_defaults=dict(TRAINER_DEFAULTS),
        seed_everything_default=0,
        save_config_callback=None,  # the run folder writes it, once training has started
        run_folder=run_folder,
        parser_kwargs=kwargs | {"description": "Train surface-aligned Gaussians from photos."},
        args=with_lists(with_shipped(arguments, "train")),
        run=run,
    )


def main(arguments: Sequence[str]) -> int:
    """Parse and run."""
    run_folder = RunFolder()

    def how_to_continue(error: BaseException) -> str | None:
        path = run_folder.newest()
        if path is None:
            return None
        path = os.path.relpath(path) if Path(path).is_relative_to(Path.cwd()) else path
        again = command(arguments, "--ckpt_path", path, without="--ckpt_path")
        return f"{path} is the last checkpoint; to continue:\n  {again}"

    return run_command(
        lambda: _train(arguments, run_folder),
        stopped="Stopped.",
        memory="smaller images (`data.init_args.downscale`)",
        expected=(TrainingDiverged, MisconfigurationException),
        arguments=arguments,
        advice=how_to_continue,
    )


def _train(arguments: Sequence[str], run_folder: RunFolder) -> int:
    warnings.filterwarnings("ignore", category=PossibleUserWarning)
    for message in ("Using ModelCheckpoint with manual optimization", "You're resuming from a checkpoint that ended"):
        warnings.filterwarnings("ignore", message=f"(?s)\\s*{message}")
    try:
        with stop_signals():
            cli = make_cli(arguments, run_folder=run_folder)
    except SystemExit as stop:
        if stop.code != 1:  # Lightning exits with 1 after Ctrl-C
            raise
        raise (stop.__context__ if isinstance(stop.__context__, KeyboardInterrupt) else KeyboardInterrupt()) from None
    folder, fitted = Path(cli.trainer.default_root_dir), cli.subcommand == "fit"
    if cli.trainer.is_global_zero:
        for name in ("point_cloud.ply", "panels", "checkpoints", "csv", "tensorboard") if fitted else ("csv",):
            if (folder / name).exists():
                print(f"wrote {folder / name}")
        if fitted and (folder / "point_cloud.ply").exists():
            photos = getattr(cli.datamodule, "path", None)
            capture = [] if photos is None else ["--capture", photos]
            print(f"next: {program.command('preview', folder / 'point_cloud.ply', *capture)}")
    return 130 if cli.trainer.interrupted else 0
