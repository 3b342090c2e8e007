"""The longest substep that a page takes where it falls behind, from the fastest vibration of the scene at rest."""

from __future__ import annotations

import numpy as np
import torch

from gaussian_swaying.mpm.timestep import wave_speed
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.mpm.transfer import gather, scatter

MARGIN = 0.8
"""Share of the largest stable substep at rest; the rest is for the deformed scene."""


def longest_courant(bound: Total) -> float:
    """Courant number of :data:`MARGIN` times the largest stable substep at rest, without pins.

    Pins only lower frequencies.
    """
    cells = float(wave_speed(bound.points).max()) / bound.settings.dx
    fastest = (fastest_vibration(bound) ** 2 + float(bound.bending_rate)) ** 0.5
    return MARGIN * 2 / fastest * bound.with_bending(cells)


def fastest_vibration(bound: Total) -> float:
    """The largest angular frequency of a scene at rest [rad/s].

    Its square is the largest eigenvalue of M⁻¹ K, with lumped masses M and the stiffness K of linear elasticity, which
    all laws have at rest (Lanczos' method, within 1 %).
    """
    from scipy.sparse.linalg import LinearOperator, eigsh

    points, laws = bound.points, bound.laws
    root = bound.node_inverse_mass.double().sqrt()[:, None]
    kind = points.volume.dtype
    mu, lam, volume = (field[:, None, None] for field in (laws.mu, laws.lam, points.volume))
    one = torch.eye(3, dtype=kind)

    @torch.inference_mode()
    def stiffness(scaled: np.ndarray) -> np.ndarray:
        moved = torch.from_numpy(np.array(scaled, dtype=np.float64)).reshape(-1, 3) * root
        gradient = gather(moved.to(kind), bound.stencil)[:, 1:4].mT
        strain = gradient + gradient.mT
        stress = volume * (mu * strain + 0.5 * lam * strain.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * one)
        force = scatter(bound.stencil, torch.nn.functional.pad(stress.mT, (0, 0, 1, 0)))
        return (root * force.double()).flatten().numpy()

    size = 3 * len(root)
    operator = LinearOperator((size, size), matvec=stiffness, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    largest = eigsh(operator, k=1, which="LA", tol=1e-2, v0=start, return_eigenvectors=False)
    return float(largest[0]) ** 0.5
