r"""What a law is: its device functions, what is derived from them, and the module that has its numbers.

An isotropic law is its energy density in the principal stretches a of F = U diag(a) V^T. From it follow, by
:mod:`~gaussian_swaying.kernels.derive`, the principal stresses :math:`y_i = \partial \Psi / \partial a_i`, the stress
:math:`P = U \operatorname{diag}(y) V^T`, its gradients, and bounds on the stiffness. With :math:`H_{ij} = \partial y_i
/ \partial a_j`, the eigenvalues of the Hessian :math:`\partial^2 \Psi / \partial F^2` are those of H and, for each pair
of axes, twist :math:`(y_i + y_j) / (a_i + a_j)` and flip :math:`(y_i - y_j) / (a_i - a_j)`, a divided difference.

Two bounds [Pa]: ``wave``, on :math:`m \otimes N : H : m \otimes N` for unit vectors m and N, which is density times the
square of the speed of the fastest plane wave, and ``bound``, on the largest eigenvalue. On :math:`m \otimes N` each
:math:`H_{ij}` may be shifted from twist to flip, which leaves the largest of :math:`H_{ii}` and of the two less and
plus :math:`H_{ij}`. Neither is taken below its value at rest.

Each law is also defined for crushed and inverted elements: a finite stress pushes them back.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gaussian_swaying._fixed import Fixed
from gaussian_swaying.geometry.linalg import entries, from_principal, matmul3, matrix, spectrum
from gaussian_swaying.geometry.linalg_triton import (
    largest,
    largest_eigenvalue,
    matmul,
    svd3,
    transpose,
)
from gaussian_swaying.kernels.derive import device_function, difference, gradient, on_tensors, primitive, uses, vjp
from gaussian_swaying.kernels.language import tl, triton

LOG_LIMIT = 0.05
"""Stretch, or volume ratio, below which logarithms are continued by their tangent."""

LOG_FLOOR = tl.constexpr(LOG_LIMIT)
EPSILON = tl.constexpr(2**-23)  # of float32
NUMBERS = 4
"""Most numbers of a law."""

_STRETCHED = {"a": 3, "mu": 0, "lam": 0, "internal": 0, "p": NUMBERS}
_STRAINED = {"F": 9, "mu": 0, "lam": 0, "internal": 0, "p": NUMBERS}
_PAIRS = ((1, 2), (0, 2), (0, 1))


def lame_parameters(youngs_modulus: Tensor, poisson_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Shear modulus mu and first Lamé parameter lambda [Pa] from E [Pa] and nu, elementwise."""
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))


@triton.jit
def log(x):
    """Logarithm, below 0.05 continued by its tangent: it and its gradient are defined for every number."""
    inside = tl.maximum(x, LOG_FLOOR)
    return tl.log(inside) + (x - inside) / LOG_FLOOR


@triton.jit
def log_slope(x):
    """Derivative of :func:`log`."""
    return 1.0 / tl.maximum(x, LOG_FLOOR)


@triton.jit
def share_above(x, y, floor):
    """Share of the way from y to x that lies above a floor."""
    gap = x - y
    none = gap == 0
    above = (tl.maximum(x, floor) - tl.maximum(y, floor)) / tl.where(none, 1.0, gap)
    return tl.where(none, tl.where(x < floor, 0.0, 1.0), above)


@triton.jit
def log_difference(x, y):
    """(log x - log y) / (x - y) of the continued logarithm, accurate to round-off also if x is close to y."""
    share = share_above(x, y, LOG_FLOOR)
    x = tl.maximum(x, LOG_FLOOR)
    y = tl.maximum(y, LOG_FLOOR)
    ratio = (x - y) / (x + y)
    w = ratio * ratio
    near = w < 0.04
    # log x - log y = 2 artanh((x - y) / (x + y))
    series = 2 * (1 + w * (1.0 / 3 + w * (1.0 / 5 + w * (1.0 / 7 + w / 9)))) / (x + y)
    slope = tl.where(near, series, tl.log(x / y) / tl.where(near, 1.0, x - y))
    return share * slope + (1 - share) / LOG_FLOOR


primitive(
    log,
    vjp=lambda given, _, bar: (bar * on_tensors(log_slope)(*given),),
    difference=on_tensors(log_difference),
)


