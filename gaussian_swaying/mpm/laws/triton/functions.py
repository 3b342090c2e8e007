"""The device functions that a law provides for the kernels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from gaussian_swaying.mpm.laws.law import ConstitutiveLaw


@dataclass(frozen=True)
class LawFunctions:
    """Device functions of a law, the ``function`` of its twin; None if the law has none.

    A matrix is a tuple of nine values, row by row; stretches and principal stresses are tuples of three; ``p`` are the
    at most four numbers of the twin, padded with zeros.

    Attributes:
        principal: ``(a, mu, lam, internal, p)``: principal first Piola-Kirchhoff stresses from the principal stretches.
        pk1: ``(F, mu, lam, internal, p)``: first Piola-Kirchhoff stress, if it needs no decomposition.
        kirchhoff: ``(F, mu, lam, internal, p)``: Kirchhoff stress, if it needs no decomposition.
        flow: ``(a, mu, lam, internal, p, dt)``: principal stretches and internal variable after plastic flow.
        energy: ``(F, mu, lam)``: energy density.
        wave: ``(F, mu, lam)``: the first of ``ConstitutiveLaw.moduli``.
        adjoint: ``(F, Q, mu, lam)``: the derivative of the stress P in a direction Q, which is the gradient of Q : P by
            F, and the derivatives of Q : P by mu and by lam.

    A law needs ``principal``, or ``kirchhoff`` and, if it does not flow, ``pk1``. If a body needs the decomposition
    anyway, all laws that have ``principal`` use it. Without ``energy``, ``wave`` and ``adjoint``, torch computes them.

    Raises:
        ValueError: If the law has no stress.
    """

    principal: Any = None
    pk1: Any = None
    kirchhoff: Any = None
    flow: Any = None
    energy: Any = None
    wave: Any = None
    adjoint: Any = None

    def __post_init__(self) -> None:
        if not (self.principal or (self.kirchhoff and (self.pk1 or self.flow))):
            raise ValueError(
                "Expected a twin to have a stress: give `principal`, or `kirchhoff` and, for a law that does not flow, "
                "`pk1`."
            )


def functions_of(law: ConstitutiveLaw) -> LawFunctions | None:
    """The device functions of a law, or None for one that runs in torch only."""
    twin = law.twin()
    return None if twin is None else twin.function


def shared(laws: Iterable[ConstitutiveLaw], name: str) -> Any:
    """The ``energy`` or ``wave`` that all laws of a body have in common, or None."""
    found = {getattr(functions_of(law), name, None) for law in laws}
    return found.pop() if len(found) == 1 else None
