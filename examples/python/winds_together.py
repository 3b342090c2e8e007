"""Many winds at once. Components take leading batch dimensions, so eight sheets fly in eight winds in one rollout.

The sheets share their kernels, but not their air.
"""

import torch

from gaussian_swaying import AeroForce, Box, MaterialPoints, MPMSolver, PinnedRegion, WindField, WindForce

speeds, side, thickness = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 10, 0.01
axis = (torch.arange(side) + 0.5) / side
sheet = torch.cartesian_prod(axis, torch.zeros(1), axis)  # in the plane of x and z
sheets, area = sheet.repeat(len(speeds), 1, 1), 1 / side**2
points = MaterialPoints.create(sheets, volume=area * thickness, density=30.0, youngs_modulus=3e3, poisson_ratio=0.3)
normal = torch.tensor([0.0, 1.0, 0.0]).expand_as(sheets)
winds = [WindField([0.0, speed, 0.0]) for speed in speeds]
wind = WindForce(AeroForce(C_D=1.2), winds, normal, torch.full(sheets.shape[:2], area))
pole = PinnedRegion(Box([None, None, None], [0.1, None, None]))
solver = MPMSolver(dx=2.2 / side, gravity=[0.0, 0.0, 0.0], damping=1.0, boundaries=[pole])
state = solver.init_state(points)
dt = 0.5 * solver.stable_substep(state)
state = solver.rollout(state, dt=dt, steps=round(0.3 / dt), forces=wind)
moved = (state.position - sheets)[:, sheet[:, 0] > 0.9].norm(dim=-1).mean(-1).tolist()
for speed, distance in zip(speeds, moved, strict=True):
    print(f"{speed:.0f} m/s: {distance:.3f} m")
assert moved[0] == 0
assert moved == sorted(moved)
