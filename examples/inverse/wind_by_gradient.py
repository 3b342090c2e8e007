"""A wind by its effect. A rollout is differentiable, so an optimiser of torch finds the wind that made a motion."""

import torch

from gaussian_swaying import AeroForce, MaterialPoints, MPMSolver, WindField, WindForce

side, true = 6, 3.0
axis = (torch.arange(side) + 0.5) / side
sheet = torch.cartesian_prod(axis, axis, torch.zeros(1))
points = MaterialPoints.create(sheet, volume=0.01 / side**2, density=30.0, youngs_modulus=3e3, poisson_ratio=0.3)
up = torch.tensor([0.0, 0.0, 1.0]).expand_as(sheet)
solver = MPMSolver(dx=2.2 / side)
start = solver.init_state(points)
dt = 0.4 * solver.stable_substep(start)


def end(speed):  # where the points are after the rollout, in a wind from below
    wind = WindField(torch.stack([torch.zeros(()), torch.zeros(()), torch.as_tensor(speed)]))
    force = WindForce(AeroForce(C_D=1.2), wind, up, torch.full((len(sheet),), 1.0 / side**2))
    return solver.rollout(start, dt=dt, steps=20, forces=force).position


seen, speed = end(true), torch.tensor(1.0, requires_grad=True)
optimiser = torch.optim.LBFGS([speed], max_iter=10, line_search_fn="strong_wolfe")


def loss():
    optimiser.zero_grad()
    apart = (end(speed) - seen).square().mean() / (seen - sheet).square().mean()
    apart.backward()
    return apart


optimiser.step(loss)
print(f"{speed.item():.3f} m/s, and {true} m/s made the motion")
assert abs(speed.item() / true - 1) < 1e-3