@triton.jit
def spectral_moduli(own, first, second, third, rest, least):
    """``wave`` and ``bound`` from H_ii and each H_ij, twist and flip, not below their values at rest.

    The pairs of axes are (1, 2), (0, 2) and (0, 1).
    """
    unit = tl.maximum(rest, 1e-30)  # or the cube of a modulus would overflow
    m0 = first[0] / unit
    m1 = second[0] / unit
    m2 = third[0] / unit
    inner = (own[0] / unit, m2, m1, m2, own[1] / unit, m0, m1, m0, own[2] / unit)
    bound = largest(unit * largest_eigenvalue(inner), least)
    wave = largest(largest(own[0], own[1]), largest(own[2], rest))
    pairs = (first, second, third)
    for k in tl.static_range(3):
        mixed, twist, flip = pairs[k]
        bound = largest(bound, largest(twist, flip))
        wave = largest(wave, largest(twist - mixed, flip + mixed))
    return tl.minimum(wave, bound, tl.PropagateNan.ALL), bound


@triton.jit
def spectral_change(u, v, b, along, first, second, third):
    """The derivative of a stress in a direction Q, from B = U^T Q V and H diag(B); pairs as above.

    A symmetric part of B off the diagonal is multiplied by flip, a skew one by twist.
    """
    s12 = 0.5 * first[2] * (b[5] + b[7])
    t12 = 0.5 * first[1] * (b[5] - b[7])
    s02 = 0.5 * second[2] * (b[2] + b[6])
    t02 = 0.5 * second[1] * (b[2] - b[6])
    s01 = 0.5 * third[2] * (b[1] + b[3])
    t01 = 0.5 * third[1] * (b[1] - b[3])
    inner = (along[0], s01 + t01, s02 + t02, s01 - t01, along[1], s12 + t12, s02 - t02, s12 - t12, along[2])
    return matmul(matmul(u, inner), transpose(v))


primitive(spectral_moduli, outputs=2)
primitive(spectral_change, outputs=9)


@dataclass(frozen=True)
class DeviceLaw:
    """The device functions of a law. Matrices are tuples of nine numbers, row by row, stretches of three.

    The other arguments are mu and lam, the Lamé parameters [Pa], the internal variable, and ``p``, the numbers of the
    law, padded with zeros to four.

    Attributes:
        energy: ``(a, mu, lam, internal, p)``: energy density [J/m³] in the principal stretches. It must be symmetric in
            them and built of arithmetic, ``log`` of this file, roots, maxima and minima; all else follows from it.
        strain_energy: ``(F, mu, lam, internal, p)``: energy density of a law that is simpler in F, without ``energy``.
        pk1: ``(F, mu, lam, internal, p)``: first Piola-Kirchhoff stress [Pa], if it is simpler in F than derived.
        moduli: ``(F, mu, lam, internal, p)``: ``wave`` and ``bound``, if they are simpler in F, or without ``energy``.
        flow: ``(a, mu, lam, internal, p, dt)``: stretches and internal variable after plastic flow in dt [s].

    Raises:
        ValueError: If a law has neither ``energy``, nor ``strain_energy`` and ``moduli``.
    """

    energy: Any = None
    strain_energy: Any = None
    pk1: Any = None
    moduli: Any = None
    flow: Any = None

    def __post_init__(self) -> None:
        if not self.energy and not (self.strain_energy and self.moduli):
            raise ValueError("Expected a law to have `energy`, or `strain_energy` and `moduli`.")

    @cached_property
    def stress(self) -> Any:
        """First Piola-Kirchhoff stress from F without a decomposition; None for a law in principal stretches."""
        return self.pk1 or (None if self.energy else _derivative(self.strain_energy, "F"))

    @cached_property
    def principal(self) -> Any:
        """Principal first Piola-Kirchhoff stresses from the stretches; None for a law in F."""
        return _derivative(self.energy, "a") if self.energy else None

    @cached_property
    def adjoint(self) -> Any:
        """``(F, mu, lam, internal, p, Q)``: the gradients of Q : P by F, mu and lam."""
        return _adjoint_of(self.stress) if self.stress else _spectral_adjoint(self.energy)

    @cached_property
    def bounds(self) -> Any:
        """``moduli``, derived if they are not given."""
        return self.moduli or _spectral_moduli_of(self.energy)

    @cached_property
    def free(self) -> bool:
        used = uses(self.energy, _STRETCHED) if self.energy else uses(self.strain_energy, _STRAINED)
        return not used & {"internal", "p"}

    @cached_property
    def density(self) -> Any:
        return self.strain_energy or _spectral_energy(self.energy)


