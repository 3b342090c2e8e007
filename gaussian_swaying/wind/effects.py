"""Effects make the wind differ from place to place; a ``WindField`` applies them in order, after its modulations."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.kernels.graphs import Recordable
from gaussian_swaying.mpm.twins import Numbers, Twin, Twinned

SPREAD = 58.0
"""The updraft of a plume falls off as exp(-SPREAD r^2 / z^2)."""


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


class WindEffect(Recordable, Twinned, nn.Module, ABC):
    """Base of effects, which change the wind from place to place.

    A subclass has a ``forward``, and sets ``recordable = True`` if that can be recorded in a CUDA graph (see
    ``Force``). If all effects of a wind have a ``twin`` (:mod:`~gaussian_swaying.mpm.twins`), kernels compute it.
    Places are in metres, z up, from the centre of the object at rest; in a configuration they are in scene units, and
    :meth:`in_frame` converts them.
    """

    @abstractmethod
    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Return the changed velocity.

        Args:
            velocity: Air velocity so far [m/s], broadcastable to (..., P, 3).
            position: Places [m], z up, shape (..., P, 3).
            moment: The time, and the undisturbed flow.

        Returns:
            Velocity [m/s], broadcastable to (..., P, 3).
        """

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The same effect with its places converted from scene units to metres, z up; itself if it has none."""
        return self

    def along(self, flow: Tensor) -> WindEffect:
        """The same effect in a flow at the start [m/s], shape (3,), on the CPU; called when a wind is made."""
        return self


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

    @abstractmethod
    def factor(self, above: Tensor) -> Tensor:
        """Speed at heights above the ground [m], per speed at ``height``; the shape of ``above``."""

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Scale the velocity by :meth:`factor`."""
        return velocity * self.factor(position[..., 2:] - self.ground[2])

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

    Example:
        >>> profile = LogProfile(height=10.0, roughness=0.1)
        >>> round(float(profile.factor(torch.tensor(1.0))), 3)
        0.5
    """

    def __init__(
        self, ground: Sequence[float] = (0.0, 0.0, 0.0), height: float = 10.0, roughness: float = 0.01
    ) -> None:
        super().__init__(ground, height)
        check_positive("roughness", roughness)
        if not roughness < height:
            raise ValueError(f"Expected `roughness` ({roughness} m) to be below `height` ({height} m): lower it.")
        self.roughness = float(roughness)

    def factor(self, above: Tensor) -> Tensor:
        return (above.clamp(min=self.roughness) / self.roughness).log() / math.log(self.height / self.roughness)

    def twin(self) -> Twin:
        from gaussian_swaying.wind.effects_triton import log_profile

        scale = 1 / math.log(self.height / self.roughness)
        return Twin(log_profile, numbers=Numbers(3, lambda: [self.ground[2], self.roughness, scale]), sources=(self,))


class PowerProfile(Profile):
    r"""The power law :math:`u(z) = u(h) (z / h)^a`, zero below the ground.

    Args:
        ground: A point on the ground, in scene units; only its height counts.
        height: Height above the ground at which the wind is that of the ``flow`` [m].
        exponent: a: about 0.1 over water, 0.14 over open land, 0.3 in towns.

    Example:
        >>> profile = PowerProfile(height=10.0, exponent=0.5)
        >>> round(float(profile.factor(torch.tensor(2.5))), 3)
        0.5
    """

    def __init__(self, ground: Sequence[float] = (0.0, 0.0, 0.0), height: float = 10.0, exponent: float = 0.14) -> None:
        super().__init__(ground, height)
        check_positive("exponent", exponent)
        self.exponent = float(exponent)

    def factor(self, above: Tensor) -> Tensor:
        return (above.clamp(min=0.0) / self.height).pow(self.exponent)

    def twin(self) -> Twin:
        from gaussian_swaying.wind.effects_triton import power_profile

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

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        x, y, above = (part - at for part, at in zip(position.unbind(-1), self.source, strict=True))
        height = above.clamp(min=0.0) + math.sqrt(SPREAD) * self.radius
        off = (SPREAD * (x * x + y * y) / height.square()).clamp(min=1e-12)
        up, fall = self.speed * height.pow(-1 / 3), (-off).exp()
        drawn = up / height * (fall + 5 / 6 * (-off).expm1() / off)
        plume = torch.stack([drawn * x, drawn * y, up * fall], dim=-1)
        return velocity + torch.where(above[..., None] >= 0, plume, 0.0)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The source in metres."""
        return changed(self, source=placed(frame, self.source), radius=self.radius * frame.metres_per_unit)

    def twin(self) -> Twin:
        from gaussian_swaying.wind.effects_triton import plume

        numbers = Numbers(6, lambda: [*self.source, math.sqrt(SPREAD) * self.radius, self.speed, SPREAD])
        return Twin(plume, numbers=numbers, sources=(self,))
