"""The loss of a training step: the terms of Gaussian Swaying ("Training") and their weighted sum."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.metrics.ssim import ssim_map
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.planes import SurfaceMaps

_MIN_OPACITY = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class OtherView:
    """Another view of the scene, for losses that compare two.

    Attributes:
        image: Photo, over the background of this step, shape (H, W, 3).
        camera: Its camera, on the device of the Gaussians.
        surface: The surface rendered there, without gradient.
    """

    image: Tensor
    camera: Camera
    surface: SurfaceMaps


@dataclass(frozen=True, slots=True, eq=False)
class LossInputs:
    """The inputs of a loss term in a training step.

    Attributes:
        image: Rendered picture, shape (H, W, 3).
        target: Photo, over the background of this step, shape (H, W, 3).
        alpha: Rendered opacity, shape (H, W, 1).
        target_alpha: Opacity of the photo, shape (H, W, 1), or None.
        means: Centres [scene units], shape (N, 3).
        quats: Quaternions wxyz of any length above zero, shape (N, 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (N, 3).
        opacities: Opacities from 0 to 1, shape (N,).
        step: Number of images trained on before this one.
        camera: The camera, on the device of the Gaussians.
        surface: The surface in the picture, if a term needs ``surface``.
        other: Another view of the same place, if a term needs ``other_view`` and there is one close enough.
    """

    image: Tensor
    target: Tensor
    alpha: Tensor
    target_alpha: Tensor | None
    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacities: Tensor
    step: int
    camera: Camera | None = None
    surface: SurfaceMaps | None = None
    other: OtherView | None = None


NEEDS = ("surface", "other_view")
"""Inputs that a term may need besides the picture; each is computed only while a term that needs it is active."""


class LossTerm(nn.Module, ABC):
    """Base class of all terms; a YAML can name any subclass by its class path.

    Attributes:
        start: Images trained on before the term begins.
        stop: Images trained on before it ends; None for the end of the training.
        fade: Images before ``stop`` over which its weight falls to zero in a straight line.
        every: It is computed for one image in so many, with so many times its weight.
    """

    start: int = 0
    stop: int | None = None
    fade: int = 0
    every: int = 1
    needs: frozenset[str] = frozenset()

    def share(self, step: int) -> float:
        """Factor on the weight at a step; 0 if the term is not computed then."""
        if step < self.start or (step - self.start) % self.every:
            return 0.0
        if self.stop is None:
            return float(self.every)
        return self.every * min(max((self.stop - step) / max(self.fade, 1), 0.0), 1.0)

    @abstractmethod
    def forward(self, inputs: LossInputs) -> Tensor:
        """The term as a number, before its weight."""


class PhotometricLoss(LossTerm):
    r"""Distance of picture and photo, :math:`(1 - w)\,\lvert I - \hat I \rvert + w\,(1 - \mathrm{SSIM})`.

    Kerbl et al. 2023, equation 7: the :math:`\mathcal L_\mathrm{rgb}` of Gaussian Swaying. SSIM is the mean over the
    windows inside the picture.

    Args:
        ssim_weight: Weight w of the structural part, 0 to 1.

    Raises:
        ValueError: If it is out of range.
    """

    def __init__(self, ssim_weight: float = 0.2) -> None:
        super().__init__()
        if not 0.0 <= ssim_weight <= 1.0:
            raise ValueError(f"Expected `ssim_weight` between 0 and 1, but got {ssim_weight}.")
        self.ssim_weight = float(ssim_weight)

    def forward(self, inputs: LossInputs) -> Tensor:
        difference = (inputs.image - inputs.target).abs().mean()
        if self.ssim_weight == 0.0:
            return difference
        return torch.lerp(difference, (1.0 - ssim_map(inputs.image, inputs.target)).mean(), self.ssim_weight)


class OfGaussians(LossTerm):
    """Base class of terms that are a mean or a sum over the Gaussians.

    Args:
        reduction: ``mean`` or ``sum``; 0 without Gaussians.

    Raises:
        ValueError: If it is none of those.
    """

    def __init__(self, reduction: str = "mean") -> None:
        super().__init__()
        check_choice("reduction", reduction, ("mean", "sum"))
        self.reduction = reduction

    @abstractmethod
    def of_each(self, inputs: LossInputs) -> Tensor:
        """The term of each Gaussian, shape (N,)."""

    def forward(self, inputs: LossInputs) -> Tensor:
        values = self.of_each(inputs)
        return values.mean() if self.reduction == "mean" and values.numel() else values.sum()


class AnisotropyLoss(OfGaussians):
    r"""Penalty on elongated Gaussians, :math:`\max(S^1 / S^2 - a, 0)` (Gaussian Swaying, "Training").

    The largest over the second largest scale, so that discs are free.

    Args:
        a: Ratio from which a Gaussian counts as elongated, at least 1.
        reduction: ``mean`` or ``sum`` over the Gaussians.

    Raises:
        ValueError: If an argument is not one of those.
    """

    def __init__(self, a: float = 1.1, reduction: str = "mean") -> None:
        super().__init__(reduction)
        if not 1.0 <= a < math.inf:
            raise ValueError(f"Expected `a` to be at least 1, but got {a}.")
        self.a = float(a)

    def of_each(self, inputs: LossInputs) -> Tensor:
        x, y, z = inputs.log_scales.unbind(-1)
        low, high = torch.minimum(x, y), torch.maximum(x, y)
        second = torch.maximum(low, torch.minimum(high, z))
        return ((torch.maximum(high, z) - second).exp() - self.a).clamp_min(0.0)


class OpacityEntropyLoss(OfGaussians):
    r"""Entropy of the opacities, :math:`-\sigma \log \sigma` (Gaussian Swaying, "Training"; Duan et al. 2024).

    This is the literal formula. It pushes opacities above 1/e towards 1 and those below towards 0. Opacities below 1e-7
    count as that, where the gradient is zero.
    """

    def of_each(self, inputs: LossInputs) -> Tensor:
        clamped = inputs.opacities.clamp_min(_MIN_OPACITY)
        return -clamped * clamped.log()


class SizeLoss(OfGaussians):
    r"""Penalty on large Gaussians, :math:`\max(S^1 - b, 0)` of the largest scale (Gaussian Swaying, "Training").

    The paper does not say how the penalty is summed over the Gaussians. As a mean with the paper's weight of 0.01 it
    has no measurable effect. As a sum it limits the Gaussians to ``b``. A simulation needs this where a surface has no
    texture, since its particles are as dense as the Gaussians.

    Args:
        b: Scale from which on a Gaussian counts as large [scene units].
        reduction: ``mean`` or ``sum`` over the Gaussians.

    Raises:
        ValueError: If ``b`` is negative, or ``reduction`` is none of those.
    """

    def __init__(self, b: float = 0.008, reduction: str = "mean") -> None:
        super().__init__(reduction)
        check_positive("b", b, allow_zero=True)
        self.b = float(b)

    def of_each(self, inputs: LossInputs) -> Tensor:
        return (inputs.log_scales.amax(-1).exp() - self.b).clamp_min(0.0)


class MeanOpacityLoss(OfGaussians):
    """Mean opacity. Kheradmand et al. 2024 ("3DGS as Markov Chain Monte Carlo") add it so that Gaussians can fade."""

    def of_each(self, inputs: LossInputs) -> Tensor:
        return inputs.opacities


class MeanScaleLoss(OfGaussians):
    """Mean standard deviation [scene units], the other term of Kheradmand et al. 2024."""

    def of_each(self, inputs: LossInputs) -> Tensor:
        return inputs.log_scales.exp().flatten()


DEFAULT_WEIGHTS = {"rgb": 1.0, "anisotropy": 10.0, "entropy": 0.01, "size": 0.01}
"""Weights of Gaussian Swaying, "Training"."""


class TotalLoss(nn.Module):
    r"""Weighted sum of named terms, :math:`\mathcal L = \sum_k \lambda_k \mathcal L_k`.

    The four terms of Gaussian Swaying are included with its weights: ``rgb`` 1, ``anisotropy`` 10, ``entropy`` 0.01 and
    ``size`` 0.01. A term with weight 0 is not computed, nor is one where its :meth:`LossTerm.share` is 0.

    Args:
        terms: Further terms by name, or others in place of the four.
        weights: Weights by name, in place of those above; the default for a further term is 1.

    Raises:
        ValueError: If a weight is not finite or belongs to no term, or all are zero.
    """

    def __init__(self, terms: dict[str, LossTerm] | None = None, weights: dict[str, float] | None = None) -> None:
        super().__init__()
        named: dict[str, LossTerm] = {
            "rgb": PhotometricLoss(),
            "anisotropy": AnisotropyLoss(),
            "entropy": OpacityEntropyLoss(),
            "size": SizeLoss(),
        }
        named |= terms or {}
        given = dict(weights or {})
        unknown = sorted(set(given) - set(named))
        if unknown:
            raise ValueError(f"Expected `loss_weights` for {', '.join(named)}, but got one for {', '.join(unknown)}.")
        self.weights = {name: float(given.get(name, DEFAULT_WEIGHTS.get(name, 1.0))) for name in named}
        for name, weight in self.weights.items():
            if not math.isfinite(weight):
                raise ValueError(f"Expected `loss_weights.{name}` to be finite, but got {weight}.")
        if not any(self.weights.values()):
            raise ValueError("Expected one of `loss_weights` not to be zero.")
        self._by_name = {name: term for name, term in named.items() if self.weights[name] != 0.0}
        self.terms = nn.ModuleDict(self._by_name)

    def active(self, step: int) -> dict[str, LossTerm]:
        return {name: term for name, term in self._by_name.items() if term.share(step)}

    def needs(self, step: int) -> frozenset[str]:
        wanted: frozenset[str] = frozenset()
        return wanted.union(*(term.needs for term in self.active(step).values()))

    def forward(self, inputs: LossInputs) -> tuple[Tensor, Mapping[str, Tensor]]:
        terms = self.active(inputs.step)
        values = {name: term(inputs) for name, term in terms.items()}
        for name, value in values.items():
            if value.dim():
                raise ValueError(
                    f"Expected the term `{name}` to be a number, but got shape {tuple(value.shape)}: return the mean "
                    "or the sum."
                )
        total = sum(self.weights[name] * terms[name].share(inputs.step) * value for name, value in values.items())
        if not isinstance(total, Tensor):  # no term is due
            total = inputs.image.new_zeros(())
        return total, {name: value.detach() for name, value in values.items()}
