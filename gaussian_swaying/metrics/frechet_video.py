"""Fréchet distance between Gaussians, and between the features of videos.

The features come from a network that the user provides as a TorchScript file; nothing is downloaded. The number depends
on that network, on how clips are cut and on how frames are resized. So it is always given together with
:meth:`FrechetVideoDistance.protocol`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from einops import rearrange
from torch import Tensor
from torchmetrics import Metric  # noqa: TID253 - a class of torchmetrics, imported when it is used

from gaussian_swaying._checks import check_positive, check_shape

# arguments of the TorchScript I3D of StyleGAN-V besides the clips: we resize and rescale ourselves
BATCH = 8  # clips in a call of the network
_OPTIONS = {"rescale": False, "resize": False, "return_features": True}


def frechet_distance(mean1: Tensor, cov1: Tensor, mean2: Tensor, cov2: Tensor) -> Tensor:
    r"""Fréchet distance between two Gaussians, squared as usual (Dowson & Landau 1982).

    .. math::
        d^2 = \lvert \mu_1 - \mu_2 \rvert^2 + \operatorname{tr} \Sigma_1 + \operatorname{tr} \Sigma_2
              - 2 \sum_i \sqrt{\lambda_i}

    with the eigenvalues :math:`\lambda_i` of the symmetric matrix :math:`\Sigma_1^{1/2} \Sigma_2 \Sigma_1^{1/2}`, which
    has the same trace of the square root as :math:`\Sigma_1 \Sigma_2`. They are negative only by rounding and are then
    set to zero, so singular covariances (fewer samples than dimensions) need no special case. Computed in float64.

    Args:
        mean1: Mean of the first, shape (D,).
        cov1: Covariance of the first, shape (D, D), symmetric.
        mean2: Mean of the second, shape (D,).
        cov2: Covariance of the second, shape (D, D), symmetric.

    Returns:
        The distance, float64, not negative.

    Raises:
        TypeError: If one of them is not a tensor.
        ValueError: If the shapes do not fit.

    Example:
        >>> one, two = torch.eye(3), 4 * torch.eye(3)
        >>> frechet_distance(torch.zeros(3), one, torch.ones(3), two)  # 3 + 3 (2 - 1)^2
        tensor(6., dtype=torch.float64)
    """
    check_shape("mean1", mean1, "D")
    size = mean1.shape[-1]
    for name, value, shape in (("cov1", cov1, (size, size)), ("mean2", mean2, (size,)), ("cov2", cov2, (size, size))):
        check_shape(name, value, *shape)
    mean1, cov1, mean2, cov2 = (value.double() for value in (mean1, cov1, mean2, cov2))
    values, vectors = torch.linalg.eigh(cov1)
    root = (vectors * values.clamp_min(0).sqrt()) @ vectors.mT
    product = torch.linalg.eigvalsh(root @ cov2 @ root)
    traces = cov1.trace() + cov2.trace() - 2 * product.clamp_min(0).sqrt().sum()
    return ((mean1 - mean2).square().sum() + traces).clamp_min(0)


def cut_clips(video: Tensor, length: int, stride: int) -> Tensor:
    """All clips of ``length`` consecutive frames that begin every ``stride`` frames; left-over frames are not used.

    Args:
        video: Frames, shape (T, 3, H, W).

    Returns:
        A view of the video, shape (clips, length, 3, H, W).
    """
    if len(video) < length:
        raise ValueError(
            f"A video has {len(video)} frames, but a clip needs {length}: give a longer video, or lower `clip_length`."
        )
    return rearrange(video.unfold(0, length, stride), "n c h w t -> n t c h w")


class FrechetVideoDistance(Metric):
    """Fréchet distance between the features of real and of generated clips, FVD (Unterthiner et al. 2018).

    Frames are resized bilinearly (half-pixel centres, no prefilter, the aspect ratio is not kept), mapped from 0 to 1
    to -1 to 1, and given to the network as clips (B, 3, T, H, W). It must return features (B, D). The TorchScript
    version of I3D that FVD is commonly computed with is called with ``rescale=False, resize=False,
    return_features=True``; networks without these arguments are called with the clips alone.

    Covariances are unbiased. With at most D clips they are singular. The number is still defined then, but it depends
    on how many clips there are, so compare only numbers with the same protocol.

    Args:
        weights: The network as a TorchScript file.
        clip_length: Frames in a clip; I3D needs at least 10.
        stride: Frames from the start of one clip to the start of the next.
        resize: Height and width of the frames given to the network [pixels], or one number for both; None keeps the
            size.

    Raises:
        ValueError: If there is no such file, it is not TorchScript, or a number is out of range.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    real_features: list[Tensor]
    fake_features: list[Tensor]

    def __init__(
        self,
        weights: str | os.PathLike[str],
        clip_length: int = 16,
        stride: int = 1,
        resize: int | Sequence[int] | None = 224,
    ) -> None:
        super().__init__()
        for name, value in (("clip_length", clip_length), ("stride", stride)):
            check_positive(name, value)
        self.clip_length, self.stride = int(clip_length), int(stride)
        size = (resize, resize) if isinstance(resize, int) else resize
        if size is not None:
            if len(size) != 2:
                raise ValueError(f"Expected `resize` to be height and width, but got {list(size)}.")
            for value in size:
                check_positive("resize", value)
            size = (int(size[0]), int(size[1]))
        self.resize = size
        self.weights = Path(weights)
        self.sha256, self.network = _load_network(self.weights)
        names = {argument.name for argument in self.network.forward.schema.arguments}
        self.options = {name: value for name, value in _OPTIONS.items() if name in names}
        self.add_state("real_features", [], dist_reduce_fx="cat")
        self.add_state("fake_features", [], dist_reduce_fx="cat")

    def prepare(self, frames: Tensor) -> Tensor:
        """Resize frames (..., 3, H, W) as :meth:`update` does; it does not resize them again.

        With it a long video need not be in memory at its full size: pass its frames to this method one by one, and the
        results to :meth:`update`.
        """
        check_shape("video", frames, 3, None, None)
        frames = frames.to(self.device)
        if not frames.is_floating_point():
            frames = frames.float()
        if self.resize is None or tuple(frames.shape[-2:]) == self.resize:
            return frames
        flat = frames.reshape(-1, *frames.shape[-3:])
        small = functional.interpolate(flat, size=self.resize, mode="bilinear", align_corners=False)
        return small.reshape(*frames.shape[:-2], *self.resize)

    @torch.no_grad()
    def update(self, video: Tensor, real: bool) -> None:
        """Add the clips of one or more videos.

        Args:
            video: Frames with values from 0 to 1, shape (T, 3, H, W) or (B, T, 3, H, W).
        """
        check_shape("video", video, "T", 3, "H", "W")
        if video.dim() > 5:
            raise ValueError(
                f"Expected `video` of shape (T, 3, H, W) or (B, T, 3, H, W), but got {tuple(video.shape)}."
            )
        smallest, largest = (float(value) for value in video.aminmax())
        if not (smallest >= 0 and largest <= 1):
            raise ValueError(
                f"Expected `video` to have values from 0 to 1, but they range from {smallest:g} to {largest:g}."
            )
        features = []
        for one in video if video.dim() == 5 else video[None]:
            frames = self.prepare(one) * 2 - 1
            clips = cut_clips(frames, self.clip_length, self.stride)
            features += [self._features(batch) for batch in clips.split(BATCH)]
        (self.real_features if real else self.fake_features).extend(features)

    def _features(self, clips: Tensor) -> Tensor:
        self.network.eval()  # also within a module that is in training
        features = self.network(rearrange(clips, "n t c h w -> n c t h w").contiguous(), **self.options)
        if not isinstance(features, Tensor) or features.dim() != 2 or len(features) != len(clips):
            shape = tuple(features.shape) if isinstance(features, Tensor) else type(features).__name__
            raise ValueError(
                f"Expected the network {self.weights} to return features of shape ({len(clips)}, D) for {len(clips)} "
                f"clips, but got {shape}: export it so that it returns one row for each clip."
            )
        return features.double()

    def compute(self) -> Tensor:
        """The distance, float64."""
        moments = []
        for name, features in (("real", _joined(self.real_features)), ("generated", _joined(self.fake_features))):
            if len(features) < 2:
                raise ValueError(
                    f"Expected at least 2 {name} clips, but there are {len(features)}: give more or longer videos, or "
                    "lower `clip_length`."
                )
            moments += [features.mean(0), torch.cov(features.mT).reshape(features.shape[1], features.shape[1])]
        return frechet_distance(*moments)

    def protocol(self) -> dict[str, Any]:
        """Return the settings that the number depends on: network, hash, cutting, resizing, and number of clips."""
        counts = {"real_clips": _joined(self.real_features), "generated_clips": _joined(self.fake_features)}
        features = max((value.shape[-1] for value in counts.values()), default=0)
        return {
            "weights": self.weights.name,
            "weights_sha256": self.sha256,
            "clip_length": self.clip_length,
            "stride": self.stride,
            "resize": None if self.resize is None else list(self.resize),
            "interpolation": "bilinear, half-pixel centres, no prefilter",
            "value_range": [0.0, 1.0],
            **{name: len(value) for name, value in counts.items()},
            "features": features,
        }

    def describe(self) -> str:
        parts = ", ".join(f"{name} {value}" for name, value in self.protocol().items())
        return f"FVD {float(self.compute()):.5g} ({parts})"


def _joined(features: list[Tensor] | Tensor) -> Tensor:
    """The features of all batches: a list of them, or one tensor once torchmetrics has gathered them."""
    if isinstance(features, Tensor):
        return features
    return torch.cat(features) if features else torch.zeros(0, 0)


def _load_network(path: Path) -> tuple[str, Any]:
    if not path.is_file():
        raise ValueError(
            f"There is no file {path}: set `weights` to the path of an I3D network in TorchScript; none is downloaded."
        )
    content = path.read_bytes()
    try:
        network = torch.jit.load(str(path), map_location="cpu")
    except Exception as error:  # an archive of another kind, a truncated one, ...
        why = str(error).strip().split("\n")[0]
        raise ValueError(f"{path} cannot be read as TorchScript ({why}): export it with torch.jit.save.") from error
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    return hashlib.sha256(content).hexdigest(), network