@cache
def _derivative(energy: Any, by: str) -> Any:
    def formula(x: Any, *rest: Any) -> Any:
        return gradient([on_tensors(energy)(x, *rest)], x)

    return device_function(
        energy.fn.__name__.replace("energy", "stress"), {"a": _STRETCHED, "F": _STRAINED}[by], formula
    )


@cache
def _hessian(energy: Any) -> Any:
    def formula(a: Any, *rest: Any) -> Any:
        y = gradient([on_tensors(energy)(a, *rest)], a)
        rows = [gradient([slope], a) for slope in y]
        pairs = []
        for i, j in _PAIRS:
            swapped, step = list(a), [0.0] * 3
            swapped[i], swapped[j] = a[j], a[i]
            step[i], step[j] = 1.0, -1.0
            twist = (y[i] + y[j]) / on_tensors(_above)(a[i] + a[j])
            pairs.append((rows[i][j], twist, difference(y[i], a, swapped, step, a[i] - a[j])))
        return (tuple(rows[k][k] for k in range(3)), *pairs)

    made = device_function("hessian", _STRETCHED, formula)
    primitive(made, outputs=(3, 3, 3, 3))
    return made


@triton.jit
def _above(x):
    return tl.maximum(x, EPSILON)


@cache
def _spectral_moduli_of(energy: Any) -> Any:
    def formula(F: Any, *rest: Any) -> Any:
        own, first, _, _ = on_tensors(_hessian(energy), look_in=True)((1.0, 1.0, 1.0), *rest)
        bound = on_tensors(largest)(own[0] + 2.0 * first[0], own[0] - first[0])
        here = on_tensors(_hessian(energy))(on_tensors(svd3)(F)[1], *rest)
        return on_tensors(spectral_moduli)(*here, own[0], bound)

    return device_function("moduli", _STRAINED, formula)


@cache
def _spectral_energy(energy: Any) -> Any:
    return device_function("energy", _STRAINED, lambda F, *rest: on_tensors(energy)(on_tensors(svd3)(F)[1], *rest))


@cache
def _spectral_adjoint(energy: Any) -> Any:
    def formula(F: Any, mu: Any, lam: Any, internal: Any, p: Any, Q: Any) -> Any:
        u, a, v = on_tensors(svd3)(F)
        b = on_tensors(_to_principal)(u, Q, v)
        y = gradient([on_tensors(energy)(a, mu, lam, internal, p)], a)
        along, by_mu, by_lam = gradient(y, (a, mu, lam), (b[0], b[4], b[8]))
        _, *pairs = on_tensors(_hessian(energy))(a, mu, lam, internal, p)
        return on_tensors(spectral_change)(u, v, b, along, *pairs), by_mu, by_lam

    return device_function("adjoint", {**_STRAINED, "Q": 9}, formula)


@triton.jit
def _to_principal(u, Q, v):
    return matmul(matmul(transpose(u), Q), v)


@cache
def _adjoint_of(stress: Any) -> Any:
    return vjp(stress, _STRAINED, ("F", "mu", "lam"))


