"""What the solver is given (material points, grid) and what it moves (state)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_finite, check_shape


@dataclass(frozen=True, slots=True)
class GridSpec:
    """A box of grid nodes on the world lattice: node (i, j, k) lies at ``(offset + (i, j, k)) * dx``.

    Because every box lies on one lattice, a grid that follows the object does not change the physics.

    Attributes:
        dx: Grid spacing [m].
        offset: Lattice coordinates of the first node.
        resolution: Number of nodes along x, y and z.
    """

    dx: float
    offset: tuple[int, int, int]
    resolution: tuple[int, int, int]

    @property
    def node_count(self) -> int:
        """Number of nodes G of one scene."""
        return self.resolution[0] * self.resolution[1] * self.resolution[2]

    def node_positions(self, like: Tensor) -> Tensor:
        """Positions of the nodes [m], shape (G, 3), with the type and device of ``like``."""
        axes = [
            (torch.arange(n, device=like.device) + o).to(like.dtype) * self.dx
            for n, o in zip(self.resolution, self.offset, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def bounding_grid(low: Tensor, high: Tensor, dx: float, margin: int) -> GridSpec:
    """The smallest box of the lattice that holds the stencils of all points between two corners.

    Args:
        low: Smallest coordinates of the points [m], shape (3,).
        high: Largest coordinates of the points [m], shape (3,).
        dx: Grid spacing [m].
        margin: Further cells on each side.

    Returns:
        The grid.
    """
    first = torch.floor(low.double().cpu() / dx - 0.5).long() - margin
    last = torch.floor(high.double().cpu() / dx - 0.5).long() + 2 + margin
    offset, resolution = first.tolist(), (last - first + 1).tolist()
    return GridSpec(dx, (offset[0], offset[1], offset[2]), (resolution[0], resolution[1], resolution[2]))


@dataclass(frozen=True, slots=True)
class MaterialPoints:
    """The material at rest: what the solver moves, and never changes itself.

    Leading batch dimensions stand for independent scenes. Use :meth:`create` to build one from scalars.

    Attributes:
        position: Rest position [m], shape (..., P, 3).
        mass: Mass [kg], shape (..., P).
        volume: Rest volume [m³], shape (..., P).
        youngs_modulus: Young's modulus E [Pa], shape (..., P).
        poisson_ratio: Poisson's ratio nu, shape (..., P).
    """

    position: Tensor
    mass: Tensor
    volume: Tensor
    youngs_modulus: Tensor
    poisson_ratio: Tensor

    def __post_init__(self) -> None:
        check_shape("position", self.position, "P", 3)
        batch = tuple(self.position.shape[:-1])
        for name in ("mass", "volume", "youngs_modulus", "poisson_ratio"):
            value = getattr(self, name)
            if tuple(value.shape) != batch:
                raise ValueError(f"Expected `{name}` of shape {batch}, but got {tuple(value.shape)}.")
            check_finite(name, value)
        check_finite("position", self.position)

    @classmethod
    def create(
        cls,
        position: Tensor,
        *,
        volume: Tensor | float,
        density: Tensor | float,
        youngs_modulus: Tensor | float,
        poisson_ratio: Tensor | float,
    ) -> MaterialPoints:
        """Build the points from per-point tensors or numbers that hold for all of them.

        Args:
            position: Rest position [m], shape (..., P, 3).
            volume: Rest volume of a point [m³].
            density: Density at rest [kg/m³].
            youngs_modulus: Young's modulus [Pa].
            poisson_ratio: Poisson's ratio, in (-1, 0.5).

        Returns:
            The points, every field expanded to shape (..., P).

        Raises:
            ValueError: If a value lies outside its physical range.
        """
        check_shape("position", position, "P", 3)

        def field(name: str, value: Tensor | float, low: float, high: float, remedy: str) -> Tensor:
            tensor = torch.as_tensor(value, dtype=position.dtype, device=position.device)
            if not bool(((tensor > low) & (tensor < high)).all()):
                worst = tensor.detach().reshape(-1)
                worst = worst[~((worst > low) & (worst < high))][0]
                raise ValueError(f"Expected `{name}` {remedy}, but got {float(worst):g}.")
            return tensor.expand(position.shape[:-1])

        inf = float("inf")
        v = field("volume", volume, 0.0, inf, "to be positive and finite [m³]")
        rho = field("density", density, 0.0, inf, "to be positive and finite [kg/m³]")
        e = field("E", youngs_modulus, 0.0, inf, "(Young's modulus) to be positive and finite [Pa]")
        nu = field("nu", poisson_ratio, -1.0, 0.5, "(Poisson's ratio) to lie between -1 and 0.5, both excluded")
        return cls(position, rho * v, v, e, nu)

    @property
    def count(self) -> int:
        """Number of points P of one scene."""
        return self.position.shape[-2]

    def map(self, function: Callable[[Tensor], Tensor]) -> MaterialPoints:
        """Apply a function to every tensor (``.to``, ``.detach``)."""
        return MaterialPoints(*(function(getattr(self, f.name)) for f in dataclasses.fields(self)))


@dataclass(frozen=True, slots=True)
class MPMState:
    """Everything that varies. ``step`` takes one and returns a new one; nothing is changed in place.

    In the ``total`` formulation the nodal fields are the state and the particle fields are read from them; in the
    ``updated`` formulation the nodal fields are None.

    Attributes:
        position: Particle position [m], shape (..., P, 3).
        velocity: Particle velocity [m/s], shape (..., P, 3).
        affine: APIC affine velocity [1/s], shape (..., P, 3, 3); zero in ``total``.
        F_elastic: Elastic deformation gradient, drives the stress, shape (..., P, 3, 3).
        F_total: Total deformation gradient, drives covariances and normals, shape (..., P, 3, 3).
        lost: Particles that left the grid since the run began, shape (..., P), bool.
        time: Simulated time [s], scalar float64 tensor.
        grid: The nodes in use.
        node_displacement: Nodal displacement [m], shape (..., G, 3), or None.
        node_velocity: Nodal velocity [m/s], shape (..., G, 3), or None.
    """

    position: Tensor
    velocity: Tensor
    affine: Tensor
    F_elastic: Tensor
    F_total: Tensor
    lost: Tensor
    time: Tensor
    grid: GridSpec
    node_displacement: Tensor | None = None
    node_velocity: Tensor | None = None

    def replace(self, **changes: Any) -> MPMState:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def state_dict(self) -> dict[str, Any]:
        """The state as plain tensors and numbers, for ``torch.save``."""
        result = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        result["grid"] = dataclasses.asdict(self.grid)
        if self.F_total is self.F_elastic:
            result["F_total"] = None
        return result

    @classmethod
    def from_state_dict(cls, values: dict[str, Any], device: torch.device | str = "cpu") -> MPMState:
        """Rebuild a state saved by :meth:`state_dict`."""
        moved: dict[str, Any] = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in values.items()}
        grid = moved["grid"]
        moved["grid"] = GridSpec(float(grid["dx"]), tuple(grid["offset"]), tuple(grid["resolution"]))
        if moved["F_total"] is None:
            moved["F_total"] = moved["F_elastic"]
        return cls(**moved)
