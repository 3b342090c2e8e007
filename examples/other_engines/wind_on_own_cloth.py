"""The wind in a cloth code of your own. `AeroForce` takes velocities, normals and areas, and returns forces.

A strip of springs hangs in the wind, at the angle of a hinged plate: the push across it balances its weight.
"""

import math

import torch

from gaussian_swaying import AeroForce

count, density, stiffness, speed, dt = 9, 0.4, 200.0, 2.0, 1e-3  # joints, kg/m², N/m, m/s, s
aero, gap = AeroForce(C_D=1.2, C_F=0.0, C_L=0.0), 1 / (count - 1)  # one metre long and wide
wind, gravity = torch.tensor([0.0, speed, 0.0]), torch.tensor([0.0, 0.0, -9.8])
place = torch.zeros(count, 3)
place[:, 2] = -gap * torch.arange(count)
velocity = torch.zeros_like(place)
area = torch.full((count,), gap)  # of each joint [m²]
area[[0, -1]] /= 2
for _ in range(6000):
    arm = torch.diff(place, dim=0)
    length = arm.norm(dim=-1, keepdim=True)
    pull = stiffness * (length - gap) / gap * arm / length  # N, between two joints
    along = torch.cat([arm[:1], arm[1:] + arm[:-1], arm[-1:]])
    normal = torch.linalg.cross(torch.tensor([1.0, 0.0, 0.0]).expand_as(along), along)
    force = aero(wind, velocity, normal / normal.norm(dim=-1, keepdim=True), area)  # N, on each joint
    force[:-1] += pull
    force[1:] -= pull
    velocity = (velocity + dt * (force / (density * area[:, None]) + gravity)) * (1 - 2 * dt)
    velocity[0] = 0  # the upper edge is held
    place = place + dt * velocity
found = math.degrees(math.atan2(place[-1, 1], -place[-1, 2]))
exact = math.degrees(math.asin(0.5 * aero.air_density * 1.2 * speed**2 / (density * 9.8)))
print(f"the cloth hangs at {found:.1f} degrees, a plate at {exact:.1f}")
assert abs(found - exact) < 0.05 * exact
