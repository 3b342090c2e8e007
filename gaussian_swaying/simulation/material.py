"""What an object is made of."""

from __future__ import annotations

from dataclasses import dataclass, field

from gaussian_swaying._checks import check_choice, check_poisson_ratio, check_positive
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw


@dataclass
class MaterialRegion:
    """Different material in a part of the object.

    Args:
        region: Where, in scene units.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density [kg/m³]; unchanged if null.
        thickness: Thickness of the surface [m]; unchanged if null.
        law: Constitutive law; unchanged if null.
    """

    region: Region
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    thickness: float | None = None
    law: ConstitutiveLaw | None = None


@dataclass
class Material:
    """What the object is made of.

    Args:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, below 0.5.
        density: Density [kg/m³].
        thickness: Thickness of the surface [m]; a patch has volume = area x thickness.
        volume: ``patch`` (area x thickness, and the volume of the solid where ``scene.filling`` finds one) or ``cell``
            (PhysGaussian's rule for solids: cell volume / particles in it; with ``scene.layers`` 3 the layers share it,
            and ``thickness`` only says how far apart they lie).
        law: Constitutive law, for example ``Sand`` (see :data:`gaussian_swaying.mpm.laws.LAWS`); fixed corotated
            elasticity if null. Plastic laws need ``solver.formulation: updated``.
        regions: Parts with a different material; later entries win.
    """

    E: float = 1e5
    nu: float = 0.3
    density: float = 200.0
    thickness: float = 0.01
    volume: str = "patch"
    law: ConstitutiveLaw | None = None
    regions: list[MaterialRegion] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_choice("material.volume", self.volume, ("patch", "cell"))
        entries: list[Material | MaterialRegion] = [self, *self.regions]
        for entry in entries:
            for name in ("E", "density", "thickness"):
                if getattr(entry, name) is not None:
                    check_positive(f"material.{name}", getattr(entry, name))
            if entry.nu is not None:
                check_poisson_ratio("material.nu", entry.nu)
