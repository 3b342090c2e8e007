"""Dispatch of particles to their constitutive laws: each law is called once, on its own particles only."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.shared import lame_parameters
from gaussian_swaying.mpm.state import MaterialPoints


class LawDispatch:
    """The laws of a body, bound to its particles.

    With one law there is no indexing. With several, each law gets only its own particles, and the results are put back
    in order.

    Args:
        points: The material (one GPU synchronisation if it has several laws).

    Attributes:
        mu: Shear modulus [Pa], shape (..., P).
        lam: First Lamé parameter [Pa], shape (..., P).
        plastic: Whether any law has a return map.
    """

    def __init__(self, points: MaterialPoints) -> None:
        self.mu, self.lam = lame_parameters(points.youngs_modulus, points.poisson_ratio)
        self._groups: list[tuple[ConstitutiveLaw, Tensor | None]] = [(points.laws[0], None)]
        if points.law_index is not None:
            flat = points.law_index.reshape(-1)
            found = [(law, (flat == k).nonzero()[:, 0]) for k, law in enumerate(points.laws)]
            self._groups = [(law, index) for law, index in found if len(index)]
            order = torch.cat([index for _, index in found])
            self._place = torch.empty_like(order)
            self._place[order] = torch.arange(len(order), device=order.device)
        self.plastic = any(law.plastic for law, _ in self._groups)

    def initial_internal(self) -> Tensor | None:
        """The internal variables at rest, shape (..., P), or None if no law has one."""
        if all(law.internal is None for law, _ in self._groups):
            return None
        start = torch.zeros(self.mu.numel(), dtype=self.mu.dtype, device=self.mu.device)
        for law, index in self._groups:
            value = law.internal or 0.0
            if index is None:
                start = start + value
            else:
                start[index] = value
        return start.reshape(self.mu.shape)

    def energy(self, F: Tensor, internal: Tensor | None) -> Tensor:
        """Energy density [J/m³], shape (..., P)."""
        return self._each("energy", F, internal)[0]

    def pk1(self, F: Tensor, internal: Tensor | None) -> Tensor:
        """First Piola-Kirchhoff stress [Pa], shape (..., P, 3, 3)."""
        return self._each("pk1", F, internal)[0]

    def kirchhoff(self, F: Tensor, internal: Tensor | None) -> Tensor:
        """Kirchhoff stress [Pa], shape (..., P, 3, 3)."""
        return self._each("kirchhoff", F, internal)[0]

    def moduli(self, F: Tensor, internal: Tensor | None) -> tuple[Tensor, Tensor]:
        """P-wave modulus and bound of the Hessian [Pa], shape (..., P) each; see ``ConstitutiveLaw.moduli``."""
        wave, bound = self._each("moduli", F, internal)
        return wave, bound

    def return_map(self, F: Tensor, internal: Tensor | None, dt: float) -> tuple[Tensor, Tensor | None]:
        """Elastic deformation gradient and internal variable after plastic flow."""
        internal = self.initial_internal() if internal is None else internal
        found = self._each("return_map", F, internal, dt)
        return found[0], found[1] if internal is not None else None

    def _each(self, name: str, F: Tensor, internal: Tensor | None, *more: float) -> tuple[Tensor, ...]:
        law, index = self._groups[0]
        if index is None:
            return _as_tuple(getattr(law, name)(F, self.mu, self.lam, internal, *more), internal)
        flat = [F.reshape(-1, 3, 3), self.mu.reshape(-1), self.lam.reshape(-1)]
        hidden = None if internal is None else internal.reshape(-1)
        parts = []
        for law, index in self._groups:
            assert index is not None
            own = None if hidden is None else hidden[index]
            given = None if law.internal is None else own
            found = getattr(law, name)(*(value[index] for value in flat), given, *more)
            parts.append(_as_tuple(found, own))
        batch = self.mu.shape
        joined = (torch.cat(columns)[self._place] for columns in zip(*parts, strict=True))
        return tuple(value.reshape(*batch, *value.shape[1:]) for value in joined)


def _as_tuple(found: Tensor | tuple[Tensor, Tensor | None], internal: Tensor | None) -> tuple[Tensor, ...]:
    """The results of a law; if it has no internal variable, the given one is returned unchanged."""
    if isinstance(found, Tensor):
        return (found,)
    first, second = found
    if second is None:
        second = internal
    return (first,) if second is None else (first, second)
