r"""Friction angles that the Drucker-Prager law mobilises in three tests of one element.

The angle for a friction angle of 30 degrees depends on the test. The cone touches the Mohr-Coulomb pyramid only in
triaxial compression. There the law mobilises 30.0 degrees, in steady simple shear 34.6 and in plane strain 43.9. So a
layer on an incline is stable up to 34.6 degrees, and a planar column is stronger than real sand of 30 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from bench.problems.granular.shared import POISSON
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw, lame_parameters


def _steady(law: ConstitutiveLaw, gradient: Sequence[Sequence[float]], steps: int, pressure: float) -> Tensor:
    """Kirchhoff stress over E, shape (3, 3), after ``steps`` increments of a velocity gradient that keeps the volume.

    ``pressure`` is that at the start, over Young's modulus.
    """
    mu, lam = lame_parameters(torch.ones(1, dtype=torch.float64), torch.full((1,), POISSON, dtype=torch.float64))
    increment = torch.linalg.matrix_exp(torch.tensor(gradient, dtype=torch.float64))
    strain = -pressure * (1 - 2 * POISSON)
    F = math.exp(strain) * torch.eye(3, dtype=torch.float64)[None]
    internal = None if law.internal is None else torch.full_like(mu, law.internal)
    for _ in range(steps):
        F, internal = law.return_map(increment @ F, mu, lam, internal, 1.0)
    return law.kirchhoff(F, mu, lam, internal)[0]


def shear_angle(law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3) -> float:
    r"""Angle :math:`\arctan(\tau / \sigma_n)` in steady simple shear at constant volume [degrees].

    With Klar's return map the flow is coaxial and deviatoric, so in the steady state
    :math:`\tan = 6 \sin\phi / (\sqrt3 (3 - \sin\phi))`: 34.7 degrees for phi = 30.

    ``pressure`` is the confining one, over Young's modulus.
    """
    stress = _steady(law, [[0, 0, increment], [0, 0, 0], [0, 0, 0]], steps, pressure)
    return math.degrees(math.atan2(float(stress[0, 2].abs()), -float(stress[2, 2])))


def _mobilised(stress: Tensor) -> float:
    """Mohr-Coulomb angle of a stress [degrees]."""
    values = torch.linalg.eigvalsh(stress)
    return math.degrees(math.asin(float((values[2] - values[0]) / -(values[2] + values[0]))))


def triaxial_angle(law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3) -> float:
    r"""Angle :math:`\arcsin((\sigma_1 - \sigma_3) / (\sigma_1 + \sigma_3))` in triaxial compression [degrees].

    The volume is kept. The cone is fitted to phi here.
    """
    half = increment / 2
    return _mobilised(_steady(law, [[half, 0, 0], [0, half, 0], [0, 0, -increment]], steps, pressure))


def plane_strain_angle(
    law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3
) -> float:
    """The same angle in plane strain [degrees]: 43.9 for phi = 30. Arguments as :func:`shear_angle`."""
    return _mobilised(_steady(law, [[increment, 0, 0], [0, 0, 0], [0, 0, -increment]], steps, pressure))
