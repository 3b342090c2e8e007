"""The inputs of the solver (material points, grid) and the state that it advances."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gaussian_swaying._arguments import checked
from gaussian_swaying._checks import check_finite, check_shape
from gaussian_swaying._fixed import fixed
from gaussian_swaying.mpm.laws.elastic import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True, slots=True)
class GridSpec:
    """A box of grid nodes on the world lattice: node (i, j, k) lies at ``(offset + (i, j, k)) * dx``.

    All boxes lie on the same lattice, so a grid that follows the object does not change the physics.

    Attributes:
        dx: Grid spacing [m].
        offset: Lattice coordinates of the first node.
        resolution: Number of nodes along x, y and z.
        virtual: Number of virtual nodes, which come after those (``virtual_nodes``).
    """

    dx: float
    offset: tuple[int, int, int]
    resolution: tuple[int, int, int]
    virtual: int = 0

    @property
    def lattice_count(self) -> int:
        return self.resolution[0] * self.resolution[1] * self.resolution[2]

    @property
    def node_count(self) -> int:
        return self.lattice_count + self.virtual

    def holds(self, other: GridSpec) -> bool:
        inside = (
            a <= b and b + m <= a + n
            for a, n, b, m in zip(self.offset, self.resolution, other.offset, other.resolution, strict=True)
        )
        return self.dx == other.dx and all(inside)

    def with_room(self, before: GridSpec) -> GridSpec:
        """A larger grid that contains this one and can be used for longer.

        It has four more cells on each side, or an eighth of the length (if that is more) on sides where ``before`` was
        too small. An object that keeps growing or moving in that direction then needs new grids less and less often.
        """
        offset, resolution = [], []
        for a, n, b, m in zip(self.offset, self.resolution, before.offset, before.resolution, strict=True):
            low, high = (max(4, n // 8) if outgrown else 4 for outgrown in (a < b, a + n > b + m))
            offset.append(a - low)
            resolution.append(n + low + high)
        return GridSpec(self.dx, (offset[0], offset[1], offset[2]), (resolution[0], resolution[1], resolution[2]))

    def node_positions(self, like: Tensor) -> Tensor:
        """Positions of the nodes but virtual ones [m], shape (G, 3), with the type and device of ``like``."""
        axes = [
            (torch.arange(n, device=like.device) + o).to(like.dtype) * self.dx
            for n, o in zip(self.resolution, self.offset, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def bounding_grid(low: Tensor, high: Tensor, dx: float, margin: int) -> GridSpec:
    """The smallest box of the lattice that contains the stencils of all points between two corners.

    It rounds as :func:`~gaussian_swaying.mpm.transfer.bspline_stencil` does, in the precision of the points: where a
    corner lies on a border between two stencils, another rounding would leave the points there outside of the grid.

    Args:
        low: Smallest coordinates of the points [m], shape (3,).
        high: Largest coordinates of the points [m], shape (3,).
    """
    # Python integers, which do not overflow
    first = [math.floor(x) - margin for x in (low / dx - 0.5).tolist()]
    last = [math.floor(x) + 2 + margin for x in (high / dx - 0.5).tolist()]
    size = [b - a + 1 for a, b in zip(first, last, strict=True)]
    return GridSpec(dx, (first[0], first[1], first[2]), (size[0], size[1], size[2]))


_DEFAULT: tuple[ConstitutiveLaw, ...] = (FixedCorotated(),)
_FIELDS = ("mass", "volume", "youngs_modulus", "poisson_ratio")
_OPTIONAL = ("damping", "bending")
_OPTIONAL_FIELDS = (*_OPTIONAL, "normal")


@fixed
@dataclass(frozen=True, slots=True)
class MaterialPoints:
    """The material at rest, which the solver moves but never changes.

    Leading batch dimensions are independent scenes. Use :meth:`create` to build one from scalars.

    Attributes:
        position: Rest position [m], shape (..., P, 3).
        mass: Mass [kg], shape (..., P).
        volume: Rest volume [m³], shape (..., P).
        youngs_modulus: Young's modulus E [Pa], shape (..., P).
        poisson_ratio: Poisson's ratio nu, shape (..., P).
        laws: The constitutive laws of the run.
        law_index: Which of ``laws`` applies to each particle, int64, shape (..., P); None if there is only one.
        attached: Which points are attached to each other at rest, in all scenes: a number for each, int64, shape (P,),
            the same for those of a piece, or pairs that are attached, shape (E, 2). Others never share nodes in
            ``total``, however close they lie (``virtual_nodes``). None if all are.
        damping: Rate at which the velocity of the material decays [1/s], shape (..., P), only in ``total``; None for
            no damping.
        normal: Unit normals of sheets of one layer that resist bending (``bending_of``), of either sign, shape
            (..., P, 3), only in ``total``; None if there are none.
        bending: Bending stiffness times area [N m³], shape (..., P), zero for points that are not of such a sheet.
    """

    position: Tensor
    mass: Tensor
    volume: Tensor
    youngs_modulus: Tensor
    poisson_ratio: Tensor
    laws: tuple[ConstitutiveLaw, ...] = _DEFAULT
    law_index: Tensor | None = None
    attached: Tensor | None = None
    damping: Tensor | None = None
    normal: Tensor | None = None
    bending: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("position", self.position, "P", 3)
        if self.attached is not None:
            _check_attached(self.attached, self.count)
        batch = tuple(self.position.shape[:-1])
        for name in (*_FIELDS, *(name for name in ("law_index", *_OPTIONAL) if getattr(self, name) is not None)):
            value = getattr(self, name)
            if tuple(value.shape) != batch:
                raise ValueError(f"Expected `{name}` of shape {batch}, but got {tuple(value.shape)}.")
            check_finite(name, value)
        check_finite("position", self.position)
        if (self.normal is None) != (self.bending is None):
            given, missing = ("bending", "normal") if self.normal is None else ("normal", "bending")
            raise ValueError(f"`{given}` needs `{missing}`, too: give both, or none for a sheet that does not bend.")
        if self.normal is not None and tuple(self.normal.shape) != (*batch, 3):
            raise ValueError(f"Expected `normal` of shape {(*batch, 3)}, but got {tuple(self.normal.shape)}.")
        if (self.law_index is None) != (len(self.laws) == 1):
            raise ValueError(
                f"Expected `law_index` to say which of the {len(self.laws)} `laws` applies to each particle."
                if self.law_index is None
                else f"Expected several `laws` with `law_index`, but got {len(self.laws)}."
            )

    @classmethod
    @checked
    def create(
        cls,
        position: Tensor,
        *,
        volume: Tensor | float,
        density: Tensor | float,
        youngs_modulus: Tensor | float,
        poisson_ratio: Tensor | float,
        law: ConstitutiveLaw | Sequence[ConstitutiveLaw] | None = None,
        law_index: Tensor | None = None,
        attached: Tensor | None = None,
        damping: Tensor | float | None = None,
        normal: Tensor | None = None,
        bending: Tensor | float | None = None,
    ) -> MaterialPoints:
        """Build the points from per-point tensors or from numbers that apply to all points.

        Args:
            position: Rest position [m], shape (..., P, 3).
            volume: Rest volume of a point [m³].
            density: Density at rest [kg/m³].
            youngs_modulus: Young's modulus [Pa].
            poisson_ratio: Poisson's ratio, in (-1, 0.5).
            law: Constitutive law, or several; fixed corotated elasticity if None.
            law_index: With several laws, which of them applies to each particle, int64, shape (..., P).
            attached: Which points are attached to each other, see :class:`MaterialPoints`.
            damping: Rate at which the velocity decays [1/s], not negative.
            normal: Unit normals of a sheet of one layer that resists bending, shape (..., P, 3).
            bending: Its bending stiffness times the area of a point [N m³], not negative.

        Returns:
            The points, every field expanded to shape (..., P).

        Raises:
            ValueError: If a value lies outside its physical range.

        Example:
            >>> from gaussian_swaying.mpm.laws.plastic import Sand
            >>> sand = MaterialPoints.create(torch.rand(10, 3), volume=1e-6, density=1600.0, youngs_modulus=1e6,
            ...                              poisson_ratio=0.3, law=Sand(friction_angle=30.0))
        """
        check_shape("position", position, "P", 3)

        def field(name: str, value: Tensor | float, low: float, high: float, remedy: str) -> Tensor:
            tensor = torch.as_tensor(value, dtype=position.dtype, device=position.device)
            if not bool(((tensor > low) & (tensor < high)).all()):
                worst = tensor.detach().reshape(-1)
                worst = worst[~((worst > low) & (worst < high))][0]
                raise ValueError(f"Expected `{name}` {remedy}, but got {float(worst):g}.")
            return expanded(name, tensor)

        def expanded(name: str, tensor: Tensor) -> Tensor:
            shape = position.shape[:-1]
            if tensor.dim() > len(shape) or any(
                a not in (1, b) for a, b in zip(tensor.shape[::-1], shape[::-1], strict=False)
            ):
                raise ValueError(
                    f"Expected `{name}` to be a number, or of shape {tuple(shape)}, but got {tuple(tensor.shape)}."
                )
            return tensor.expand(shape)

        inf = float("inf")
        v = field("volume", volume, 0.0, inf, "to be positive and finite [m³]")
        rho = field("density", density, 0.0, inf, "to be positive and finite [kg/m³]")
        e = field("E", youngs_modulus, 0.0, inf, "(Young's modulus) to be positive and finite [Pa]")
        nu = field("nu", poisson_ratio, -1.0, 0.5, "(Poisson's ratio) to lie between -1 and 0.5, both excluded")
        laws = _DEFAULT if law is None else (law,) if isinstance(law, ConstitutiveLaw) else tuple(law)
        if law_index is not None:
            law_index = expanded("law_index", law_index.to(position.device, torch.long))
            if not bool(((law_index >= 0) & (law_index < len(laws))).all()):
                raise ValueError(f"Expected `law_index` to lie in 0 to {len(laws) - 1}, the last index of `laws`.")
        if damping is not None:
            damping = field("damping", damping, -1e-30, inf, "not to be negative, and finite [1/s]")
        if bending is not None:
            bending = field("bending", bending, -1e-30, inf, "not to be negative, and finite [N m³]")
        return cls(position, rho * v, v, e, nu, laws, law_index, attached, damping, normal, bending)

    @classmethod
    def join(cls, parts: Sequence[MaterialPoints]) -> MaterialPoints:
        """Join several bodies into one: their points one after the other, each with its own law.

        They share nodes where they are close, if all points are attached in each of them; otherwise none are attached
        to those of another body.
        """
        laws: list[ConstitutiveLaw] = []
        index = []
        for part in parts:
            laws += [law for law in part.laws if not any(law is known for known in laws)]
            place = [next(k for k, known in enumerate(laws) if known is law) for law in part.laws]
            own = torch.zeros_like(part.mass, dtype=torch.long) if part.law_index is None else part.law_index
            index.append(torch.tensor(place, device=own.device)[own])
        fields = {name: torch.cat([getattr(part, name) for part in parts], -1) for name in _FIELDS}
        position = torch.cat([part.position for part in parts], -2)
        one_law = len(laws) < 2
        attached = _join_attached(parts)
        law_index = None if one_law else torch.cat(index, -1)
        more = {name: torch.cat(own, -2 if name == "normal" else -1) for name, own in _optional(parts).items()}
        return cls(position, **fields, laws=tuple(laws), law_index=law_index, attached=attached, **more)

    @classmethod
    def stack(cls, parts: Sequence[MaterialPoints]) -> MaterialPoints:
        """Independent scenes with as many points each and the same laws, as one batch of shape (B, P, ·)."""
        fields = {name: torch.stack([getattr(part, name) for part in parts]) for name in ("position", *_FIELDS)}
        index = [part.law_index for part in parts if part.law_index is not None]
        law_index, attached = torch.stack(index) if index else None, parts[0].attached
        for part in parts[1:]:
            same = part.attached is attached or (
                part.attached is not None and attached is not None and torch.equal(part.attached, attached)
            )
            if not same:
                raise ValueError("Scenes of one batch need the same `attached`: run those that differ one by one.")
        more = {name: torch.stack(own) for name, own in _optional(parts).items()}
        return cls(**fields, laws=parts[0].laws, law_index=law_index, attached=attached, **more)

    @property
    def count(self) -> int:
        """Number of points P of one scene."""
        return self.position.shape[-2]

    @property
    def elastic(self) -> Tensor | None:
        """Mask of points without plastic flow, shape (..., P); None if that is all of them."""
        if not any(law.plastic for law in self.laws):
            return None
        each = torch.tensor([not law.plastic for law in self.laws], device=self.position.device)
        return each[:1].expand(self.mass.shape) if self.law_index is None else each[self.law_index]

    def map(self, function: Callable[[Tensor], Tensor]) -> MaterialPoints:
        """Apply a function to every tensor (``.detach``, indexing); law indices stay integers, ``attached`` stays."""
        moved = {name: function(getattr(self, name)) for name in ("position", *_FIELDS)}
        index = None if self.law_index is None else function(self.law_index).long()
        given = {name: getattr(self, name) for name in _OPTIONAL_FIELDS}
        more: Any = {name: None if value is None else function(value) for name, value in given.items()}
        return MaterialPoints(**moved, laws=self.laws, law_index=index, attached=self.attached, **more)


def _check_attached(attached: Tensor, count: int) -> None:
    if attached.dtype != torch.int64 or not (attached.shape == (count,) or attached.shape[1:] == (2,)):
        raise ValueError(
            f"Expected `attached` to be int64, of shape ({count},) with a number for each point or (E, 2) with pairs "
            f"of points, but got {attached.dtype} of shape {tuple(attached.shape)}."
        )
    if attached.dim() == 2 and not bool(((attached >= 0) & (attached < count)).all()):
        raise ValueError(f"Expected the pairs of `attached` to be numbers of points from 0 to {count - 1}.")


def _optional(parts: Sequence[MaterialPoints]) -> dict[str, list[Tensor]]:
    found = {}
    for name in _OPTIONAL_FIELDS:
        given = [getattr(part, name) for part in parts]
        if any(value is not None for value in given):
            none = (torch.zeros_like(part.position if name == "normal" else part.mass) for part in parts)
            found[name] = [zero if own is None else own for own, zero in zip(given, none, strict=True)]
    return found


def _join_attached(parts: Sequence[MaterialPoints]) -> Tensor | None:
    if all(part.attached is None for part in parts):
        return None
    if any(part.attached is not None and part.attached.dim() == 2 for part in parts):
        raise ValueError("Bodies whose `attached` are pairs cannot be joined: give a number for each point.")
    found, many = [], 0
    for part in parts:
        own = torch.zeros(part.count, dtype=torch.long) if part.attached is None else part.attached.cpu()
        found.append(torch.unique(own, return_inverse=True)[1] + many)
        many = int(found[-1].max()) + 1 if part.count else many
    return torch.cat(found)


@fixed
@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """Everything that changes in a run, of any solver. A step returns a new one; nothing is changed in place.

    A solver that needs more has a subclass with more fields.

    Attributes:
        position: Position of the material points [m], shape (..., P, 3).
        velocity: Their velocity [m/s], shape (..., P, 3).
        F_elastic: Elastic deformation gradient, drives the stress, shape (..., P, 3, 3).
        F_total: Total deformation gradient, drives covariances and normals, shape (..., P, 3, 3); the same tensor as
            ``F_elastic`` where nothing flows.
        lost: Points that left the domain of the solver since the run began, shape (..., P), bool.
        time: Simulated time [s], scalar float64 tensor.
        internal: The internal variable of each point's plastic law (see its class), shape (..., P), or None if no law
            has one.
        substep: Length of the last substep [s]; 0 at the start.
        work: Work of the external forces since the start [J], shape (...) over the batch, float64.
        impulse: Reaction impulse: momentum that each boundary took from the body since the start [N s], in their order,
            shape (..., B, 3), float64; see :func:`support_force`.
        air: Moments of computed air, shape (10, X, Y, Z), which a stepper advances; or None.
    """

    position: Tensor
    velocity: Tensor
    F_elastic: Tensor
    F_total: Tensor
    lost: Tensor
    time: Tensor
    internal: Tensor | None = None
    substep: float = 0.0
    work: Tensor = field(default_factory=lambda: torch.zeros((), dtype=torch.float64))
    impulse: Tensor = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    air: Tensor | None = None

    def replace(self, **changes: Any) -> Self:
        return dataclasses.replace(self, **changes)

    def fields(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def scene(self, index: int) -> Self:
        own = {k: v[index] for k, v in self.fields().items() if isinstance(v, Tensor) and k != "time"}
        if self.F_total is self.F_elastic:
            own["F_total"] = own["F_elastic"]
        return self.replace(**own)

    def tensors(self) -> list[Tensor]:
        """Fields that may require a gradient."""
        without = ("lost", "time", "work", "impulse", "air")
        return [v for k, v in self.fields().items() if isinstance(v, Tensor) and k not in without]

    def state_dict(self) -> dict[str, Any]:
        return self.fields() | ({"F_total": None} if self.F_total is self.F_elastic else {})

    @classmethod
    def from_state_dict(cls, values: Mapping[str, Any], device: torch.device | str = "cpu") -> Self:
        """Rebuild a state saved by :meth:`state_dict`."""
        moved: dict[str, Any] = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in values.items()}
        if moved["F_total"] is None:
            moved["F_total"] = moved["F_elastic"]
        return cls(**moved)


@fixed
@dataclass(frozen=True, slots=True, kw_only=True)
class MPMState(State):
    """The state of an :class:`~gaussian_swaying.mpm.solver.MPMSolver`.

    In the ``total`` formulation the nodal fields are the state and the particle fields are interpolated from them; in
    the ``updated`` formulation the nodal fields are None.

    Attributes:
        affine: Velocity gradient [1/s], shape (..., P, 3, 3): APIC's affine velocity in ``updated``, the rate of F in
            ``total``.
        grid: The nodes in use.
        node_displacement: Nodal displacement [m], shape (..., G, 3), or None.
        node_velocity: Nodal velocity [m/s], shape (..., G, 3), or None.
        modal: Amplitudes of the modes of a body of 1 kg and their rates, shape (..., 2, M), in the ``modes``
            formulation; or None.
    """

    affine: Tensor
    grid: GridSpec
    node_displacement: Tensor | None = None
    node_velocity: Tensor | None = None
    modal: Tensor | None = None

    @property
    def nodal(self) -> tuple[Tensor, Tensor]:
        """Displacement and velocity of the nodes, which ``updated`` does not have."""
        assert self.node_displacement is not None
        assert self.node_velocity is not None
        return self.node_displacement, self.node_velocity

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`State.state_dict`; the box of the grid as a dictionary."""
        box = {name: getattr(self.grid, name) for name in ("dx", "offset", "resolution")}
        return super(MPMState, self).state_dict() | {"grid": box}

    @classmethod
    def from_state_dict(cls, values: Mapping[str, Any], device: torch.device | str = "cpu") -> Self:
        """See :meth:`State.from_state_dict`."""
        grid, nodes = values["grid"], values["node_displacement"]
        known = GridSpec(float(grid["dx"]), tuple(grid["offset"]), tuple(grid["resolution"]))
        if nodes is not None:
            known = dataclasses.replace(known, virtual=nodes.shape[-2] - known.lattice_count)
        return super(MPMState, cls).from_state_dict({**values, "grid": known}, device)


def support_force(before: State, after: State) -> Tensor:
    """The mean force that the body exerted on each boundary between two states: on a pin, the force on its support.

    Returns:
        Force [N], in the order of the boundaries of the solver, shape (..., B, 3), float64; zero if no time passed.
    """
    time = after.time - before.time
    return torch.where(time > 0, (after.impulse - before.impulse) / time, 0.0)
