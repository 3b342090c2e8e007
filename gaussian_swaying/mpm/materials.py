"""Materials by name: numbers for cloth, plants, wood and what stands still, with what was read and what is an estimate.

They are of the size of the real material's, at small strain and the same in all directions, which cloth, grass, stems,
wood and cardboard are not. Real ones are much stiffer than what is usually simulated, and a wave may cross at most part
of a cell in a substep: see :attr:`KnownMaterial.wave_speed`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gaussian_swaying._checks import check_choice
from gaussian_swaying._fixed import fixed
from gaussian_swaying.mpm.damping import decay_rate


@fixed
@dataclass(frozen=True, slots=True)
class KnownMaterial:
    """Numbers of a material.

    Attributes:
        E: Young's modulus [Pa]; of fibrous materials along the fibres.
        nu: Poisson's ratio.
        density: Density [kg/m³].
        thickness: Thickness of a sheet of it [m].
        damping_ratio: Share of critical damping of its vibrations, without that of the air.
        source: What was read in a source, and which; empty if nothing was.
        estimated: What is our estimate, and where to compare it.
    """

    E: float
    nu: float
    density: float
    thickness: float
    damping_ratio: float
    source: str
    estimated: str

    @property
    def damping(self) -> float:
        """``solver.damping`` [1/s] with which a sway at 1 Hz has the damping ratio, to two digits."""
        return float(f"{decay_rate(self.damping_ratio, 1.0):.2g}")

    @property
    def wave_speed(self) -> float:
        """Speed of waves along it, sqrt(E / density) [m/s]; substeps are as many times shorter as it is faster."""
        return math.sqrt(self.E / self.density)

    @property
    def numbers(self) -> dict[str, float]:
        return {name: getattr(self, name) for name in ("E", "nu", "density", "thickness")}


_WANG = "Wang, O'Brien & Ramamoorthi 2011"
_WOVEN = f"stretch per mass as for cotton ({_WANG})"

MATERIALS: dict[str, KnownMaterial] = {
    "cotton": KnownMaterial(
        1.3e7, 0.3, 430.0, 0.0003, 0.02,
        f"mass and stretch (4 kN/m) of a light woven fabric, of whatever fibre: {_WANG}",
        "nu, thickness, damping",
    ),
    "silk": KnownMaterial(
        1.6e7, 0.3, 520.0, 0.0001, 0.02, f"12 momme, which is 52 g/m²; {_WOVEN}", "nu, thickness, damping"
    ),
    "denim": KnownMaterial(
        2.5e6, 0.3, 405.0, 0.0008, 0.02,
        f"mass and stretch (2 kN/m) of a denim of 11 oz: {_WANG}; thickness: one of Journal of Textiles 2016, 4614168",
        "nu, damping",
    ),
    "canvas": KnownMaterial(
        1.8e7, 0.3, 565.0, 0.0006, 0.02, f"duck of 10 oz/yd², which is 339 g/m²; {_WOVEN}", "nu, thickness, damping"
    ),
    "fabric": KnownMaterial(
        8e6, 0.3, 400.0, 0.0005, 0.02, "", "all; a woven fabric of unknown kind, between cotton and canvas"
    ),
    "clothes": KnownMaterial(3e6, 0.3, 350.0, 0.0007, 0.05, "", "all; of a person, between a T-shirt and denim"),
    "leather": KnownMaterial(1e8, 0.4, 930.0, 0.0012, 0.05, "", "all; for ranges see Ashby 2011"),
    "rubber": KnownMaterial(2e6, 0.45, 925.0, 0.002, 0.05, "", "all; for ranges see Ashby 2011; nu is nearer to 0.5"),
    "paper": KnownMaterial(
        3.4e9, 0.3, 1067.0, 0.000075, 0.01,
        "bending stiffness, density and thickness of flags in a wind tunnel: data of juandadamo/2024_flags",
        "nu, damping",
    ),
    "cardboard": KnownMaterial(
        2.5e9, 0.3, 140.0, 0.0035, 0.02, "", "all; corrugated board, E for a bending stiffness of 10 N m"
    ),
    "grass": KnownMaterial(
        4.9e8, 0.3, 700.0, 0.00025, 0.05,
        "fibres, 2 % of a blade and more (Vincent 1991), carry 90 to 95 % of its stiffness (Vincent 1982)",
        "all; E for fibres of 23 GPa",
    ),
    "leaf": KnownMaterial(5e7, 0.3, 800.0, 0.00025, 0.05, "", "all; for measurements see Onoda et al. 2015"),
    "succulent": KnownMaterial(
        5e6, 0.45, 950.0, 0.005, 0.03, "mass above 0.9 kg/m²: Lamont 2025", "E, nu, density, thickness, damping"
    ),
    "stem": KnownMaterial(5e8, 0.35, 950.0, 0.005, 0.07, "", "all; a green stem along its fibres, see Niklas 1992"),
    "twig": KnownMaterial(
        2e9, 0.35, 900.0, 0.002, 0.05,
        "E within that of branches, 0.7 to 4.6 GPa: Cannell & Morgan 1987; damping of a tree in winter: data of "
        "TobyDJackson/WindAndTrees_NaturalFrequencies",
        "nu, density, thickness",
    ),
    "bark": KnownMaterial(3e8, 0.3, 500.0, 0.01, 0.05, "", "all"),
    "wood": KnownMaterial(1e10, 0.35, 500.0, 0.01, 0.005, "", "all; dry softwood along the grain, see Ross 2010"),
    "metal": KnownMaterial(2e11, 0.3, 7850.0, 0.001, 0.002, "", "all; a sheet of steel, for others see Ashby 2011"),
    "stone": KnownMaterial(5e10, 0.25, 2650.0, 0.02, 0.002, "", "all; granite, for others see Ashby 2011"),
}  # fmt: skip
"""The known materials by name."""


def known_material(name: str, field: str = "material") -> KnownMaterial:
    """The material of a name."""
    check_choice(field, name, tuple(MATERIALS))
    return MATERIALS[name]


def name_of(E: float, nu: float, density: float) -> str | None:
    """The name of the material with these numbers; None if there is none."""
    found = (name for name, known in MATERIALS.items() if (known.E, known.nu, known.density) == (E, nu, density))
    return next(found, None)
