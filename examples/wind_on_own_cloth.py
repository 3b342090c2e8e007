"""The wind in a cloth code of your own: ``python examples/wind_on_own_cloth.py`` steps springs in this wind.

``AeroForce`` knows neither a solver nor a grid: it takes velocities, normals and areas, and returns forces.
"""

import math

import torch
from torch import Tensor

from gaussian_swaying import AeroForce


def springs(side: int, gap: float) -> tuple[Tensor, Tensor, Tensor]:
    """A square cloth in the plane of x and z: its corners, pairs of neighbours, and the length of each."""
    axis = torch.arange(side) * gap
    place = torch.cartesian_prod(axis, torch.zeros(1), axis)
    number = torch.arange(side * side).reshape(side, side)
    along = [(number[1:], number[:-1]), (number[:, 1:], number[:, :-1]), (number[1:, 1:], number[:-1, :-1])]
    pairs = torch.cat([torch.stack([a.reshape(-1), b.reshape(-1)], -1) for a, b in along])
    return place, pairs, (place[pairs[:, 0]] - place[pairs[:, 1]]).norm(dim=-1)


def areas(place: Tensor, side: int) -> Tensor:
    """Area vectors of the corners [m²]: a quarter of the cross products of the diagonals of the squares around each."""
    grid = place.reshape(side, side, 3)
    square = torch.linalg.cross(grid[1:, 1:] - grid[:-1, :-1], grid[:-1, 1:] - grid[1:, :-1]) / 8
    total = torch.zeros_like(grid)
    for rows in (slice(1, None), slice(None, -1)):
        for columns in (slice(1, None), slice(None, -1)):
            total[rows, columns] += square
    return total.reshape(-1, 3)


def main(speed: float = 2.0, seconds: float = 4.0, side: int = 16) -> tuple[float, float]:
    """The angle at which the cloth hangs in the wind, and that of a plate hinged at its upper edge [degrees].

    Args:
        speed: Of the wind, along y [m/s].
        seconds: Simulated time [s].
        side: Corners along each edge.
    """
    gap, density, stiffness, dt = 1.0 / (side - 1), 0.4, 2e2, 5e-4  # m, kg/m², N/m, s
    aero, wind, gravity = (
        AeroForce(C_D=1.2, C_F=0.0, C_L=0.0),
        torch.tensor([0.0, speed, 0.0]),
        torch.tensor([0, 0, -9.8]),
    )
    place, pairs, length = springs(side, gap)
    velocity, mass = torch.zeros_like(place), density * areas(place, side).norm(dim=-1)
    free = (place[:, 2] < 1.0 - 0.5 * gap)[:, None]  # the upper edge is held
    for _ in range(round(seconds / dt)):
        vector = areas(place, side)
        area = vector.norm(dim=-1)
        push = aero(wind, velocity, vector / area[:, None], area)  # N, on each corner
        arm = place[pairs[:, 0]] - place[pairs[:, 1]]
        now = arm.norm(dim=-1)
        pull = (stiffness * (now - length) / now)[:, None] * arm
        force = push.index_add(0, pairs[:, 0], -pull).index_add(0, pairs[:, 1], pull)
        velocity = torch.where(free, (velocity + dt * (force / mass[:, None] + gravity)) * (1 - 2 * dt), 0.0)
        place = place + dt * velocity
    low = place.reshape(side, side, 3)[:, 0].mean(0)
    found = torch.rad2deg(torch.atan2(low[1], 1.0 - low[2]))
    push = 0.5 * aero.air_density * 1.2 * speed**2 / (density * 9.8)  # across the plate, per weight: its sine
    return float(found), math.degrees(math.asin(push))


if __name__ == "__main__":
    found, exact = main()
    print(f"the cloth hangs at {found:.1f} degrees, a plate at {exact:.1f}")
    assert abs(found - exact) < 0.1 * exact
