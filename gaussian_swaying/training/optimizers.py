"""The optimiser of the Gaussians, whose step leaves out the detours of torch's."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.training.densification import PARAMETERS
from gaussian_swaying.training.parallel import scaled_adam


class GaussianAdam(torch.optim.Adam):
    """One Adam for all parameters of the Gaussians, in groups in the order of :data:`PARAMETERS`.

    Args:
        parameters: The parameters, shape (N, ...) each.
        rates: Their learning rates.
        devices: Number of devices that train together, see
            :func:`~gaussian_swaying.training.parallel.scaled_adam`.
    """

    def __init__(self, parameters: Sequence[Tensor], rates: Sequence[float], devices: int = 1) -> None:
        groups = [{"params": [p]} | scaled_adam(rate, devices) for p, rate in zip(parameters, rates, strict=True)]
        super().__init__(groups, fused=parameters[0].device.type == "cuda")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step every parameter that has a gradient.

        From the second step on, torch's fused kernel is called as ``Adam.step`` would; all else that it does takes the
        host longer than the kernel takes the GPU.

        Returns:
            The result of ``closure``.
        """
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        groups = [group for group in self.param_groups if group["params"][0].grad is not None]
        if not groups or not all(group["fused"] and self.state.get(group["params"][0]) for group in groups):
            super().step()
            return result
        states = [self.state[group["params"][0]] for group in groups]
        torch._foreach_add_([state["step"] for state in states], 1.0)
        for group, state in zip(groups, states, strict=True):
            beta1, beta2 = group["betas"]
            torch._fused_adam_(
                group["params"],
                [group["params"][0].grad],
                [state["exp_avg"]],
                [state["exp_avg_sq"]],
                [],
                [state["step"]],
                lr=group["lr"],
                beta1=beta1,
                beta2=beta2,
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=group["maximize"],
            )
        return result


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam, one for each parameter, with the values of gsplat's example trainer.

    Attributes:
        means: Centres, as a share of the scene's extent; decays exponentially.
        means_final: Share of ``means`` that is left after the last step.
        scales: Logarithms of the scales.
        quats: Quaternions.
        opacities: Logits of the opacities.
        sh0: Constant harmonics.
        shN: The other harmonics.
    """

    means: float = 1.6e-4
    means_final: float = 0.01
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20  # noqa: N815

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "means_final"):
            check_positive(f"rates.{name}", getattr(self, name), allow_zero=name != "means_final")


def means_rate(rates: LearningRates, scene_scale: float, step: int, max_steps: int, devices: int = 1) -> float:
    """Learning rate of the centres at a step: decays exponentially from ``rates.means`` times the scene's extent.

    Args:
        scene_scale: Extent of the scene [scene units].

    Returns:
        The rate [scene units].
    """
    share = min(step / max_steps, 1.0) if max_steps > 0 else 0.0
    return math.sqrt(devices) * rates.means * scene_scale * rates.means_final**share
