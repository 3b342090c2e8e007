"""Gusts that are the same everywhere. A wind is a function of time: a mean flow, and modulations of it.

The same seed gives the same gusts, whatever the steps of time.
"""

import torch

from gaussian_swaying import GaussianGust, SineSway, UniformGust, WindField

modulations = [SineSway(0.3, period=2.0), UniformGust(0.2), GaussianGust(0.5)]
wind = WindField([5.0, 0.0, 0.0], modulations=modulations, seed=3)
times = torch.arange(0, 20, 0.04, dtype=torch.float64)
speed = torch.stack([wind(time) for time in times])[:, 0]
print(f"{speed.mean():.2f} m/s on average, from {speed.min():.2f} to {speed.max():.2f}")
again = WindField([5.0, 0.0, 0.0], modulations=modulations, seed=3)
assert torch.equal(again(times[77]), wind(times[77]))
assert abs(speed.mean() - 5) < 1
