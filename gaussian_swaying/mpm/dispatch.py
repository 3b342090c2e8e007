"""Each particle's law: on tensors, each law on its own particles; in a kernel, all laws of a body as one constant.

A body of one law compiles to that law alone. With several laws, the result of its own law is selected for each
particle; parts that laws share are computed once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import matmul, scaled_product, svd3, transpose, where3, where9
from gaussian_swaying.kernels.derive import device_function, on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import Constant, device_key
from gaussian_swaying.mpm.laws.law import NUMBERS, ConstitutiveLaw, DeviceLaw, lame_parameters
from gaussian_swaying.mpm.state import MaterialPoints

ROW = tl.constexpr(2 + NUMBERS)  # columns of the table: which stress, which flow (-1 for none), the numbers


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
    if isinstance(found, Tensor):
        return (found,)
    first, second = found
    if second is None:
        second = internal
    return (first,) if second is None else (first, second)


class BodyLaws(Constant):
    """The device functions of the laws of a body, each one once.

    It is passed to the kernels as a constant; they read its attributes when they are compiled.

    Args:
        laws: The laws; all need ``device``.

    Attributes:
        table: A row for each law: the indices of its stress and its flow, and its numbers.
        spectral: Whether stresses or flow need the decomposition of F.
        principals: Functions of the stresses that come from principal stretches; they are numbered first.
        matrices: Functions of first Piola-Kirchhoff stresses that come from F itself, numbered after those.
        flows: Functions of the plastic flow.
        all_flow: Whether every law flows.
    """

    def __init__(self, laws: Sequence[ConstitutiveLaw]) -> None:
        own: list[DeviceLaw] = [law.device for law in laws if law.device is not None]
        self.spectral = any(device.flow or not device.stress for device in own)

        def place(device: DeviceLaw) -> tuple[bool, Any]:
            direct = not (self.spectral and device.principal)
            return direct, device.stress if direct else device.principal

        chosen = [place(device) for device in own]
        order = _once(sorted(chosen, key=lambda pair: pair[0]))
        self.principals = tuple(stress for direct, stress in order if not direct)
        self.matrices = tuple(stress for direct, stress in order if direct)
        self._sources = [own[chosen.index(stress)] for stress in order]
        self.flows = _once(device.flow for device in own if device.flow)
        self.all_flow = all(device.flow for device in own)
        self.table = [
            [float(order.index(stress)), float(self.flows.index(device.flow) if device.flow else -1), *law.row]
            for law, device, stress in zip(laws, own, chosen, strict=True)
        ]
        functions = [self.principals, self.matrices, self.flows]
        source = [[device_key(function) for function in part] for part in functions]
        self.cache_key = hashlib.sha256(repr((source, self.spectral, self.all_flow)).encode()).hexdigest()

    @property
    def adjoints(self) -> tuple[Any, ...]:
        """Gradients of the stresses in the order of their numbers, derived when they are first wanted."""
        return tuple(device.adjoint for device in self._sources)


def _once(functions: Any) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(functions))


def in_common(laws: Sequence[ConstitutiveLaw], name: str) -> Any:
    """The ``wave`` or ``energy`` density ``(F, mu, lam)`` shared by all laws.

    None if laws differ in it, or if it needs numbers of a law or an internal variable.
    """
    found = {law.device and (law.device.bounds if name == "wave" else law.device.density) for law in laws}
    free = all(law.device is not None and law.device.free for law in laws)
    return _alone(found.pop(), name) if free and len(found) == 1 else None


@cache
def _alone(function: Any, name: str) -> Any:
    def formula(F: Any, mu: Any, lam: Any) -> Any:
        result = on_tensors(function)(F, mu, lam, 0.0, (0.0,) * NUMBERS)
        return result[0] if name == "wave" else result

    return device_function(name, {"F": 9, "mu": 0, "lam": 0}, formula)


@triton.jit
def _numbers(row):
    return (tl.load(row + 2), tl.load(row + 3), tl.load(row + 4), tl.load(row + 5))


@triton.jit
def _principal(a, mu, lam, internal, which, p, LAWS: tl.constexpr):
    y = LAWS.principals[0](a, mu, lam, internal, p)
    for k in tl.static_range(1, len(LAWS.principals)):
        y = where3(which == k, LAWS.principals[k](a, mu, lam, internal, p), y)
    return y


@triton.jit
def pk1(F, mu, lam, row, LAWS: tl.constexpr):
    """First Piola-Kirchhoff stress of elastic laws; ``row`` points to the law of each particle in the table."""
    n: tl.constexpr = len(LAWS.principals)
    which = tl.load(row).to(tl.int32)
    p = _numbers(row)
    internal = mu * 0
    if n > 0:
        u, a, v = svd3(F)
        stress = scaled_product(u, _principal(a, mu, lam, internal, which, p, LAWS), v)
    else:
        stress = LAWS.matrices[0](F, mu, lam, internal, p)
    for k in tl.static_range(0 if n > 0 else 1, len(LAWS.matrices)):
        stress = where9(which == n + k, LAWS.matrices[k](F, mu, lam, internal, p), stress)
    return stress


@triton.jit
def pk1_adjoint(F, Q, mu, lam, row, ADJOINTS: tl.constexpr):
    """Gradient of Q : P by F, mu and lam; ``row`` as for :func:`pk1`, the laws' adjoints as the ``stresses``."""
    p = _numbers(row)
    internal = mu * 0
    change, by_mu, by_lam = ADJOINTS.stresses[0](F, mu, lam, internal, p, Q)
    if len(ADJOINTS.stresses) > 1:
        which = tl.load(row).to(tl.int32)
        for k in tl.static_range(1, len(ADJOINTS.stresses)):
            other, one, two = ADJOINTS.stresses[k](F, mu, lam, internal, p, Q)
            own = which == k
            change = where9(own, other, change)
            by_mu = tl.where(own, one, by_mu)
            by_lam = tl.where(own, two, by_lam)
    return change, by_mu, by_lam


@triton.jit
def _flow(a, mu, lam, internal, which, p, dt, LAWS: tl.constexpr):
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
    p = _numbers(row)
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
        stress = matmul(LAWS.matrices[0](F, mu, lam, internal, p), transpose(F))
    for k in tl.static_range(0 if n > 0 else 1, len(LAWS.matrices)):
        direct = matmul(LAWS.matrices[k](F, mu, lam, internal, p), transpose(F))
        stress = where9(which == n + k, direct, stress)
    return F, internal, stress
