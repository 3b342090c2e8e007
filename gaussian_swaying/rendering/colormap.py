"""Numbers as colours."""

from __future__ import annotations

import torch
from torch import Tensor

# viridis (S. van der Walt and N. Smith, CC0) at nine places, evenly from 0 to 1
_VIRIDIS = (
    (0.267, 0.005, 0.329),
    (0.279, 0.175, 0.483),
    (0.230, 0.322, 0.546),
    (0.173, 0.449, 0.558),
    (0.128, 0.567, 0.551),
    (0.158, 0.684, 0.502),
    (0.369, 0.789, 0.383),
    (0.678, 0.864, 0.190),
    (0.993, 0.906, 0.144),
)


def colormap(values: Tensor) -> Tensor:
    """Colours from dark violet at 0 through green to yellow at 1 (viridis); values outside are clamped.

    Args:
        values: Shape (...); NaN gets the colour of 0.

    Returns:
        Colours in [0, 1], shape (..., 3).
    """
    table = torch.tensor(_VIRIDIS, dtype=values.dtype).to(values.device, non_blocking=True)
    place = values.nan_to_num(0.0).clamp(0, 1) * (len(_VIRIDIS) - 1)
    low = place.floor().clamp(max=len(_VIRIDIS) - 2)
    return torch.lerp(table[low.long()], table[low.long() + 1], (place - low)[..., None])
