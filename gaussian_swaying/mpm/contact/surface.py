"""Contact samples (``place`` in the code) on the surface of a body, and the settings of its contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying._fixed import fixed
from gaussian_swaying.mpm.state import MaterialPoints


@fixed
@dataclass(frozen=True)
class Contact:
    """Contact of the material with itself: between the layers of a sheet, and between objects.

    It cannot be changed, as the surface keeps the thickness that it was made with: make another simulation.

    Args:
        thickness: Distance that two surfaces keep [m]; null for the thickness of the material at each place. Obstacles
            are kept at half of it.
        friction: Coulomb coefficient.
        iterations: Most iterations for the impulses of a substep. Two or three are made where sheets touch, more at
            an impact and in a pile; 16 are enough for eight layers.

    Raises:
        ValueError: If a number is out of range.
    """

    thickness: float | None = None
    friction: float = 0.3
    _: KW_ONLY
    iterations: int = 100

    def __post_init__(self) -> None:
        if self.thickness is not None:
            check_positive("contact.thickness", self.thickness)
        check_positive("contact.friction", self.friction, allow_zero=True)
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, int) or self.iterations < 1:
            raise ValueError(
                f"Expected `contact.iterations` to be a whole number of at least 1, but got {self.iterations}."
            )


@dataclass(frozen=True, slots=True)
class Surface:
    """Contact samples of the surface, which touch obstacles and each other: discs around them cover it.

    Attributes:
        place: Rest positions [m], shape (C, 3).
        normal: Unit normals at rest, of either sign, shape (C, 3).
        radius: Radii of the discs [m], shape (C,).
        thickness: Distance that two surfaces keep [m], shape (C,).
        read: Rest position at which the motion of each is interpolated [m], shape (C, 3): the sample itself, or one
            close to it if some of its nodes have no mass.
        contact: Contact of the surface with itself; None if only obstacles count.
        near: The material point that each belongs to, shape (C,); the nearest one if None.
    """

    place: Tensor
    normal: Tensor
    radius: Tensor
    thickness: Tensor
    read: Tensor
    contact: Contact | None = None
    near: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("place", self.place, "C", 3)
        for name in ("normal", "read"):
            check_shape(name, getattr(self, name), len(self.place), 3)
        for name in ("radius", "thickness"):
            check_shape(name, getattr(self, name), len(self.place))

    @classmethod
    def of_points(
        cls,
        points: MaterialPoints,
        normal: Tensor | None = None,
        spacing: float = 0.0,
        thickness: float = 0.0,
        contact: Contact | None = None,
    ) -> Surface:
        """The material points as a surface.

        Args:
            points: The material.
            normal: Normals of the sheet at its points, shape (P, 3); needed for contact with itself.
            spacing: Distance of neighbouring points [m]; discs reach 0.75 of it.
            thickness: Distance that two surfaces keep [m], unless ``contact`` has one.
            contact: Contact of the surface with itself.
        """
        place = points.position.detach().reshape(-1, 3)
        if contact is not None and (normal is None or spacing <= 0 or points.position.dim() > 2):
            raise ValueError(
                "Contact of a surface with itself needs one scene, and `normal` and `spacing` of its points."
            )
        h = thickness if contact is None or contact.thickness is None else contact.thickness
        full = place.new_full((len(place),), 1.0)
        facing = torch.zeros_like(place) if normal is None else normal.to(place)
        own = torch.arange(points.count, device=place.device).repeat(len(place) // points.count)
        return cls(place, facing, 0.75 * spacing * full, h * full, place, contact, own)

    def map(self, function: Callable[[Tensor], Tensor]) -> Surface:
        place, normal, read = (function(field) for field in (self.place, self.normal, self.read))
        near = None if self.near is None else self.near.to(place.device)
        return Surface(place, normal, function(self.radius), function(self.thickness), read, self.contact, near)
