"""A wind by its effect: ``python examples/wind_by_gradient.py`` finds the wind that made a motion.

A rollout is differentiable, so an optimiser of torch can change the wind, a stiffness, or where the sheet begins.
"""

import torch

from gaussian_swaying import AeroForce, MaterialPoints, MPMSolver, WindField, WindForce


def main(true: float = 3.0, first: float = 1.0, rounds: int = 10, side: int = 8, steps: int = 60) -> float:
    """Return the speed that was found [m/s].

    Args:
        true: The speed that made the motion [m/s].
        first: Where the search begins [m/s].
        rounds: Most steps of the optimiser.
        side: Points along each side of the sheet.
        steps: Substeps of a rollout.
    """
    axis = (torch.arange(side) + 0.5) / side
    sheet = torch.cartesian_prod(axis, axis, torch.zeros(1))
    points = MaterialPoints.create(sheet, volume=0.01 / side**2, density=30.0, youngs_modulus=3e3, poisson_ratio=0.3)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(sheet)
    solver = MPMSolver(dx=2.2 / side)
    start = solver.init_state(points)
    dt = 0.4 * solver.stable_substep(start)

    def end(speed: torch.Tensor | float) -> torch.Tensor:
        """Where the points are after the rollout, in a wind from below."""
        flow = torch.stack([torch.zeros(()), torch.zeros(()), torch.as_tensor(speed)])
        wind = WindForce(AeroForce(C_D=1.2), WindField(flow), up, torch.full((len(sheet),), 1.0 / side**2))
        return solver.rollout(start, dt=dt, steps=steps, forces=wind).position

    with torch.no_grad():
        seen = end(true)
    speed = torch.tensor(first, requires_grad=True)
    optimiser = torch.optim.LBFGS([speed], max_iter=rounds, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        """How far the end is from what was seen, as a share of the motion, squared; with its gradient."""
        optimiser.zero_grad()
        apart = (end(speed) - seen).square().mean() / (seen - sheet).square().mean()
        apart.backward()
        return apart

    optimiser.step(loss)
    return speed.item()


if __name__ == "__main__":
    found = main()
    print(f"{found:.2f} m/s, and 3.00 m/s made the motion")
    assert abs(found - 3.0) < 0.01
