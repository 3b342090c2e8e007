"""The wind on the patches of a body, as a load for ``MPMSolver.rollout``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying._graphs import fingerprint, record
from gaussian_swaying.aero.force import AeroForce, capped_area
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.gaussians.surface import deform_patch

if TYPE_CHECKING:
    from gaussian_swaying.mpm.state import MPMState


RECORDED = 256
"""Substeps for which a recorded wind gives its velocity."""


class WindLoad:
    """Wind on surface patches that deform with their particles.

    ``MPMSolver.rollout`` takes it as ``force_fn``. It knows what the force depends on, so on a GPU the whole of it is
    computed within the substep's own kernels.

    Args:
        aero: Coefficients and law of the force.
        wind: The air, or one for each scene of a batch.
        normal: Unit normals of the patches at rest, shape (..., P, 3).
        area: Their areas at rest [m²], shape (..., P); zero for particles that feel no wind.

    Raises:
        ValueError: If the shapes do not agree, or there are not as many winds as scenes.

    Example:
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> load = WindLoad(AeroForce(C_F=0.0, C_L=0.0), WindField([0.0, 0.0, 2.0]), up, torch.ones(1))
        >>> load.winds(torch.zeros((), dtype=torch.float64), dt=1e-3, steps=4).shape
        torch.Size([4, 3])
    """

    def __init__(self, aero: AeroForce, wind: WindField | Sequence[WindField], normal: Tensor, area: Tensor) -> None:
        check_shape("normal", normal, "P", 3)
        check_shape("area", area, normal.shape[-2])
        self.aero, self.normal, self.area = aero, normal, area
        self.wind = wind if isinstance(wind, WindField) else tuple(wind)
        if isinstance(self.wind, tuple) and normal.shape[:-2] != (len(self.wind),):
            raise ValueError(
                f"Expected one `wind` for each of the {tuple(normal.shape[:-2])} scenes, but got {len(self.wind)}."
            )
        self._key: tuple[tuple[object, ...], ...] = ()
        self._graph: torch.cuda.CUDAGraph | None = None

    def __getstate__(self) -> dict[str, object]:
        """Without the graph, which nothing can copy."""
        kept = {name: value for name, value in vars(self).items() if name not in ("_now", "_dt", "_table")}
        return kept | {"_key": (), "_graph": None}

    def tensors(self) -> list[Tensor]:
        """All that the force depends on and that might ask for a gradient."""
        return [self.normal, self.area, *self.aero.parameters(), *self.aero.buffers(), *self._wind_tensors()]

    def _wind_tensors(self) -> list[Tensor]:
        return [t for wind in self._fields for t in (*wind.parameters(), *wind.buffers())]

    @property
    def device(self) -> torch.device | None:
        """Where the wind is; None if its parts are on several devices."""
        found = {tensor.device for tensor in self._wind_tensors()}
        return found.pop() if len(found) == 1 else None

    @property
    def _fields(self) -> tuple[WindField, ...]:
        return (self.wind,) if isinstance(self.wind, WindField) else self.wind

    def winds(self, time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        """Air velocity at the start of each of ``steps`` substeps of ``dt`` [s] from ``time`` [s] on [m/s].

        Gusts take some seventy small kernels. On a GPU they are recorded in a CUDA graph at the second call if all
        modulations are ``recordable``, and again when a number or a buffer of the wind was replaced; one load must then
        not be asked by two threads at once.

        Args:
            time: Scalar float64 tensor.
            dt: Number, or scalar float64 tensor on the same device.
            steps: How many.

        Returns:
            Shape (steps, 3), or (steps, B, 1, 3) with a wind for each scene; float64, on the device of ``time``.
        """
        known = all(type(wind) is WindField for wind in self._fields) and all(
            getattr(part, "recordable", False) for wind in self._fields for part in wind.modulations
        )
        on_gpu = time.is_cuda and self.device == time.device
        if not (on_gpu and known and steps <= RECORDED) or (
            torch.is_grad_enabled() and any(t.requires_grad for t in self._wind_tensors())
        ):
            return self._winds(time, dt, steps)
        key = fingerprint(self._fields)
        new = self._key != key
        if new:
            self._key, self._graph = key, None
            with torch.inference_mode(False):  # they may be written within inference mode and without
                self._now, self._dt = (torch.zeros((), dtype=torch.float64, device=time.device) for _ in range(2))
        elif self._graph is None:
            self._graph = record(time.device, self._tabulate)
        self._now.copy_(time)
        self._dt.copy_(dt) if isinstance(dt, Tensor) else self._dt.fill_(dt)
        if self._graph is None:  # the first time as it is, so that all is loaded before it is recorded
            self._tabulate()
        else:
            self._graph.replay()
        return self._table[:steps].clone()

    def _tabulate(self) -> None:
        self._table = self._winds(self._now, self._dt, RECORDED)

    def _winds(self, time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        times = time + torch.arange(steps, dtype=torch.float64, device=time.device) * dt
        if isinstance(self.wind, WindField):
            return self.wind(times).to(time.device)
        return torch.stack([wind(times) for wind in self.wind], dim=1)[:, :, None].to(time.device)

    def force(self, state: MPMState, wind: Tensor) -> tuple[Tensor, Tensor | None]:
        """Force on every particle [N] (..., P, 3), and the resistance of a semi-implicit drag [kg/s] (..., P) or None.

        Args:
            state: The state at the start of the substep.
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
        """
        normal, area = deform_patch(state.F_total, self.normal, self.area)
        area = capped_area(area, self.area, self.aero.max_area_ratio)
        return self.aero(wind, state.velocity, normal, area), self.aero.resistance(wind, state.velocity, area)

    def __call__(self, state: MPMState) -> tuple[Tensor, Tensor | None]:
        """:meth:`force` in the wind of ``state.time``."""
        return self.force(state, self.winds(state.time, 0.0, 1)[0])
