"""The wind on the patches of a body, as a force for ``MPMSolver.rollout``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_shape
from gaussian_swaying._fixed import FixedList, changed
from gaussian_swaying.kernels.graphs import tensors_in
from gaussian_swaying.mpm.forces import Force, Given
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.field import SpatialWind, WindField
from gaussian_swaying.wind.force import (
    LAWS,
    AeroForce,
    force_adjoint,
    force_on_group,
    force_on_patch,
    wind_force,
    wind_on_groups,
)
from gaussian_swaying.wind.patches import Patches, PatchSums
from gaussian_swaying.wind.shelter import Shelter
from gaussian_swaying.wind.tables import wind_axes

Wind = WindField | SpatialWind


class Places(nn.Module):
    """Where copies of an object stand in one wind: each is simulated as if it stood at the place of the original.

    Args:
        turn: Rotation from the axes of the original to those of the scene, shape (B, 3, 3), float64.
        shift: Places are turned by it and then moved by this [m], shape (B, 3), float64.
        delay: Time by which the wind comes later [s], shape (B,), float64.
    """

    def __init__(self, turn: Tensor, shift: Tensor, delay: Tensor) -> None:
        super().__init__()
        for name, value in {"turn": turn, "shift": shift, "delay": delay}.items():
            self.register_buffer(name, value, persistent=False)
        self.turn: Tensor
        self.shift: Tensor
        self.delay: Tensor


class WindForce(Force):
    """Wind on surface patches that deform with their particles.

    Pass it to ``MPMSolver.rollout`` as one of its ``forces``. A uniform wind has a Triton twin, so on a GPU the force
    is computed inside the kernels of the substep.

    Args:
        aero: Coefficients and law of the force.
        wind: The wind; or one for each scene of a batch, as a list or by ``WindField.together``, which is faster for
            many.
        normal: Unit normals of the patches at rest, one for each particle, shape (..., P, 3); or any number of
            :class:`~gaussian_swaying.wind.patches.Patches`, those of the scenes of a batch one after the other.
        area: Their areas at rest [m²], shape (..., P); zero for particles that feel no wind. None with ``Patches``.
        places: The places of the scenes in one wind that they share.

    Attributes:
        normal: Unit normals at rest, shape (..., P, 3).
        area: Area of the patches of each particle at rest [m²], shape (..., P).
        sums: The sums over patches, if a particle has patches of several directions; else None, and ``normal`` is the
            direction of each particle.

    Raises:
        ValueError: If the shapes do not agree, or the numbers of winds and scenes differ.

    Example:
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> force = WindForce(AeroForce(C_F=0.0, C_L=0.0), WindField([0.0, 0.0, 2.0]), up, torch.ones(1))
        >>> force.winds(torch.zeros((), dtype=torch.float64), dt=1e-3, steps=4).shape
        torch.Size([4, 3])
    """

    def __init__(
        self,
        aero: AeroForce,
        wind: Wind | Sequence[Wind],
        normal: Tensor | Patches,
        area: Tensor | None = None,
        places: Places | None = None,
    ) -> None:
        super().__init__()
        self.sums: PatchSums | None = None
        patches = normal if isinstance(normal, Patches) else None
        if isinstance(normal, Patches):
            found = PatchSums(normal, coarse=aero.mostly_linear)
            self.sums = None if found.single else found
            normal, area = found.normals(), found.area
        if area is None:
            raise ValueError("Expected `area` of the patches, one for each `normal`.")
        check_shape("normal", normal, "P", 3)
        check_shape("area", area, normal.shape[-2])
        self._fields = nn.ModuleList([wind] if isinstance(wind, nn.Module) else wind)
        self.places = places
        several = None if places is None else len(places.delay)
        scenes = several or (wind.scenes if isinstance(wind, WindField) else None)
        scenes = scenes if isinstance(wind, nn.Module) else len(wind)
        if patches is not None and scenes and len(area) % scenes == 0:
            normal, area = normal.reshape(scenes, -1, 3), area.reshape(scenes, -1)
        self.aero = aero
        self.register_buffer("normal", normal, persistent=False)
        self.register_buffer("area", area, persistent=False)
        self.normal: Tensor
        self.area: Tensor
        self._shared = scenes is None
        given = tuple(normal.shape[:-2])
        if scenes is not None and given not in ((scenes,), ()):  # () for all scenes alike
            raise ValueError(f"Expected one `wind` for each of the {given} scenes, but got {scenes}.")

    @property
    def wind(self) -> nn.Module | tuple[nn.Module, ...]:
        """The wind, or a list with one wind for each scene of a batch."""
        return self._fields[0] if len(self._fields) == 1 else tuple(self._fields)

    @property
    def uniform(self) -> bool:
        """True if the wind is the same everywhere in a scene."""
        return all(bool(wind.uniform) for wind in self._fields)

    @property
    def recordable(self) -> bool:  # type: ignore[override]
        """True if a CUDA graph can record all winds, that is, spatial winds and modulations are ``recordable``."""
        return all(
            wind.recordable and (isinstance(wind, SpatialWind) or type(wind) is WindField) for wind in self._fields
        )

    def winds(self, time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        """Velocity of a uniform wind [m/s] at the start of ``steps`` substeps of ``dt`` [s] from ``time`` [s] on.

        Args:
            time: Scalar float64 tensor.
            dt: Number, or scalar float64 tensor on the same device.
            steps: Number of substeps.

        Returns:
            Shape (steps, 3), or (steps, B, 1, 3) with one wind for each scene; float64, on the device of ``time``.
        """
        times = time + torch.arange(steps, dtype=torch.float64, device=time.device) * dt
        at = times if self.places is None else times[:, None] - self.places.delay
        if len(self._fields) == 1:
            found = _blow(self._fields[0], at)
        else:
            each = [times] * len(self._fields) if self.places is None else at.unbind(1)
            found = torch.stack(list(map(_blow, self._fields, each)), dim=1)
        if self._shared:
            return found
        return found[:, :, None] if self.places is None else found[:, :, None] @ self.places.turn

    def air(self, time: Tensor, position: Tensor) -> Tensor:
        """Air velocity at given positions [m/s].

        Args:
            time: Time [s], scalar float64 tensor.
            position: Positions [m], shape (..., P, 3).

        Returns:
            Broadcastable to (..., P, 3).
        """
        if self.uniform:
            return self.winds(time, 0.0, 1)[0]
        if self._shared:
            return _air(self._fields[0], time, position)
        when, place = time.expand(len(position)), position
        if self.places is not None:
            when = time - self.places.delay
            place = position @ self.places.turn.to(position).mT + self.places.shift.to(position)[:, None]
        parts = map(_air, self._fields, when, place)
        found = torch.stack([part.to(position).expand_as(position[0]) for part in parts])
        return found if self.places is None else found @ self.places.turn.to(position)

    def samples(self, state: State, dt: float, steps: int) -> Tensor:
        """Air velocity [m/s] at the particles of a state, at ``steps`` times, ``dt`` [s] apart, starting at its time.

        Returns:
            Shape (steps, ...), broadcastable to (steps, ..., P, 3) from its second axis on.
        """
        if self.uniform:
            return self.winds(state.time, dt, steps)
        return torch.stack([self.air(state.time + k * dt, state.position) for k in range(steps)])

    def force(self, state: State, wind: Tensor) -> tuple[Tensor, Tensor | None]:
        """Force on every particle [N] (..., P, 3), and the resistance of a semi-implicit drag [kg/s] (..., P) or None.

        Args:
            state: The state at the start of the substep.
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
        """
        velocity, F, shape = state.velocity, state.F_total, state.velocity.shape
        if self.sums is None:
            force, area = self.aero.on_patches(wind, velocity, F, (self.normal, self.area))
        else:
            given = wind.expand(shape).reshape(-1, 3), velocity.reshape(-1, 3), F.reshape(-1, 3, 3)
            force, area = self.aero.on_patches(*given, self.sums)
            force, area = force.reshape(shape), area.reshape(shape[:-1])
        return force, self.aero.resistance(wind, velocity, area)

    def forward(self, state: State) -> tuple[Tensor, Tensor | None]:
        """:meth:`force` in the wind of ``state.time``."""
        return self.force(state, self.air(state.time, state.position))

    def _shelters(self) -> list[Shelter]:
        wind = self._fields[0]
        if not (self._shared and isinstance(wind, WindField)):
            return []
        return [effect for effect in wind.effects if isinstance(effect, Shelter)]

    def foreseen(self, state: State) -> WindForce:
        """The same force as it will be in the frame that starts with a state; this one does not change.

        Shelters of the result have tables of their own, as this one may be in use on another stream.
        """
        if not self._shelters():
            return self
        wind = self._fields[0]
        assert isinstance(wind, WindField)
        effects = [
            changed(effect, **{name: held.clone() for name, held in effect.named_buffers()})
            if isinstance(effect, Shelter)
            else copy(effect)
            for effect in wind.effects
        ]
        other = changed(self, _fields=nn.ModuleList([changed(wind, effects=FixedList(effects))]))
        other.refresh(state)
        return other

    def refreshed(self) -> list[Tensor]:
        """The tensors that :meth:`refresh` writes."""
        return tensors_in(self._shelters())

    def refresh(self, state: State) -> None:
        """Update each :class:`~gaussian_swaying.wind.shelter.Shelter` from the body's present shape; once in a frame.

        Args:
            state: The state at the start of the frame.
        """
        wind, shelters = self._fields[0], self._shelters()
        if not shelters or state.position.ndim > 2:
            return
        assert isinstance(wind, WindField)
        with torch.no_grad():
            flow = wind.mean_flow(state.time)
            axes = wind_axes(flow)
            still = state.replace(velocity=torch.zeros_like(state.velocity))
            force, _ = self.force(still, axes[0].to(still.velocity))  # in a wind of 1 m/s
            area = (force * axes[0].to(force)).sum(-1).clamp(min=0) / max(0.5 * self.aero.air_density, 1e-30)
            area = area * (flow.square().sum() > 0)
            for shelter in shelters:
                shelter.refresh(state.position, area, axes)

    def during(self, time: Tensor, dt: float, steps: int) -> Callable[[State, int], Given]:
        """See ``Force.during``: a uniform wind is computed for all substeps at once."""
        if self.uniform:
            winds = self.winds(time, dt, steps)
            return lambda state, k: self.force(state, winds[k])
        wind = self._fields[0]
        if not (self._shared and isinstance(wind, WindField)):
            return super().during(time, dt, steps)
        times = time + torch.arange(steps, dtype=torch.float64, device=time.device) * dt
        moments = list(map(Moment, times, wind.mean_flow(times), wind.carried(times)))
        blown = _blow(wind, times)
        return lambda state, k: self.force(state, wind.shaped(blown[k], state.position, moments[k]))

    def on_sites(self, site: Tensor, count: int) -> WindForce:
        """The wind on the patches of groups of points, with a drag that is semi-implicit; see ``Force.on_sites``."""
        scenes = max(1, site.shape[:-1].numel())
        shift = count * torch.arange(scenes, device=site.device)[:, None]
        group = (site.reshape(scenes, -1) + shift).reshape(-1)
        aero = changed(self.aero, drag_step="semi_implicit")
        if self.sums is not None:
            sums = self.sums.grouped(group, scenes * count, aero.mostly_linear)
        else:
            normal, area = self.normal.expand(*site.shape, 3).reshape(-1, 3), self.area.expand(site.shape).reshape(-1)
            sums = PatchSums(Patches(normal, area, group, scenes * count), coarse=aero.mostly_linear)
        area = sums.area.reshape(*site.shape[:-1], count)
        return changed(self, aero=aero, sums=sums, area=area, normal=area.new_zeros(*area.shape, 3))

    def twin(self) -> Twin | None:
        """See :class:`~gaussian_swaying.mpm.twins.Twin`; None if an effect has none, or the lists are too long."""
        wind, aero, sums = self._fields[0], self.aero, self.sums
        if sums is not None and sums.rows >= 2**24:  # rows are counted in float32
            return None
        parts: tuple[Twin, ...] = ()
        if not self.uniform:
            if not (self._shared and type(wind) is WindField):
                return None
            found = [effect.twin() for effect in wind.effects]  # type: ignore[operator]
            parts = tuple(part for part in found if part is not None)
            if len(parts) < len(found):
                return None
        implicit = aero.drag_step == "semi_implicit"
        smooth = self.uniform and not implicit
        width = 3 + sum(part.per_substep.count for part in parts)
        patches: dict[str, Any] = {
            "function": wind_force,
            "per_point": Numbers(
                4, lambda: torch.cat([self.normal.expand(*self.area.shape, 3), self.area[..., None]], dim=-1)
            ),
            "sources": (self.normal, self.area),
            "adjoint": force_adjoint(force_on_patch, 4, LAWS.index(aero.law)) if smooth else None,
        }
        if sums is not None:
            patches = {
                "function": wind_on_groups,
                "per_point": Numbers(2, lambda: sums.lists().reshape(*self.area.shape, 2)),
                "table": Numbers(4 * sums.rows, sums.table),
                "sources": (sums.tensor, sums.vector),
                "adjoint": force_adjoint(force_on_group, 2, LAWS.index(aero.law)) if smooth else None,
            }
        return Twin(
            options=(LAWS.index(aero.law), implicit),
            numbers=Numbers(5, aero.numbers),
            per_substep=Numbers(width, partial(self._with_effects, parts) if parts else self.winds),
            implicit=implicit,
            parts=parts,
            **patches,
        )

    def _with_effects(self, parts: Sequence[Twin], time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        """As :meth:`winds`, and the numbers of the twins of the effects at these times, shape (steps, n)."""
        wind = self._fields[0]
        assert isinstance(wind, WindField)
        times = time + torch.arange(steps, dtype=torch.float64, device=time.device) * dt
        asked = [part.per_substep for part in parts if part.per_substep.count]
        rows = [_blow(wind, times)]
        if asked:
            moment = Moment(times, wind.mean_flow(times), wind.carried(times))
            rows += [torch.as_tensor(numbers.take(moment)) for numbers in asked]
        return torch.cat(rows, dim=-1)


def _air(wind: nn.Module, time: Tensor, position: Tensor) -> Tensor:
    found: Tensor = wind.at(time, position) if isinstance(wind, WindField) else wind(time, position)
    return found


def _blow(wind: nn.Module, times: Tensor) -> Tensor:
    """Velocity of a uniform wind at times [s], on their device."""
    velocity: Tensor = wind(times)
    return velocity.to(times.device)
