"""Checks for NaN and infinity: of the loss, without waiting for the GPU, and of the Gaussians of a splat."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud


class TrainingDiverged(RuntimeError):  # noqa: N818
    """A loss or a Gaussian is no longer finite; the message names the step and the last good checkpoint.

    Args:
        step: Number of images trained on before the one that failed.
        what: Name of the value that is not finite.
        checkpoint: Last checkpoint written before, if any.
    """

    def __init__(self, step: int, what: str, checkpoint: str | None = None) -> None:
        self.step, self.checkpoint = step, checkpoint
        kept = f"the last good checkpoint is {checkpoint}" if checkpoint else "there is no checkpoint yet"
        super().__init__(
            f"Training diverged at step {step}: {what} is not finite; {kept}. Remedy: lower the learning rates "
            "(`model.rates`) or the weight of the loss that grew (`model.loss_weights`)."
        )


class PendingLoss:
    """The last loss, copied to the host in the background."""

    def __init__(self, device: torch.device) -> None:
        self.step: int | None = None
        on_gpu = device.type == "cuda"
        self._host = torch.zeros((), pin_memory=on_gpu)
        self._arrived = torch.cuda.Event() if on_gpu else None

    def send(self, step: int, loss: Tensor) -> None:
        """Start the copy of the loss of a step to the host."""
        self.step = step
        self._host.copy_(loss, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record()

    def take(self) -> float:
        if self._arrived is not None:
            self._arrived.synchronize()
        self.step = None
        return float(self._host)


def finite_cloud(cloud: GaussianCloud) -> GaussianCloud:
    """The Gaussians of a splat without those that are not finite."""
    values = (cloud.means, cloud.quats, cloud.scales, cloud.opacities[:, None], cloud.sh.flatten(1))
    return cloud.select(torch.cat(values, dim=1).isfinite().all(-1))
