"""A force in three lines. Any function of the state that returns newtons for each material point is a force.

Here a magnet beside a hanging sheet attracts it.
"""

import torch

from gaussian_swaying import Box, MaterialPoints, MPMSolver, PinnedRegion

axis = torch.linspace(0.05, 0.95, 10)
sheet = torch.cartesian_prod(axis, torch.zeros(1), axis)
points = MaterialPoints.create(sheet, volume=1e-4, density=30.0, youngs_modulus=3e3, poisson_ratio=0.3)
magnet = torch.tensor([0.5, 0.6, 0.0])


def attraction(state):
    away = magnet - state.position
    return 2e-3 * away / away.norm(dim=-1, keepdim=True) ** 3


pin = PinnedRegion(Box([None, None, 0.9], [None, None, None]))
solver = MPMSolver(dx=0.22, boundaries=[pin], damping=1.0)
state = solver.init_state(points)
state = solver.rollout(state, dt=1e-3, steps=400, forces=attraction)
moved = (state.position - sheet)[:, 1].reshape(10, 10).mean(0)
print("moved towards the magnet by", *(f"{x:.3f}" for x in moved[[9, 5, 0]]), "m from the top to the foot")
assert moved[0] > moved[5] > moved[9]
