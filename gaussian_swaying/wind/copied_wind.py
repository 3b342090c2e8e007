"""The wind as one of several copies of an object feels it: at its own place, in its own axes, with its own gusts."""

from __future__ import annotations

from torch import Tensor, nn

from gaussian_swaying._fixed import changed
from gaussian_swaying.wind.field import SpatialWind, WindField


class CopiedWind(SpatialWind):
    """A wind in the axes of a copy, which is simulated as if it stood at the place of the original, unturned.

    Args:
        wind: The wind of the scene.
        turn: Rotation from the axes of the original to those of the scene, shape (3, 3), float64.
        shift: Places are turned by it and then moved by this [m], shape (3,), float64.
        delay: Time by which the wind comes later [s].
        seed: Seed of the gusts; that of the wind if None.

    Raises:
        ValueError: If the wind has no seed but one is given.

    Example:
        >>> import torch
        >>> turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> CopiedWind(WindField([0.0, 2.0, 0.0]), turn, torch.zeros(3, dtype=torch.float64))(torch.zeros(1))
        tensor([[2., 0., 0.]], dtype=torch.float64)
    """

    def __init__(
        self,
        wind: WindField | SpatialWind,
        turn: Tensor,
        shift: Tensor,
        delay: float = 0.0,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if seed is not None:
            if not isinstance(wind, WindField):
                raise ValueError("Expected `copies.seed` null with a wind of your own, which has no seed: use `delay`.")
            wind = changed(wind, seed=int(seed))
        self.wind: nn.Module = wind
        self.delay = float(delay)
        self.register_buffer("turn", turn, persistent=False)
        self.register_buffer("shift", shift, persistent=False)
        self.turn: Tensor
        self.shift: Tensor

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """True if the wind is the same everywhere."""
        return bool(self.wind.uniform)

    @property
    def recordable(self) -> bool:  # type: ignore[override]
        """True if the wind can be recorded in a CUDA graph."""
        known = isinstance(self.wind, SpatialWind) or type(self.wind) is WindField
        return known and bool(self.wind.recordable)

    def forward(self, time: Tensor, position: Tensor | None = None) -> Tensor:
        """Air velocity in the axes of the copy.

        Args:
            time: Time [s], scalar float64 tensor; of a uniform wind also shape (n,).
            position: Places in the copy [m], z up, shape (..., P, 3); None for a uniform wind.

        Returns:
            Velocity [m/s], shape (..., 3) of a uniform wind, otherwise broadcastable to (..., P, 3).
        """
        when = time - self.delay
        if position is None:
            velocity = self.wind(when)
        else:
            place = position @ self.turn.to(position).mT + self.shift.to(position)
            velocity = self.wind.at(when, place) if isinstance(self.wind, WindField) else self.wind(when, place)
        found: Tensor = velocity @ self.turn.to(velocity)
        return found
