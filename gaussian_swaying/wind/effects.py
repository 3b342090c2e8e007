"""Effects make the wind differ from place to place; a ``WindField`` applies them in order, after its modulations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.kernels.graphs import Recordable
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.twins import Numbers, Twin, Twinned

SPREAD = 58.0
"""The updraft of a plume falls off as exp(-SPREAD r^2 / z^2)."""


@triton.jit
def log_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``LogProfile``; ``numbers``: height of the ground, roughness, one over the logarithm."""
    above = tl.maximum(x[2] - numbers[0], numbers[1])
    factor = tl.log(above / numbers[1]) * numbers[2]
    return v[0] * factor, v[1] * factor, v[2] * factor


@triton.jit
def power_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``PowerProfile``; ``numbers``: height of the ground, one over the height, exponent."""
    above = (x[2] - numbers[0]) * numbers[1]
    factor = tl.exp(numbers[2] * tl.log(tl.where(above > 0, above, 1.0)))
    factor = tl.where(above > 0, factor, 0.0)
    return v[0] * factor, v[1] * factor, v[2] * factor


@triton.jit
def plume(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Plume``; ``numbers``: its source (3), height of the source above the point, speed, spread."""
    a = x[0] - numbers[0]
    b = x[1] - numbers[1]
    above = x[2] - numbers[2]
    height = tl.maximum(above, 0.0) + numbers[3]
    off = numbers[5] * (a * a + b * b) / (height * height)
    fall = tl.exp(-off)
    series = 1 - off / 2 * (1 - off / 3 * (1 - off / 4 * (1 - off / 5)))
    share = tl.where(off < 1e-2, series, (1 - fall) / tl.maximum(off, 1e-2))
    up = numbers[4] * tl.exp(-tl.log(height) / 3)
    up = tl.where(above >= 0, up, 0.0)
    drawn = up / height * (fall - 5 / 6 * share)
    return v[0] + drawn * a, v[1] + drawn * b, v[2] + up * fall


@dataclass(frozen=True)
class Moment:
    """The wind at one time, as the effects get it; their twins get n times at once.

    Attributes:
        time: The time [s], scalar float64 tensor; of a twin, shape (n,).
        flow: Flow without modulations and effects [m/s], shape (3,), float64; of a twin, (n, 3).
        carried: Displacement of the air by that flow since time zero [m]; likewise.
    """

    time: Tensor
    flow: Tensor
    carried: Tensor


class WindEffect(Recordable, Twinned, nn.Module):
    """Base of effects, which change the wind from place to place.

    A subclass has a ``twin``, one device function (:mod:`~gaussian_swaying.mpm.twins`), or else a ``forward`` in torch,
    with ``recordable = True`` if that can be recorded in a CUDA graph (see ``Force``). If all effects of a wind have a
    twin, kernels compute it. Places are in metres, z up, from the centre of the object at rest; in a configuration they
    are in scene units, and :meth:`in_frame` converts them.
    """

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Return the changed velocity: that of the twin, also of a subclass that has none of its own.

        Args:
            velocity: Air velocity so far [m/s], broadcastable to (..., P, 3).
            position: Places [m], z up, shape (..., P, 3).
            moment: The time, and the undisturbed flow.

        Returns:
            Velocity [m/s], broadcastable to (..., P, 3).
        """
        twin = self.nearest_twin()
        if twin is None:
            raise NotImplementedError(
                f"{type(self).__name__} needs a `forward(velocity, position, moment)` or a `twin`."
            )
        return blown(twin, velocity, position, moment)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The same effect with its places converted from scene units to metres, z up; itself if it has none."""
        return self

    def along(self, flow: Tensor) -> WindEffect:
        """The same effect in a flow at the start [m/s], shape (3,), on the CPU; called when a wind is made."""
        return self


