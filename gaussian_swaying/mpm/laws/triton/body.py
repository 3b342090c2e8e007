"""Stress and flow of a body of one or several laws, for the fused substep.

The set of laws is a constant of the compiled kernel, so a body of one law compiles to that law alone. With several
laws, the result of its own law is selected for each particle; parts that laws share are computed once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

from gaussian_swaying.geometry.linalg_triton import scaled_product, svd3, where3, where9
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.twins import Twin, device_key

ROW = tl.constexpr(6)  # columns of the table: which stress, which flow (-1 for none), four numbers


class BodyLaws:
    """The device functions of the laws of a body, each one once.

    It is passed to the kernels as a constant; they read its attributes when they are compiled.

    Args:
        laws: The laws; all need a twin.

    Attributes:
        table: A row of six numbers for each law: the indices of its stress and its flow, and its coefficients.
        spectral: Whether stresses or flow need the decomposition of F.
        principals: Functions of the stresses that come from principal stretches; they are numbered first.
        matrices: Functions of Kirchhoff stresses that come from F itself, numbered after those.
        elastic: As ``matrices``, for first Piola-Kirchhoff stresses (None for a law that flows).
        flows: Functions of the plastic flow.
        adjoints: Derivatives of the stresses in the order of their numbers; None where a law has none.
        all_flow: Whether every law flows.
        cache_key: Changes with the source of the functions, for the caches of Triton.
    """

    def __init__(self, laws: Sequence[ConstitutiveLaw]) -> None:
        given = [twin for law in laws if (twin := law.twin()) is not None]
        twins: list[LawFunctions] = [twin.function for twin in given]
        self.spectral = any(twin.flow or not twin.kirchhoff for twin in twins)
        chosen = [
            (twin.principal,) if self.spectral and twin.principal else (twin.kirchhoff, twin.pk1) for twin in twins
        ]
        order = _once(sorted(chosen, key=len))
        self.principals = tuple(stress[0] for stress in order if len(stress) == 1)
        self.matrices = tuple(stress[0] for stress in order if len(stress) == 2)
        self.elastic = tuple(stress[1] for stress in order if len(stress) == 2)
        derivatives = {stress: twin.adjoint for stress, twin in zip(chosen, twins, strict=True)}
        self.adjoints = tuple(derivatives[stress] for stress in order)
        self.flows = _once(twin.flow for twin in twins if twin.flow)
        self.all_flow = all(twin.flow for twin in twins)
        self.table = [
            [float(order.index(stress)), float(self.flows.index(twin.flow) if twin.flow else -1), *_padded(law, whole)]
            for law, whole, twin, stress in zip(laws, given, twins, chosen, strict=True)
        ]
        functions = [self.principals, self.matrices, self.elastic, self.flows, self.adjoints]
        source = [[device_key(function) for function in part] for part in functions]
        self.cache_key = hashlib.sha256(repr((source, self.spectral, self.all_flow)).encode()).hexdigest()

    def __repr__(self) -> str:
        return f"Laws_{self.cache_key[:16]}"  # part of the names and keys of compiled functions


def _once(functions: Any) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(functions))


def _padded(law: ConstitutiveLaw, twin: Twin) -> list[float]:
    values = [float(value) for value in twin.numbers.take()]
    if len(values) > 4:
        raise ValueError(f"Expected at most four `numbers` of {type(law).__name__}, but got {len(values)}.")
    return values + [0.0] * (4 - len(values))


@triton.jit
def _coefficients(row):
    return (tl.load(row + 2), tl.load(row + 3), tl.load(row + 4), tl.load(row + 5))


@triton.jit
def _principal(a, mu, lam, internal, which, p, LAWS: tl.constexpr):
    """Principal first Piola-Kirchhoff stresses; arbitrary for a law with another kind of stress."""
    y = LAWS.principals[0](a, mu, lam, internal, p)
    for k in tl.static_range(1, len(LAWS.principals)):
        y = where3(which == k, LAWS.principals[k](a, mu, lam, internal, p), y)
    return y


@triton.jit
def pk1(F, mu, lam, row, LAWS: tl.constexpr):
    """First Piola-Kirchhoff stress of elastic laws; ``row`` points to the law of each particle in the table."""
    n: tl.constexpr = len(LAWS.principals)
    which = tl.load(row).to(tl.int32)
    p = _coefficients(row)
    internal = mu * 0
    if n > 0:
        u, a, v = svd3(F)
        stress = scaled_product(u, _principal(a, mu, lam, internal, which, p, LAWS), v)
    else:
        stress = LAWS.elastic[0](F, mu, lam, internal, p)
    for k in tl.static_range(0 if n > 0 else 1, len(LAWS.elastic)):
        stress = where9(which == n + k, LAWS.elastic[k](F, mu, lam, internal, p), stress)
    return stress


@triton.jit
def pk1_adjoint(F, Q, mu, lam, row, LAWS: tl.constexpr):
    """Gradient of Q : P by F, mu and lam; ``row`` as for :func:`pk1`."""
    change, by_mu, by_lam = LAWS.adjoints[0](F, Q, mu, lam)
    if len(LAWS.adjoints) > 1:
        which = tl.load(row).to(tl.int32)
        for k in tl.static_range(1, len(LAWS.adjoints)):
            other, one, two = LAWS.adjoints[k](F, Q, mu, lam)
            own = which == k
            change = where9(own, other, change)
            by_mu = tl.where(own, one, by_mu)
            by_lam = tl.where(own, two, by_lam)
    return change, by_mu, by_lam


@triton.jit
def _flow(a, mu, lam, internal, which, p, dt, LAWS: tl.constexpr):
    """Principal stretches and internal variable after plastic flow."""
    new, inner = LAWS.flows[0](a, mu, lam, internal, p, dt)
    if not LAWS.all_flow:
        new = where3(which == 0, new, a)
        inner = tl.where(which == 0, inner, internal)
    for k in tl.static_range(1, len(LAWS.flows)):
        values, memory = LAWS.flows[k](a, mu, lam, internal, p, dt)
        new = where3(which == k, values, new)
        inner = tl.where(which == k, memory, inner)
    return new, inner


@triton.jit
def kirchhoff(F, mu, lam, internal, row, dt, LAWS: tl.constexpr, FLOW: tl.constexpr):
    """Kirchhoff stress after the return map, from one decomposition; ``row`` as for :func:`pk1`.

    Returns the elastic F and the internal variable after plastic flow (with FLOW; else as given), and the stress.
    """
    n: tl.constexpr = len(LAWS.principals)
    if LAWS.spectral:
        u, a, v = svd3(F)
    # read here, so that registers need not hold it during the decomposition
    which = tl.load(row).to(tl.int32)
    p = _coefficients(row)
    if FLOW and len(LAWS.flows) > 0:
        flow = tl.load(row + 1).to(tl.int32)
        a, internal = _flow(a, mu, lam, internal, flow, p, dt, LAWS)
        if LAWS.all_flow:
            F = scaled_product(u, a, v)
        else:
            F = where9(flow >= 0, scaled_product(u, a, v), F)
    if n > 0:
        y = _principal(a, mu, lam, internal, which, p, LAWS)
        stress = scaled_product(u, (y[0] * a[0], y[1] * a[1], y[2] * a[2]), u)
    else:
        stress = LAWS.matrices[0](F, mu, lam, internal, p)
    for k in tl.static_range(0 if n > 0 else 1, len(LAWS.matrices)):
        stress = where9(which == n + k, LAWS.matrices[k](F, mu, lam, internal, p), stress)
    return F, internal, stress
