"""Conversion between scene units and metres with z up. No other file converts between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._arguments import checked
from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.rotations import rotation_from_z


@fixed
@dataclass(frozen=True, slots=True)
class SimFrame:
    """Similarity between scene coordinates and the simulation's: metres, z up, origin at the object's centre.

    Attributes:
        origin: Scene point that becomes the origin, shape (3,), float64.
        rotation: Scene axes to simulation axes, shape (3, 3), float64.
        metres_per_unit: Length of a scene unit [m].
    """

    origin: Tensor
    rotation: Tensor
    metres_per_unit: float
    _known: dict[tuple[torch.dtype, torch.device], tuple[Tensor, ...]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _turns: list[bool] = field(default_factory=list, init=False, repr=False, compare=False)

    def _on(self, device: torch.device, dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
        """Origin, rotation R, R ⊗ R and I on a device; cached, so that later calls copy nothing to a GPU."""
        key = (dtype, device)
        if key not in self._known:
            with torch.inference_mode(False):
                values = (self.origin, self.rotation, torch.kron(self.rotation, self.rotation), torch.eye(3))
                self._known[key] = tuple(value.to(device, dtype) for value in values)
        return self._known[key]

    @property
    def turns(self) -> bool:
        """True if scene axes and simulation axes differ, that is, unless z is up in the scene."""
        if not self._turns:
            self._turns.append(not torch.equal(self.rotation, torch.eye(3).to(self.rotation)))
        return self._turns[0]

    @classmethod
    @checked
    def fit(
        cls,
        points: Tensor,
        up: Sequence[float] = (0.0, 0.0, 1.0),
        longest_side: float | None = None,
        metres_per_unit: float | None = None,
    ) -> SimFrame:
        """The frame for an object.

        Args:
            points: Points of the object in scene units, shape (N, 3).
            longest_side: Longest side of the object's box, along the simulation axes [m]; PhysGaussian's normalisation
                is 1. Excludes ``metres_per_unit``.
            metres_per_unit: Length of a scene unit [m]; 1 if neither is given.

        Returns:
            The frame, its origin at the centre of the box.

        Raises:
            ValueError: If both sizes or an impossible one are given, or if the object has no extent.
        """
        check_shape("points", points, "N", 3)
        if longest_side is not None and metres_per_unit is not None:
            raise ValueError("Give either `longest_side` or `metres_per_unit`, not both.")
        rotation = rotation_from_z(up).T
        turned = points.detach().cpu().double() @ rotation.T
        low, high = turned.amin(0), turned.amax(0)
        scale = 1.0
        if metres_per_unit is not None:
            check_positive("metres_per_unit", metres_per_unit)
            scale = float(metres_per_unit)
        elif longest_side is not None:
            check_positive("longest_side", longest_side)
            extent = float((high - low).amax())
            if extent <= 0:
                raise ValueError("The object has no extent for `longest_side` to scale: set `metres_per_unit` instead.")
            scale = float(longest_side) / extent
        return cls((0.5 * (low + high)) @ rotation, rotation, scale)

    @classmethod
    def from_summary(cls, summary: Mapping[str, Any]) -> SimFrame:
        """The frame of a run, from its ``summary.json``.

        Raises:
            ValueError: If the summary does not contain it.
        """
        try:
            found = summary["sim_frame"]
            origin, rotation = (torch.tensor(found[name], dtype=torch.float64) for name in ("origin", "rotation"))
            metres = float(found["metres_per_unit"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError("it has no `sim_frame`: run the simulation again") from error
        if origin.shape != (3,) or rotation.shape != (3, 3) or not metres > 0:
            raise ValueError("its `sim_frame` is damaged: run the simulation again")
        return cls(origin, rotation, metres)

    def point_to_sim(self, points: Tensor) -> Tensor:
        """Scene points (..., 3) to metres, z up. Computed in float64, so distant scenes keep their detail."""
        place = in_double(points)
        origin, rotation, *_ = self._on(place.device)
        return ((place - origin) * self.metres_per_unit @ rotation.T).to(points)

    def point_to_scene(self, points: Tensor) -> Tensor:
        """Points in metres, z up (..., 3) to scene coordinates."""
        place = in_double(points)
        origin, rotation, *_ = self._on(place.device)
        return ((place / self.metres_per_unit) @ rotation + origin).to(points)

    def displacement_to_scene(self, displacement: Tensor) -> Tensor:
        """Displacements in metres, z up (..., 3) to scene units and axes."""
        turned = self.direction_to_scene(displacement)
        return turned if self.metres_per_unit == 1 else turned / self.metres_per_unit

    def direction_to_sim(self, directions: Tensor) -> Tensor:
        """Turn directions (..., 3) from scene axes to the z-up frame, without scaling."""
        return directions @ self._on(directions.device, directions.dtype)[1].T if self.turns else directions

    def direction_to_scene(self, directions: Tensor) -> Tensor:
        """Turn directions (..., 3) from the z-up frame to scene axes, without scaling."""
        return directions @ self._on(directions.device, directions.dtype)[1] if self.turns else directions

    def area_to_sim(self, area: Tensor) -> Tensor:
        """Areas in square scene units to m²."""
        return area * self.metres_per_unit**2

    def covariance_to_sim(self, covariance: Tensor) -> Tensor:
        """Covariances (..., 3, 3) in square scene units to m², z up."""
        rotation = self._on(covariance.device, covariance.dtype)[1]
        return rotation @ covariance @ rotation.T * self.metres_per_unit**2

    def gradient_to_scene(self, F: Tensor) -> Tensor:
        """Deformation gradients (..., 3, 3) from the z-up frame to scene axes: Rᵀ F R, exactly I where F is."""
        if not self.turns:
            return F
        *_, both, eye = self._on(F.device, F.dtype)
        return eye + ((F - eye).flatten(-2) @ both).unflatten(-1, (3, 3))  # one product, not two of small matrices

    def describe(self) -> str:
        origin = [round(v, 4) for v in self.origin.tolist()]
        up = [round(v, 3) for v in self.rotation[2].tolist()]
        return f"1 scene unit = {self.metres_per_unit:.6g} m; origin {origin}; up {up} (scene units)"
