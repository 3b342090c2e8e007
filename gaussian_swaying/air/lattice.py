"""The lattice D3Q27: 27 velocities to the neighbours of a cell and to itself, and metres and seconds on it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

DIRECTIONS: tuple[tuple[int, int, int], ...] = tuple(itertools.product((0, 1, -1), (0, 1, -1), (0, 1, -1)))
"""The velocities [cells per step], the one at rest first."""

WEIGHTS: tuple[float, ...] = tuple(math.prod((2 / 3, 1 / 6)[abs(c)] for c in each) for each in DIRECTIONS)
"""Their weights: products of 2/3, 1/6, 1/6 (Gauss-Hermite quadrature of three points along each axis)."""

OPPOSITE: tuple[int, ...] = tuple(DIRECTIONS.index((-x, -y, -z)) for x, y, z in DIRECTIONS)
"""The number of the opposite velocity."""

SOUND = 1 / math.sqrt(3)
"""Speed of sound [cells per step]."""

FASTEST = 0.3
"""Largest speed [cells per step] at which the error of compressibility, some u² / c², may be called small."""


@dataclass(frozen=True)
class LatticeUnits:
    """Metres and seconds on a lattice.

    Attributes:
        spacing: Side of a cell [m].
        dt: Time step [s].
        viscosity: Kinematic viscosity of the fluid [m²/s].
        density: Its density [kg/m³].
    """

    spacing: float
    dt: float
    viscosity: float
    density: float

    @classmethod
    def at_speed(
        cls, spacing: float, speed: float, *, lattice_speed: float = 0.1, viscosity: float, density: float
    ) -> LatticeUnits:
        """Units in which a speed [m/s] is ``lattice_speed`` cells per step."""
        return cls(float(spacing), lattice_speed * spacing / speed, float(viscosity), float(density))

    @property
    def speed(self) -> float:
        """One cell per step [m/s]."""
        return self.spacing / self.dt

    @property
    def relaxation(self) -> float:
        """Relaxation time of the molecular viscosity [steps], 1/2 + 3 nu dt / h²."""
        return 0.5 + 3 * self.viscosity * self.dt / self.spacing**2

    @property
    def cell_mass(self) -> float:
        """Mass of the air in a cell [kg]."""
        return self.density * self.spacing**3
