"""One of each law, and of each boundary condition and obstacle, for all tests that go through them."""

from pathlib import Path

import torch

from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.regions import Box, Capsule, HalfSpace, Mesh, Sphere, StillGaussians
from gaussian_swaying.mpm import colliders, pins
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.laws import LAWS

BOUNDARIES = {
    name: found
    for file in (colliders, pins)
    for name, found in vars(file).items()
    if getattr(found, "__module__", "") == file.__name__ and isinstance(found, type)
    if issubclass(found, Boundary)
}
"""The boundary conditions of the package by name."""

MESH = str(Path(__file__).parent / "mpm" / "boundaries" / "octahedron.obj")

ELASTIC = {
    "corotated": LAWS["FixedCorotated"](),
    "neo-hookean": LAWS["NeoHookean"](),
    "springs": LAWS["SpringNetwork"](),
    "hencky": LAWS["StVKHencky"](),
}
PLASTIC = {
    "sand": LAWS["Sand"](),
    "sand that swells": LAWS["Sand"](35.0, volume_correction=True),
    "metal": LAWS["Metal"](100.0, 50.0),
    "foam": LAWS["Foam"](100.0, 20.0),
    "foam without viscosity": LAWS["Foam"](100.0, 0.0),
    "plasticine": LAWS["Plasticine"](100.0, 500.0, 20.0),
    "snow": LAWS["Snow"](),
    "fluid": LAWS["Fluid"](),
}


def _still(**more):
    """A ball made of distances, as a simulation makes them of Gaussians; in metres, whatever the frame."""
    axis = torch.arange(8, dtype=torch.float64) * 0.1 - 0.33
    nodes = torch.cartesian_prod(axis, axis, axis).reshape(8, 8, 8, 3)
    obstacle = BOUNDARIES["Obstacle"](StillGaussians(), **more)
    obstacle.take(DistanceGrid((nodes - 0.03).norm(dim=-1) - 0.26, nodes[0, 0, 0], 0.1))
    return obstacle


OBSTACLES = {
    "ball": lambda **more: BOUNDARIES["Obstacle"](Sphere([0.1, 0.2, 0.2], 0.15), **more),
    "capsule": lambda **more: BOUNDARIES["Obstacle"](Capsule([0.01, 0.13, 0.2], [0.31, 0.3, 0.13], 0.11), **more),
    "capsule that is a ball": lambda **more: BOUNDARIES["Obstacle"](Capsule(*[[0.1, 0.2, 0.2]] * 2, 0.11), **more),
    "block": lambda **more: BOUNDARIES["Obstacle"](Box([0.0, 0.1, 0.2], [0.3, 0.3, 0.4]), rotation=[20, 0, 40], **more),
    "ground": lambda **more: BOUNDARIES["Obstacle"](HalfSpace([0.1, 0.2, 0.2], [0.0, 0.3, 1.0]), **more),
    "mesh": lambda **more: BOUNDARIES["Obstacle"](Mesh(MESH, 12, [0.113, 0.207, 0.181]), **more),
    "still": _still,
}


def made(kind, /, *given, **settings):
    return lambda **more: BOUNDARIES[kind](*given, **settings | more)


def conditions(region):
    pull = {"velocity": [0.1, 0.0, 0.0], "angular_velocity": [0.0, 0.0, 1.0], "pivot": [0.1, 0.2, 0.3]}
    front = [[0.0, -0.3, 0.1], [0.0, 0.9, 0.1]]
    return {
        "pin": made("PinnedRegion", region),
        "points": made("PinnedPoints", [[0.1, 0.2, 0.3], [0.3, 0.1, 0.2]]),
        "handle": made("PinnedRegion", region, **pull),
        "release": made("PinnedRegion", region, front=[[0.0, 1.0, 0.0]], end=1.0),
        "front": made("PinnedRegion", region, front=front, end=1.0),
        "impulse": made("Impulse", region, [0.1, 0.2, 0.3]),
        "impulse for each": made("Impulse", region, [0.01, 0.02, 0.03], per_particle=True),
        "plane": made("Wall", HalfSpace([0.11, 0.12, 0.23], [0.0, 1.0, 1.5]), "slip", 0.3),
        "box": made("Wall", Box([-0.13, 0.07, 0.13], [0.33, 0.43, 0.51]), "separate", 0.3),
        "velocity": made("VelocityBox", region, [0.1, 0.2, 0.3]),
    }
