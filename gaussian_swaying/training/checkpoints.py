"""Checkpoints of a training run: written whole or not at all, and read without executing any code in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.runs.saved import load_plain, save_whole
from gaussian_swaying.training.densification import PARAMETERS

_FIELDS = {"densification", "kind", "scene_scale", "sh_degree", "seed", "random", "seen"}

_CLOCK_STEP = 20_000_000  # [ns] by which file times may lag behind the clock


def read_training_checkpoint(path: Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Read a checkpoint that ``tools/train.py`` wrote.

    Args:
        path: The file.
        map_location: Device of its tensors, as for ``torch.load``.
    """
    if not path.exists():
        raise ValueError(f"The checkpoint {path} does not exist: give another `--ckpt_path`.")
    try:
        held = load_plain(path, map_location)
        if not isinstance(held, dict) or not isinstance(held.get("splat_training"), dict):
            raise ValueError("it is not a checkpoint of this package")
        missing = _FIELDS - set(held["splat_training"])
        if missing:
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
        _check_parameters(held["state_dict"])
    except Exception as error:
        why = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise ValueError(f"{path} cannot be read as a checkpoint ({why}): give another `--ckpt_path`.") from error
    return held


def _check_parameters(state: dict[str, Any]) -> None:
    found = [state[f"model.{name}"] for name in PARAMETERS]
    for name, value in zip(PARAMETERS, found, strict=True):
        if not isinstance(value, Tensor) or value.dtype != torch.float32 or value.shape[:1] != found[0].shape[:1]:
            raise ValueError(f"its `{name}` are not those of {len(found[0])} Gaussians")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"its `{name}` are NaN or infinite")


def check_settings(stored: dict[str, Any], sh_degree: int, devices: int | None) -> None:
    """Raise ValueError if a checkpoint belongs to other settings.

    Args:
        stored: Its entry ``splat_training``.
        sh_degree: Degree of the spherical harmonics.
        devices: Number of devices that train on; None if nothing is trained.
    """
    if stored["sh_degree"] != sh_degree:
        raise ValueError(
            f"The checkpoint was trained with `sh_degree` {stored['sh_degree']}, but the configuration says "
            f"{sh_degree}: use the same."
        )
    known = stored.get("devices", 1)
    if devices not in (None, known):
        raise ValueError(
            f"The checkpoint was trained on {known} devices, but there are {devices}: use `trainer.devices: {known}`."
        )


def stored_gaussians(state: dict[str, Tensor], origin: Origin = NO_ORIGIN) -> GaussianCloud:
    """The Gaussians in the entry ``state_dict`` of a checkpoint, which count from a point."""
    means, scales, quats, opacities, sh0, rest = (state[f"model.{name}"] for name in PARAMETERS)
    return GaussianCloud(means, quats, scales, opacities, torch.cat([sh0, rest], 1), origin=origin)


def newest_checkpoint(trainer: Any, begun: int) -> str | None:
    """The newest checkpoint of a run, or the one that it resumes; None if there is none.

    Args:
        trainer: The trainer of the run.
        begun: Time at which the run began [ns].
    """
    folders = [getattr(callback, "dirpath", None) for callback in trainer.checkpoint_callbacks]
    files = [file for folder in folders if folder for file in Path(folder).glob("*.ckpt")]
    files = [file for file in files if file.stat().st_mtime_ns >= begun - _CLOCK_STEP]
    if files:
        return str(max(files, key=lambda file: file.stat().st_mtime_ns))
    return None if trainer.ckpt_path is None else str(trainer.ckpt_path)


class PlainCheckpoints(TorchCheckpointIO):
    """Lightning's reading and writing of checkpoints, in every subcommand."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint, completely or not at all."""
        file = Path(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        save_whole(file, checkpoint)

    def load_checkpoint(
        self,
        path: Any,
        map_location: Callable[..., Any] | None = lambda storage, loc: storage,
        weights_only: bool | None = None,
    ) -> dict[str, Any]:
        """Read a checkpoint; ``weights_only`` is always true."""
        return read_training_checkpoint(Path(path), map_location)