def blown(twin: Twin, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
    """The device function of an effect on tensors, as :meth:`WindEffect.forward`."""

    def numbers(given: Any) -> tuple[Any, ...]:
        return tuple(given.to(position).reshape(-1).unbind()) if isinstance(given, Tensor) else tuple(given)

    once = Moment(moment.time[None], moment.flow[None], moment.carried[None])
    now = twin.per_substep.take(once) if twin.per_substep.count else ()
    table = Memory(twin.table.take()) if twin.table.count else None
    air, place = velocity.to(position).unbind(-1), position.unbind(-1)
    found = on_tensors(twin.function)(air, place, numbers(twin.numbers.take()), numbers(now), table, twin.options)
    return torch.stack(torch.broadcast_tensors(*found), dim=-1)


def placed(frame: SimFrame, point: Sequence[float]) -> list[float]:
    """A point in scene units in metres, z up."""
    found: list[float] = frame.point_to_sim(torch.tensor([list(point)], dtype=torch.float64))[0].tolist()
    return found


class Profile(WindEffect):
    """Base of mean winds that grow with the height above the ground; gusts grow with them.

    Args:
        ground: A point on the ground, in scene units; only its height counts. In Python [m], z up.
        height: Height above the ground at which the wind is that of the ``flow`` [m].
    """

    recordable = True

    def __init__(self, ground: Sequence[float] = (0.0, 0.0, 0.0), height: float = 10.0) -> None:
        super().__init__()
        check_positive("height", height)
        self.ground, self.height = list(check_vector("ground", ground)), float(height)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The ground in metres."""
        return changed(self, ground=placed(frame, self.ground))


class LogProfile(Profile):
    r"""The logarithmic profile of a neutral boundary layer over rough ground, zero below the roughness length.

    .. math:: u(z) = u(h) \, \frac{\ln (z / z_0)}{\ln (h / z_0)}

    Args:
        ground: A point on the ground, in scene units; only its height counts.
        height: Height above the ground at which the wind is that of the ``flow`` [m].
        roughness: Roughness length z0 [m]: 0.001 for water, 0.01 for a lawn, 0.1 for a field with hedges, 1 for a town.

    """

    def __init__(
        self, ground: Sequence[float] = (0.0, 0.0, 0.0), height: float = 10.0, roughness: float = 0.01
    ) -> None:
        super().__init__(ground, height)
        check_positive("roughness", roughness)
        if not roughness < height:
            raise ValueError(f"Expected `roughness` ({roughness} m) to be below `height` ({height} m): lower it.")
        self.roughness = float(roughness)

    def twin(self) -> Twin:
        scale = 1 / math.log(self.height / self.roughness)
        return Twin(log_profile, numbers=Numbers(3, lambda: [self.ground[2], self.roughness, scale]), sources=(self,))


class PowerProfile(Profile):
    r"""The power law :math:`u(z) = u(h) (z / h)^a`, zero below the ground.

    Args:
        ground: A point on the ground, in scene units; only its height counts.
        height: Height above the ground at which the wind is that of the ``flow`` [m].
        exponent: a: about 0.1 over water, 0.14 over open land, 0.3 in towns.

    """

    def __init__(self, ground: Sequence[float] = (0.0, 0.0, 0.0), height: float = 10.0, exponent: float = 0.14) -> None:
        super().__init__(ground, height)
        check_positive("exponent", exponent)
        self.exponent = float(exponent)

    def twin(self) -> Twin:
        numbers = Numbers(3, lambda: [self.ground[2], 1 / self.height, self.exponent])
        return Twin(power_profile, numbers=numbers, sources=(self,))


class Plume(WindEffect):
    r"""Warm air that rises over a fire or a radiator, and the air that it draws in from the sides, added to the wind.

    The mean flow of a round turbulent plume (Shabbir and George 1994), without divergence:

    .. math:: w = 3.4 \, B^{1/3} z^{-1/3} e^{-58 r^2 / z^2}, \qquad B = \frac{2 g Q}{7 p}

    with the heat Q, g = 9.81 m/s2, the pressure p = 101325 Pa, the distance r from the axis and the height z above a
    point below the source, at which the plume is as wide as the source. It does not bend, so it is for winds weaker
    than the updraft, and flames themselves are hotter and faster. There is nothing below the source.

    Args:
        source: Centre of the source, in scene units. In Python [m], z up.
        radius: Distance from the axis at which the updraft is 1/e of that in the middle at the source, in scene units.
        heat: Heat that goes into the air [W]: 50 for a candle, 1000 for a radiator, 10000 for a small fire.

    Raises:
        ValueError: If ``radius`` or ``heat`` is not positive.

    Example:
        >>> plume = Plume(radius=0.1, heat=10000.0)
        >>> moment = Moment(torch.zeros(()), torch.zeros(3), torch.zeros(3))
        >>> plume(torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0]]), moment)
        tensor([[0.0000, 0.0000, 1.8343]])
    """

    recordable = True

    def __init__(self, source: Sequence[float] = (0.0, 0.0, 0.0), radius: float = 0.1, heat: float = 10000.0) -> None:
        super().__init__()
        check_positive("radius", radius)
        check_positive("heat", heat)
        self.source, self.radius, self.heat = list(check_vector("source", source)), float(radius), float(heat)

    @property
    def speed(self) -> float:
        """Updraft in the middle times the cube root of the height z [m^(4/3)/s]."""
        return 3.4 * (2 / 7 * 9.81 * self.heat / 101325) ** (1 / 3)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The source in metres."""
        return changed(self, source=placed(frame, self.source), radius=self.radius * frame.metres_per_unit)

    def twin(self) -> Twin:
        numbers = Numbers(6, lambda: [*self.source, math.sqrt(SPREAD) * self.radius, self.speed, SPREAD])
        return Twin(plume, numbers=numbers, sources=(self,))
