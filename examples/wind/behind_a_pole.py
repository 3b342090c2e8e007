"""The wake of a pole in a boundary layer. Effects are applied in order: the profile, then what the pole does to it.

A wind can be asked at any place and time.
"""

import torch

from gaussian_swaying import WindField
from gaussian_swaying.wind.effects import Obstacle, Profile

ground = Profile([0.0, 0.0, -1.0], height=2.0, roughness=0.01)
pole = Obstacle([0.0, 0.0, 0.0], [0.05, 0.05, None])  # metres, without end along z
wind = WindField([5.0, 0.0, 0.0], effects=[ground, pole])
places = torch.tensor([[0.5, 0.0, 0.0], [0.5, 0.6, 0.0], [-1.0, 0.6, -0.9]])
behind, beside, low = wind.at(torch.tensor(0.0, dtype=torch.float64), places).norm(dim=-1)
print(f"{behind:.1f} m/s behind the pole, {beside:.1f} beside it, {low:.1f} near the ground")
assert behind < 0.6 * beside
assert low < 0.7 * beside
