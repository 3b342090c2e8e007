"""Scenes that show wind with a shape: a row of plants, and a ficus behind a wall."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.ficus import FicusScene
from gaussian_swaying.scenes.patches import Patches, box, copies, facing, join, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, tints
from gaussian_swaying.scenes.procedural import ProceduralScene, both
from gaussian_swaying.scenes.stage import cast, floor


@dataclass(eq=False)
class PlantRowScene(ProceduralScene):
    """A row of leafy plants along x on a floor at z = 0, z up.

    Each has a stem of 1.1 m and leaves of 16 cm, and they stand 0.6 m apart, around x = 0.

    Args:
        count: Number of plants.
        spacing: Distance between Gaussians [m]; a leaf has at least one.
        leaves: Leaves of a plant.
        seed: Seed of the growth.
    """

    count: int = 5
    spacing: float = 0.012
    leaves: int = 60
    seed: int = 0

    def __post_init__(self) -> None:
        self.check("count", "leaves", coarsest=0.1)

    def generate(self) -> GaussianCloud:
        draw = Draw(self.seed)
        places = [(k - 0.5 * (self.count - 1)) * 0.6 for k in range(self.count)]
        shade = [cast((x, 0.0, 0.5), 0.3, 0.35) for x in places]
        parts: list[Patches] = [floor(max(2 * self.spacing, 0.03), (0.62, 0.58, 0.44), shade)]
        for x in places:
            parts += self._plant(draw, x)
        return to_cloud(join(parts), overlap=0.45)

    def _plant(self, draw: Draw, x: float) -> list[Patches]:
        lean = draw.uniform(-0.05, 0.05, 2).tolist()
        stem = bezier([[x, 0.0, -0.02], [x + lean[0], lean[1], 0.5], [x, 0.0, 1.1]])
        green = tube(stem, torch.linspace(0.014, 0.006, len(stem)), self.spacing, (0.30, 0.42, 0.16))
        share = (torch.arange(self.leaves, dtype=torch.float64) + draw.uniform(0.2, 0.8, self.leaves)) / self.leaves
        place = (0.22 + 0.77 * share) * (len(stem) - 1)
        low = place.long().clamp(max=len(stem) - 2)
        spot = torch.lerp(stem[low], stem[low + 1], (place - low)[:, None])
        turn = 2.39996 * torch.arange(self.leaves, dtype=torch.float64) + draw.uniform(-0.4, 0.4, self.leaves)
        way = torch.stack([turn.cos(), turn.sin(), 0.15 + 0.5 * share], dim=-1) + 0.15 * draw.normal(self.leaves, 3)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) + 0.2 * draw.normal(self.leaves, 3)
        blade = leaf(0.16, 0.055, self.spacing, droop=0.15, colour=(0.26, 0.50, 0.15), vein=(0.45, 0.62, 0.28))
        size = draw.uniform(0.75, 1.15, self.leaves) * (1.1 - 0.45 * share)
        return [green, copies(blade, facing(way, up), size, spot, tints(draw, self.leaves))]


@dataclass(eq=False)
class FicusBehindWallScene(ProceduralScene):
    """A :class:`FicusScene`, and a garden wall upwind of it, at negative x, on its floor at z = 0.

    Args:
        spacing: Distance between Gaussians of the tree [m].
        leaves: Number of leaves.
        distance: Distance of the wall from the middle of the tree [m].
        height: Height of the wall [m].
        length: Length of the wall along y [m].
        seed: Seed of the growth.
    """

    spacing: float = 0.008
    leaves: int = 2400
    distance: float = 1.5
    height: float = 1.3
    length: float = 2.4
    seed: int = 0

    def __post_init__(self) -> None:
        self.check("distance", "height", "length")
        self.tree = FicusScene(self.spacing, self.leaves, self.seed)

    def generate(self) -> GaussianCloud:
        """Make both; the tree comes first."""
        low = (-self.distance - 0.1, -0.5 * self.length, 0.0)
        high = (-self.distance + 0.1, 0.5 * self.length, self.height)
        wall = box(low, high, max(0.03, self.tree.spacing), (0.70, 0.52, 0.42))
        z, y = wall.center[:, 2], wall.center[:, 1]
        course = torch.floor(z / 0.13)  # rows of stones, each shifted by a half
        joint = (z / 0.13 - course < 0.22) | ((y / 0.3 + 0.5 * course) % 1 < 0.1)
        wall = wall.painted((0.80, 0.76, 0.70), joint)
        return both(self.tree.generate(), to_cloud(wall, two_sided=False))
