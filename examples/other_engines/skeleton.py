"""Bones move a splat. A chain of joints bends, and a stem of Gaussians around it follows.

Between joints a line has no twist: around itself each Gaussian turns by the smallest rotation.
"""

import torch

from gaussian_swaying import GaussianCloud, SplatSkin

count, length, radius = 2000, 1.0, 0.02  # m
height, angle = length * torch.rand(count), 2 * torch.pi * torch.rand(count)
means = torch.stack([radius * angle.cos(), radius * angle.sin(), height], -1)
quats = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], -1)  # their x axis points outwards
scales = torch.tensor([0.001, 0.004, 0.008]).log().repeat(count, 1)
stem = GaussianCloud(means, quats, scales, torch.full((count,), 4.0), torch.full((count, 1, 3), 0.3))

joints = torch.zeros(21, 3)
joints[:, 2] = torch.linspace(0, length, 21)
skin = SplatSkin(stem, joints)
for frame in range(10):
    bend = 0.15 * frame * joints[:, 2] / length  # rad, more towards the tip
    bones = torch.stack([bend.sin(), 0 * bend, bend.cos()], -1)[:-1] * length / 20
    moved = skin(torch.cat([joints[:1], bones.cumsum(0)]))
along = torch.nn.functional.normalize(bones[-1], dim=0)
outwards = (moved.normals @ along).abs()[height > 0.97]
print(
    f"the tip has moved {(moved.means - means).norm(dim=-1).max():.2f} m; normals stay across to {outwards.max():.1%}"
)
assert outwards.max() < 0.1
