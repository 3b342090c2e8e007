"""Bones that move Gaussians nearly as a run does, for engines that know skins but no grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from gaussian_swaying.geometry.linalg import svd3
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

INFLUENCES = 4
"""Bones of a Gaussian, as many as glTF's readers take."""

_CANDIDATES = 8  # bones that are tried for a Gaussian
_SAMPLE = 3000  # Gaussians that the bones are fitted to
_ROUNDS = 12
_STEPS = 200  # of a search for weights


@dataclass(frozen=True)
class Bones:
    """A motion by linear blend skinning, x = sum of w (R (X - C) + C + t) over the bones of a Gaussian.

    Attributes:
        centres: Places of the bones at rest C [scene units], shape (J, 3).
        quats: Rotations wxyz in each frame, shape (F, J, 4).
        shifts: Translations t in each frame [scene units], shape (F, J, 3).
        index: The bones of each Gaussian, shape (N, 4).
        weight: Their weights, of sum one, shape (N, 4).
    """

    centres: Tensor
    quats: Tensor
    shifts: Tensor
    index: Tensor
    weight: Tensor

    def places(self, rest: Tensor, frame: int) -> Tensor:
        """Where the Gaussians with the rest positions (N, 3) are in a frame, shape (N, 3)."""
        own, turn = self.centres[self.index], quat_to_rotation(self.quats[frame])[self.index]
        moved = (turn @ (rest[:, None] - own)[..., None])[..., 0] + own + self.shifts[frame][self.index]
        return (self.weight[..., None] * moved).sum(1)

    def error(self, rest: Tensor, frames: Tensor) -> float:
        """Root mean square of what is missed in all frames (F, N, 3), over that of the motion."""
        missed = sum(float((self.places(rest, k) - places).square().sum()) for k, places in enumerate(frames))
        moved = sum(float((places - rest).square().sum()) for places in frames)
        return (missed / max(moved, 1e-300)) ** 0.5


def fit_bones(rest: Tensor, frames: Tensor, count: int = 48) -> Bones:
    """Fit bones to a motion (Le & Deng 2012, "Smooth Skinning Decomposition with Rigid Bones").

    The first bone stays where it is, for what does not move.

    Args:
        rest: Rest positions, shape (N, 3).
        frames: Positions in each frame, shape (F, N, 3).
        count: Number of bones, at least 2, and no more than Gaussians.

    Returns:
        The bones, in float64.
    """
    from scipy.cluster.vq import kmeans2

    rest, frames = rest.double().cpu(), frames.double().cpu()
    some = torch.from_numpy(np.random.default_rng(0).permutation(len(rest))[:_SAMPLE]).sort()[0]
    X, x = rest[some], frames[:, some]
    left, size, _ = torch.linalg.svd((x - X).movedim(0, 1).flatten(1), full_matrices=False)
    modes = left[:, :8] * size[:8]
    features = torch.cat([X / X.std().clamp_min(1e-30), modes / modes.std().clamp_min(1e-30)], 1)
    cluster = kmeans2(features.numpy(), count - 1, minit="++", rng=0)[1]
    bones = _rigid(X, x, one_hot(torch.from_numpy(cluster).long() + 1, count).double())
    for _ in range(_ROUNDS):
        bones = _improved(X, x, _weights(X, x, bones), bones)
    parts = zip(rest.split(_SAMPLE), frames.split(_SAMPLE, 1), strict=True)
    weight, index = torch.cat([_weights(*part, bones) for part in parts]).topk(min(INFLUENCES, count))
    weight, index = (torch.nn.functional.pad(part, (0, INFLUENCES - part.shape[1])) for part in (weight, index))
    whole = torch.zeros(count, dtype=torch.float64).index_add(0, index.flatten(), weight.flatten())[:, None]
    centres = torch.zeros(count, 3, dtype=torch.float64)
    centres.index_add_(0, index.flatten(), (weight[..., None] * rest[:, None]).flatten(0, 1))
    centres = centres / whole.clamp_min(1e-12)
    turn, shift = bones
    shifts = (turn @ centres[..., None])[..., 0] + shift - centres
    return Bones(centres, rotation_to_quat(turn), shifts, index, weight)


