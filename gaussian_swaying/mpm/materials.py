"""Materials by name: numbers for cloth, leaves and wood, each with its source.

They are those of the real material, at small strain and the same in all directions, which cloth, grass and wood are
not. Real ones are much stiffer than what is usually simulated, and a wave may cross at most part of a cell in a
substep: see :attr:`KnownMaterial.wave_speed`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gaussian_swaying._checks import check_choice


@dataclass(frozen=True, slots=True)
class KnownMaterial:
    """Numbers of a material.

    Attributes:
        E: Young's modulus [Pa]; of fibrous materials along the fibres.
        nu: Poisson's ratio.
        density: Density [kg/m³].
        thickness: Thickness of a sheet of it [m].
        damping_ratio: Share of critical damping of its vibrations, without that of the air. For cloth a sixth of the
            hysteresis of its bending, as gravity and tension bring cloth back rather than bending.
        source: Where the numbers are from.
    """

    E: float
    nu: float
    density: float
    thickness: float
    damping_ratio: float
    source: str

    @property
    def damping(self) -> float:
        """``solver.damping`` [1/s] with which a sway at 1 Hz has the damping ratio: 4 pi times it, to two digits."""
        return float(f"{4 * math.pi * self.damping_ratio:.2g}")

    @property
    def wave_speed(self) -> float:
        """Speed of waves along it, sqrt(E / density) [m/s]; substeps are as many times shorter as it is faster."""
        return math.sqrt(self.E / self.density)

    @property
    def numbers(self) -> dict[str, float]:
        """The fields of a ``Material``: E, nu, density and thickness."""
        return {name: getattr(self, name) for name in ("E", "nu", "density", "thickness")}


_WOVEN = "stretch per mass of the woven fabrics of Wang, O'Brien & Ramamoorthi 2011"

MATERIALS: dict[str, KnownMaterial] = {
    "cotton": KnownMaterial(1.3e7, 0.3, 430.0, 0.0003, 0.02, "a woven fabric of Wang, O'Brien & Ramamoorthi 2011"),
    "silk": KnownMaterial(1.6e7, 0.3, 520.0, 0.0001, 0.02, f"12 momme, which is 52 g/m²; {_WOVEN}"),
    "denim": KnownMaterial(
        2.5e6, 0.3, 405.0, 0.0008, 0.02,
        "11 oz denim of Wang, O'Brien & Ramamoorthi 2011; thickness: Journal of Textiles 2016, 4614168, table 5",
    ),
    "canvas": KnownMaterial(1.8e7, 0.3, 565.0, 0.0006, 0.02, f"duck of 10 oz/yd², which is 339 g/m²; {_WOVEN}"),
    "leather": KnownMaterial(1e8, 0.4, 930.0, 0.0012, 0.05, "Ashby 2011, soft end of the range; upholstery"),
    "rubber": KnownMaterial(2e6, 0.45, 925.0, 0.002, 0.05, "Ashby 2011, natural rubber; nu lowered from 0.5"),
    "paper": KnownMaterial(3.4e9, 0.3, 1067.0, 0.000075, 0.01, "flags of D'Adamo et al. 2024; damping: Ashby 2011"),
    "grass": KnownMaterial(
        4.9e8, 0.3, 700.0, 0.00025, 0.05, "Vincent 1982 and 1991: 2 % of fibres carry 93 % of the stiffness"
    ),
    "leaf": KnownMaterial(5e7, 0.3, 800.0, 0.00025, 0.05, "between epidermis and mesophyll of Onoda et al. 2015"),
    "twig": KnownMaterial(
        2e9, 0.35, 900.0, 0.002, 0.05,
        "branches of Cannell & Morgan 1987; damping: a tree in winter, Jackson et al. 2019",
    ),
    "wood": KnownMaterial(
        1e10, 0.35, 500.0, 0.01, 0.005, "dry softwood along the grain, Ross 2010; damping: Ashby 2011"
    ),
}  # fmt: skip
"""The known materials by name."""


def known_material(name: str, field: str = "material") -> KnownMaterial:
    """The material of a name.

    Raises:
        ValueError: If there is none; the message lists the names. ``field`` is the option that it names.
    """
    check_choice(field, name, tuple(MATERIALS))
    return MATERIALS[name]


def name_of(E: float, nu: float, density: float) -> str | None:
    """The name of the material with these numbers; None if there is none."""
    found = (name for name, known in MATERIALS.items() if (known.E, known.nu, known.density) == (E, nu, density))
    return next(found, None)


__all__ = ["MATERIALS", "KnownMaterial", "known_material", "name_of"]
