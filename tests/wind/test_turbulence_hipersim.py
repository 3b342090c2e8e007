"""Turbulence against hipersim's, which was written by others; skipped where it is not installed."""

import math

import pytest
import torch

from gaussian_swaying.wind.turbulence import VON_KARMAN, turbulence_box

mann = pytest.importorskip("hipersim.mann_turbulence", reason="needs hipersim")

L, SEEDS = 1.0, 20


def _theirs(cells, spacing, gamma, seed):
    """A box of unit variance without shear: alpha epsilon^(2/3) is that of von Karman's spectrum."""
    a = VON_KARMAN * L
    level = 55 / (9 * math.sqrt(math.pi)) * math.gamma(5 / 6) / math.gamma(1 / 3) * a ** (-2 / 3)
    box = mann.MannTurbulenceField.generate(
        alphaepsilon=level, L=a, Gamma=gamma, Nxyz=cells, dxyz=(spacing,) * 3, seed=seed, double_xyz=(False,) * 3
    )
    return torch.tensor(box.uvw).permute(1, 2, 3, 0).double()


def _measures(box):
    """Variances, spectra in three bands, and coherence at two distances in two bands, of the component along x."""
    wave = torch.fft.rfft(box, dim=0)
    power = wave.abs().square().mean((1, 2))
    bands = ((1, 3), (3, 8), (8, 20))
    spectra = torch.stack([power[a:b].mean(0) for a, b in bands])
    u = wave[..., 0]
    cross = [(u * u.roll(-j, 1).conj()).real.mean((1, 2)) for j in (2, 4)]
    return box.square().mean((0, 1, 2)), spectra, torch.stack([c[a:b].mean() for c in cross for a, b in bands[:2]])


@pytest.mark.parametrize(("gamma", "cells", "spacing"), [(0.0, (128, 32, 32), 0.25), (3.9, (128, 64, 64), 0.5)])
def test_statistics_are_those_of_hipersim(gamma, cells, spacing):
    """The first band of the spectrum has two waves, so its scatter is larger, and it gets no verdict.

    With shear, hipersim averages the spectrum over the cells of the longest waves, and we take their middle: the box is
    32 lengths wide, so that this makes no difference.
    """
    # the limit of its tensor for no shear is a division by zero
    theirs = [_measures(_theirs(cells, spacing, max(gamma, 1e-3), seed)) for seed in range(1, SEEDS + 1)]
    boxes = (turbulence_box(cells, [spacing] * 3, L, gamma=gamma, seed=seed) for seed in range(SEEDS))
    ours = [_measures(box.double()) for box in boxes]
    for kind in (0, 1):
        a, b = (torch.stack([one[kind] for one in several]).mean(0) for several in (ours, theirs))
        ratio = a / b if kind == 0 else (a / b)[1:]
        assert ratio.flatten().tolist() == pytest.approx([1.0] * ratio.numel(), abs=0.1)
    a, b = (
        torch.stack([one[2] for one in several]).mean(0)
        / torch.stack([one[1] for one in several]).mean(0)[[0, 1, 0, 1], 0]
        for several in (ours, theirs)
    )
    for one, other in zip(a.tolist(), b.tolist(), strict=True):
        assert one == pytest.approx(other, rel=0.1) if other > 0.2 else one == pytest.approx(other, abs=0.02)
