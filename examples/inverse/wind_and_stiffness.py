"""Two numbers from one motion. The positions of a soft flag, with noise of 0.1 mm, tell the wind and the stiffness.

A model takes tensors that require a gradient, and `step` keeps it; L-BFGS searches in the logarithms of both.
"""

import torch

from gaussian_swaying import Box, Material, MPMSolver, PinnedRegion, Simulation
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.step import start, step

pole = PinnedRegion(Box([None, None, None], [0.11, None, None]))
solver = MPMSolver(dx=0.2, boundaries=[pole], substep=5e-3)  # the same substeps for every guess
flag = Simulation(FlagScene(spacing=0.1), Material(density=30.0), solver=solver, dtype="float64", device="cpu").model
truth, logs = torch.tensor([6.0, 4e3]).double(), torch.tensor([3.5, 2e3]).double().log().requires_grad_()


def motion(speed, stiffness):
    model = flag.at({"wind.flow": speed * torch.tensor([0.8, 0.6, 0.0]).double(), "material.E": stiffness})
    states = [start(model)]
    for _ in range(6):
        states.append(step(model, states[-1]))
    return torch.stack([state.position for state in states])


def loss():
    optimiser.zero_grad()
    apart = ((motion(*logs.exp()) - seen) / 1e-3).square().sum(-1).mean()  # mm²
    apart.backward()
    return apart


seen = motion(*truth)
seen = seen + 1e-4 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(0))
optimiser = torch.optim.LBFGS([logs], max_iter=10, line_search_fn="strong_wolfe")
optimiser.step(loss)
errors = (logs.detach().exp() / truth - 1).abs()
print(f"wind and stiffness are off by {errors[0]:.2%} and {errors[1]:.2%}")
assert errors.max() < 0.02
