"""Numbers as colours."""

import torch

from gaussian_swaying.rendering.passes import colormap


def test_the_ramp_gets_lighter():
    lightness = colormap(torch.linspace(0, 1, 50)) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (lightness.diff() > 0).all()