class ConstitutiveLaw(Fixed, nn.Module, ABC):
    """Base class of all laws.

    A law is a subclass with ``device``, its device functions, or, slower, with :meth:`energy`, :meth:`pk1` and
    :meth:`moduli` of tensors; a plastic law is a subclass of :class:`PlasticLaw`. Elastic stiffness belongs to the
    particles (Lamé parameters); all other parameters of a law are arguments of its constructor.

    Attributes:
        device: The device functions; None for a law of tensors. A subclass that overrides a method has none.
        plastic: Whether there is a return map. The deformation gradient is then only the elastic part of the
            deformation since rest, which needs the ``updated`` formulation.
        internal: Initial value of the one internal variable of each particle, or None if there is none.
        least_nu: Poisson's ratio below which the energy has no least value, and strongly deformed material runs away.
    """

    device: ClassVar[DeviceLaw | None] = None
    formulas: ClassVar[DeviceLaw | None] = None
    """``device`` of the class, or of the nearest base that has one: for the methods that are not overridden."""
    plastic: bool = False
    internal: float | None = None
    least_nu: float = -1.0

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = {"energy", "pk1", "kirchhoff", "moduli", "return_map", "flow"} & vars(cls).keys()
        if "device" in vars(cls):
            cls.formulas = cls.device
        elif own:
            cls.device = None

    @property
    def numbers(self) -> tuple[float, ...]:
        """The numbers ``p`` of the device functions, at most four."""
        return ()

    def _run(self, name: str, x: Any, mu: Any, lam: Any, internal: Any, *more: Any) -> Any:
        if self.formulas is None:
            raise NotImplementedError(f"{type(self).__name__} needs `device`, or energy, pk1 and moduli of tensors")
        if internal is None:
            internal = 0.0 if self.internal is None else self.internal
        return on_tensors(getattr(self.formulas, name))(x, mu, lam, internal, self.row, *more)

    @property
    def row(self) -> tuple[float, ...]:
        """:attr:`numbers`, padded with zeros.

        Raises:
            ValueError: If there are more than four.
        """
        values = tuple(float(value) for value in self.numbers)
        if len(values) > NUMBERS:
            raise ValueError(f"Expected at most four `numbers` of {type(self).__name__}, but got {len(values)}.")
        return values + (0.0,) * (NUMBERS - len(values))

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Elastic energy density [J/m³].

        Args:
            F: Elastic deformation gradient, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...); None for its initial value.

        Returns:
            Shape (...).
        """
        if self.formulas is not None and self.formulas.energy:
            return self._run("energy", spectrum(F).stretch.unbind(-1), mu, lam, internal)
        return self._run("strain_energy", entries(F), mu, lam, internal)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """First Piola-Kirchhoff stress [Pa], shape (..., 3, 3); arguments as :meth:`energy`."""
        if self.formulas is None or self.formulas.stress:
            return matrix(self._run("stress", entries(F), mu, lam, internal))

        def principal(a: Tensor) -> Tensor:
            return torch.stack(self._run("principal", a.unbind(-1), mu, lam, internal), -1)

        return from_principal(spectrum(F), principal, rotated=True)

    def kirchhoff(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Kirchhoff stress P F^T [Pa], symmetric, shape (..., 3, 3); arguments as :meth:`energy`."""
        return matmul3(self.pk1(F, mu, lam, internal), F.mT)

    def return_map(
        self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Elastic deformation gradient and internal variable after plastic flow.

        Args:
            F: Trial deformation gradient, as if the substep were elastic, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...), or None if the law has none.
            dt: Substep [s].

        Returns:
            Shapes (..., 3, 3) and (...) or None.
        """
        return F, internal

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        r"""Bounds on the elastic stiffness [Pa], for the time step, without gradient.

        Args:
            F: Elastic deformation gradient, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...); None for its initial value.

        Returns:
            ``wave``, not less than density times the square of any wave speed (against reference gradients), and
            ``bound``, not less than any eigenvalue of :math:`\partial^2 \Psi / \partial F^2`; shape (...). Neither
            falls below its value at rest: lambda + 2 mu and 3 lambda + 2 mu in a solid, K and 3 K in a fluid.
        """
        with torch.no_grad():
            wave, bound = self._run("bounds", entries(F.detach()), mu, lam, internal)
        return wave, bound


class PlasticLaw(ConstitutiveLaw):
    """A law whose return map acts on the principal stretches and keeps the principal axes."""

    plastic = True

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """New principal stretches (..., 3) and internal variable (...) from trial ones."""
        new, after = self._run("flow", stretch.unbind(-1), mu, lam, internal, dt)
        return torch.stack(new, -1), None if internal is None else after

    def return_map(
        self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """The return map on principal stretches; the rotation and axes of the trial are kept."""
        if internal is None and self.internal is not None:
            internal = torch.full_like(mu, self.internal)
        parts = spectrum(F)
        values, new = self.flow(parts.stretch, mu, lam, internal, dt)
        F = from_principal(parts, lambda a: self.flow(a, mu, lam, internal, dt)[0], values, rotated=True)
        return F, new
