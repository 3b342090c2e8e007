"""The optimisers of the Gaussians, and their steps without the detours of ``Optimizer.step``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.training.densification import PARAMETERS
from gaussian_swaying.training.parallel import scaled_adam

OPTIMIZERS = ("adam", "selective_adam")
"""Kinds of :func:`make_optimizer`."""


def make_optimizer(parameter: Tensor, rate: float, kind: str = "adam", devices: int = 1) -> torch.optim.Optimizer:
    """An optimiser of one parameter of the Gaussians.

    Args:
        parameter: The parameter, shape (N, ...).
        rate: Its learning rate.
        kind: ``adam``, or ``selective_adam``: gsplat's Adam of the Gaussians in the picture alone (Mallick et al. 2024,
            "Taming 3DGS"); CUDA only. It does not correct the bias of the first steps.
        devices: Number of devices that train together, see
            :func:`~gaussian_swaying.training.parallel.scaled_adam`.

    Raises:
        ValueError: If ``kind`` does not run on the parameter's device.
    """
    on_gpu = parameter.device.type == "cuda"
    options = scaled_adam(rate, devices)
    if kind == "adam":
        return torch.optim.Adam([parameter], fused=on_gpu, **options)
    if not on_gpu:
        raise ValueError(f"`optimizer` {kind} needs CUDA, but the Gaussians are on {parameter.device}: use adam there.")
    from gsplat import SelectiveAdam

    made: torch.optim.Optimizer = SelectiveAdam([parameter], eps=options["eps"], betas=options["betas"])
    made.param_groups[0]["lr"] = options["lr"]
    return made


def step_all(optimizers: Sequence[torch.optim.Optimizer], seen: Tensor | None = None) -> None:
    """Step optimisers with one parameter each.

    Fused Adams are stepped by torch's kernel, as ``step`` would; all else that ``step`` does takes the host longer than
    the kernel takes the GPU.

    Args:
        optimizers: The optimisers, from :func:`make_optimizer`.
        seen: Which Gaussians were in the picture, bool (N,), for ``selective_adam``.
    """
    fused: list[tuple[dict[str, Any], Tensor, Tensor, dict[str, Tensor]]] = []
    one: Any
    for one in optimizers:
        group = one.param_groups[0]
        parameter = group["params"][0]
        state = one.state.get(parameter)
        if parameter.grad is None:
            continue
        if type(one) is not torch.optim.Adam:
            one.step(visibility=seen)
        elif group["fused"] and state:
            fused.append((group, parameter, parameter.grad, state))
        else:
            one.step()
    if not fused:
        return
    with torch.no_grad():
        torch._foreach_add_([state["step"] for *_, state in fused], 1.0)
        for group, parameter, gradient, state in fused:
            beta1, beta2 = group["betas"]
            torch._fused_adam_(
                [parameter],
                [gradient],
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
    shN: float = 2.5e-3 / 20

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "means_final"):
            check_positive(f"rates.{name}", getattr(self, name), allow_zero=name != "means_final")


def means_rate(rates: LearningRates, scene_scale: float, step: int, max_steps: int, devices: int = 1) -> float:
    """Learning rate of the centres at a step: decays exponentially from ``rates.means`` times the scene's extent.

    Args:
        rates: The rates.
        scene_scale: Extent of the scene [scene units].
        step: Number of steps before.
        max_steps: Number of steps in all.
        devices: Number of devices that train together, see
            :func:`~gaussian_swaying.training.parallel.scaled_adam`.

    Returns:
        The rate [scene units].
    """
    share = min(step / max_steps, 1.0) if max_steps > 0 else 0.0
    return math.sqrt(devices) * rates.means * scene_scale * rates.means_final**share
