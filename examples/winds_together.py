"""Many winds at once: ``python examples/winds_together.py`` lets eight sheets fly in eight winds in one rollout.

All tensors have a leading batch dimension, (B, P, 3): the sheets share their kernels, but not their air.
"""

import torch

from gaussian_swaying import AeroForce, Box, MaterialPoints, MPMSolver, PinnedRegion, WindField, WindForce


def main(speeds: list[float], seconds: float = 1.0, side: int = 20) -> list[float]:
    """Return how far the free edge of each sheet has moved [m].

    Args:
        speeds: The winds, along y [m/s].
        seconds: Simulated time [s].
        side: Points along each side of a sheet.
    """
    width, thickness = 1.0, 0.01
    axis = (torch.arange(side) + 0.5) / side * width
    sheet = torch.cartesian_prod(axis, torch.zeros(1), axis)  # in the plane of x and z
    sheets = sheet.repeat(len(speeds), 1, 1)
    area = (width / side) ** 2
    points = MaterialPoints.create(sheets, volume=area * thickness, density=30.0, youngs_modulus=3e3, poisson_ratio=0.3)
    normal = torch.tensor([0.0, 1.0, 0.0]).expand_as(sheets)
    winds = [WindField([0.0, speed, 0.0]) for speed in speeds]
    wind = WindForce(AeroForce(C_D=1.2), winds, normal, torch.full(sheets.shape[:2], area))
    pole = Box(min=[None, None, None], max=[0.1, None, None])
    solver = MPMSolver(dx=2.2 * width / side, gravity=[0.0, 0.0, 0.0], damping=1.0, boundaries=[PinnedRegion(pole)])
    state = solver.init_state(points)
    dt = 0.5 * solver.stable_substep(state)
    state = solver.rollout(state, dt=dt, steps=round(seconds / dt), forces=wind)
    free = sheet[:, 0] > 0.9
    return [float(moved[free].norm(dim=-1).mean()) for moved in state.position - sheets]


if __name__ == "__main__":
    speeds = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
    moved = main(speeds)
    for speed, distance in zip(speeds, moved, strict=True):
        print(f"{speed:.0f} m/s: {distance:.2f} m")
    assert moved[-1] > moved[0], "the strongest wind moves its sheet further than the weakest"
