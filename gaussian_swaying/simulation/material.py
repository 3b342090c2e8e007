"""Material of an object: elastic constants, density, thickness, law, and regions that differ."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal

from torch import Tensor

from gaussian_swaying._checks import (
    Number,
    check_plain,
    check_poisson_ratio,
    check_positive,
    number_of,
    requires_grad,
)
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.state import MaterialPoints


@fixed
@dataclass
class MaterialRegion:
    """Different material in a part of the object.

    Args:
        region: Where, in scene units.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density [kg/m³]; unchanged if null.
        thickness: Thickness of the surface [m]; unchanged if null.
        bending: Bending stiffness [N m]; unchanged if null.
        damping_ratio: Damping ratio at 1 Hz; unchanged if null.
        law: Constitutive law; unchanged if null.
    """

    region: Region
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    thickness: float | None = None
    bending: float | Literal["plate"] | None = None
    damping_ratio: float | None = None
    law: ConstitutiveLaw | None = None


@fixed
@dataclass
class Material:
    """The material of the object.

    Args:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, below 0.5.
        density: Density [kg/m³].
        thickness: Thickness of the surface [m]; a patch has volume = area x thickness.
        volume: ``patch`` (area x thickness, and the volume of the solid where ``scene.filling`` finds one) or ``cell``
            (PhysGaussian's rule for solids: cell volume / particles in it; with ``scene.layers`` 3 the layers share it,
            and ``thickness`` only says how far apart they lie).
        bending: Bending stiffness of a sheet, to a unit of its width [N m]: D of a fabric, whatever its stiffness
            against stretch, or ``plate`` for E thickness³ / (12 (1 - nu²)). With null a sheet of one layer is a
            membrane, which folds without resistance, and one of three layers (``scene.layers`` 3) is a plate. One
            layer needs a third of the points, and may be thicker than a cell. An edit of E changes it in proportion.
        damping_ratio: Share of critical damping of a vibration of 1 Hz, in ``solver.formulation: total``; parts and
            regions may have their own. The velocity decays at a rate of 4 pi Hz times the ratio, so a vibration of
            twice the frequency has half of the ratio. None if null, beside ``solver.damping``.
        law: Constitutive law, for example ``Sand`` (see :data:`gaussian_swaying.mpm.laws.LAWS`); fixed corotated
            elasticity if null. Plastic laws need ``solver.formulation: updated``.
        regions: Parts with a different material; later entries win.

    In Python, ``E``, ``nu`` and ``density`` may be tensors of one number that require a gradient.
    """

    live_as = "material"

    E: Number = 1e5
    nu: Number = 0.3
    _: KW_ONLY
    density: Number = 200.0
    thickness: float = 0.01
    volume: Literal["patch", "cell"] = "patch"
    bending: float | Literal["plate"] | None = None
    damping_ratio: float | None = None
    law: ConstitutiveLaw | None = None
    regions: list[MaterialRegion] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in DIFFERENTIABLE:
            value = getattr(self, name)
            if requires_grad(value) and any(getattr(entry, name) is not None for entry in self.regions):
                raise ValueError(
                    f"`material.{name}` requires a gradient, but `material.regions` gives it too: remove it there."
                )
        entries: list[Material | MaterialRegion] = [self, *self.regions]
        for entry in entries:
            given = {name: getattr(entry, name) for name in ("E", "nu", "density", "thickness", "bending")}
            if entry is self:
                given |= {name: number_of(given[name]) for name in DIFFERENTIABLE}
            for name in ("E", "density", "thickness", "bending"):
                if given[name] is not None and given[name] != PLATE:
                    check_positive(f"material.{name}", given[name])
            if entry.damping_ratio is not None:
                check_positive("material.damping_ratio", entry.damping_ratio, allow_zero=True)
            if given["nu"] is not None:
                check_plain("material.nu", given["nu"])
                check_poisson_ratio("material.nu", given["nu"])
        if any(entry.bending is not None for entry in entries):
            self._check_bending()

    def _check_bending(self) -> None:
        if self.volume == "cell":
            raise ValueError(
                "Expected `material.volume` to be patch with `material.bending`, but got cell: the stiffness against "
                "stretch, on which the layers' distance depends, is then not E x thickness."
            )
        for name in ("E", "nu"):
            if requires_grad(getattr(self, name)):
                raise ValueError(
                    f"`material.{name}` requires a gradient, which `material.bending` does not pass on: leave it out."
                )

    @classmethod
    def named(cls, name: str, **own: Any) -> Material:
        """The material of a name, with some fields of its own.

        Args:
            name: One of :data:`~gaussian_swaying.mpm.materials.MATERIALS`.
            own: Fields that differ.

        Raises:
            ValueError: If there is no material of that name; the message lists the names.

        Example:
            >>> Material.named("cotton", thickness=0.001).density
            430.0
        """
        return cls(**(known_material(name).numbers | own))


def plate_stiffness(E: Tensor, nu: Tensor, thickness: Tensor) -> Tensor:
    r"""Kirchhoff's stiffness :math:`D = E h^3 / (12 (1 - \nu^2))` of a plate [N m], shape (N,).

    Args:
        E: Young's moduli [Pa], shape (N,).
        nu: Poisson's ratios, shape (N,).
        thickness: Thicknesses h [m], shape (N,).
    """
    return E * thickness**3 / (12 * (1 - nu.square()))


def layer_distance(bending: Tensor, E: Tensor, nu: Tensor, thickness: Tensor) -> Tensor:
    r"""Distance of the outer two of three layers with Simpson's weights that have a bending stiffness.

    Their second moment of area is :math:`h d^2 / 12`, so that Kirchhoff's plate has
    :math:`D = E h d^2 / (12 (1 - \nu^2))`, and d is h for a plate of one material.

    Args:
        bending: D [N m], shape (N,).
        E: Young's moduli [Pa], shape (N,).
        nu: Poisson's ratios, shape (N,).
        thickness: Thicknesses h [m], shape (N,).

    Returns:
        Distances d [m], shape (N,).
    """
    return (12 * bending * (1 - nu.square()) / (E * thickness)).sqrt()


PLATE = "plate"
"""The bending stiffness of a plate of the material's own E, nu and thickness."""

DIFFERENTIABLE = ("E", "nu", "density")
"""Numbers of a :class:`Material` that may require a gradient."""


def with_gradients(points: MaterialPoints, material: Material) -> MaterialPoints:
    """Material points that depend on the tensors of their material that require a gradient, with the same values."""
    for name, field_name in (("E", "youngs_modulus"), ("nu", "poisson_ratio"), ("density", "mass")):
        value = getattr(material, name)
        if requires_grad(value):
            change = (value - value.detach()).reshape(()).to(points.mass)  # zero, with a slope of one
            change = change * points.volume if name == "density" else change
            points = replace(points, **{field_name: getattr(points, field_name) + change})
    return points