def _rigid(X: Tensor, x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The rigid motion of each bone that fits its points (N, J) best: (F, J, 3, 3) and (F, J, 3)."""
    share = weight / weight.sum(0).clamp_min(1e-12)
    middle, moved = share.T @ X, torch.einsum("nj,fni->fji", share, x)
    moment = torch.einsum("nj,fni,nk->fjik", share, x, X) - moved[..., None] * middle[:, None, :]
    turn = _nearest(moment)
    turn[:, 0] = torch.eye(3, dtype=X.dtype)
    shift = moved - (turn @ middle[..., None])[..., 0]
    shift[:, 0] = 0.0
    return turn, shift


def _nearest(moment: Tensor) -> Tensor:
    """The rotations that fit moments (..., 3, 3) best (Kabsch 1976)."""
    left, _, axes = svd3(moment)
    return left @ axes.mT


def _alone(X: Tensor, bones: tuple[Tensor, Tensor]) -> Tensor:
    """Where each bone alone carries points, shape (F, J, N, 3)."""
    return torch.einsum("fjik,nk->fjni", bones[0], X) + bones[1][:, :, None]


def _weights(X: Tensor, x: Tensor, bones: tuple[Tensor, Tensor]) -> Tensor:
    """Weights of at most four bones for each point, none negative, of sum one, shape (N, J)."""
    off = _alone(X, bones) - x[:, None]
    count = off.shape[1]
    near = off.square().sum((0, 3)).T.topk(min(_CANDIDATES, count), largest=False)[1]
    found = off.permute(2, 1, 0, 3).flatten(2).gather(1, near[..., None].expand(-1, -1, 3 * len(x)))
    gram = found @ found.mT
    best = _simplex(gram).topk(min(INFLUENCES, count))[1]
    inner = gram.gather(1, best[..., None].expand(-1, -1, gram.shape[2]))
    inner = inner.gather(2, best[:, None].expand(-1, best.shape[1], -1))
    return torch.zeros(len(X), count, dtype=X.dtype).scatter(1, near.gather(1, best), _simplex(inner))


def _simplex(gram: Tensor) -> Tensor:
    """Least w G w of w without negative entries, of sum one: accelerated projection (Beck & Teboulle 2009)."""
    w = torch.full(gram.shape[:2], 1 / gram.shape[1], dtype=gram.dtype)
    step = 1 / gram.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True).clamp_min(1e-300)
    ahead, pace = w, 1.0
    for _ in range(_STEPS):
        new = _projected(ahead - step * (gram @ ahead[..., None])[..., 0])
        later = (1 + (1 + 4 * pace * pace) ** 0.5) / 2
        ahead, w, pace = new + (pace - 1) / later * (new - w), new, later
    return w


def _projected(w: Tensor) -> Tensor:
    """The nearest weights that are not negative and of sum one (Duchi et al. 2008)."""
    ordered = w.sort(descending=True)[0]
    excess = (ordered.cumsum(1) - 1) / torch.arange(1, w.shape[1] + 1, dtype=w.dtype)
    count = (ordered > excess).sum(1, keepdim=True) - 1
    return (w - excess.gather(1, count)).clamp_min(0.0)


def _improved(X: Tensor, x: Tensor, weight: Tensor, bones: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Each bone fitted anew to what the others leave."""
    turn, shift = (part.clone() for part in bones)

    def carried(j: int, own: Tensor) -> Tensor:
        return torch.einsum("fik,nk->fni", turn[:, j], own) + shift[:, j, None]

    total = torch.einsum("nj,fjni->fni", weight, _alone(X, bones))
    for j in range(1, weight.shape[1]):
        some = weight[:, j] > 1e-4
        if int(some.sum()) < 4:
            continue
        w, own = weight[some, j], X[some]
        before = carried(j, own)
        wanted = x[:, some] - total[:, some] + w[:, None] * before
        share = w / w.square().sum()
        middle, moved = (w * share) @ own, torch.einsum("n,fni->fi", share, wanted)
        turn[:, j] = _nearest(torch.einsum("n,fni,nk->fik", share, wanted, own) - moved[..., None] * middle)
        shift[:, j] = moved - turn[:, j] @ middle
        total[:, some] += w[:, None] * (carried(j, own) - before)
    return turn, shift
