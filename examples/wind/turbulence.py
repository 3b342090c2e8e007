"""Turbulence that differs from place to place. A box of air without divergence is carried along by the mean flow.

`intensity` is the standard deviation along the wind as a ratio to the mean speed, `length` the size of the large gusts.
"""

import torch

from gaussian_swaying import WindField
from gaussian_swaying.wind.turbulence import Turbulence

air = Turbulence(intensity=0.2, length=0.5, cells=[64, 32, 32])
wind = WindField([5.0, 0.0, 0.0], effects=[air])
place = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 4 - 2  # metres from the object's centre
seen = torch.stack([wind.at(torch.tensor(0.1 * k, dtype=torch.float64), place) for k in range(40)])
intensity = float(seen[..., 0].std() / seen[..., 0].mean())
print(f"intensity {intensity:.3f}, of which the box resolves {air.resolved:.0%}")
assert 0.1 < intensity < 0.3  # a box of a few gusts
