"""The picture of a comparison, pixel by pixel."""

import numpy as np
import torch

from gaussian_swaying.evaluation.comparison_picture import comparison_picture
from gaussian_swaying.rendering.colormap import colormap


def test_the_picture_shows_reference_run_and_error():
    reference, image = torch.zeros(60, 80, 3), torch.full((60, 80, 3), 0.2)
    reference[:30] = 0.2
    whole = comparison_picture(reference, image, error_scale=0.2)
    band = whole.shape[0] - 60
    assert whole.shape == (60 + band, 3 * 80 + 4, 3)
    left, middle, right = (whole[band:, start : start + 80] for start in (0, 82, 164))
    assert np.array_equal(left, (reference * 255 + 0.5).byte().numpy())
    assert np.array_equal(middle, (image * 255 + 0.5).byte().numpy())
    none, full = (colormap(torch.tensor(v)).mul(255).add(0.5).byte().numpy() for v in (0.0, 1.0))
    assert (right[:30] == none).all()
    assert (right[30:] == full).all()
    assert whole[:band].std() > 10  # there are labels


def test_large_pictures_are_made_smaller():
    whole = comparison_picture(torch.rand(60, 200, 3), torch.rand(60, 200, 3), panel_width=100)
    assert whole.shape[1] == 3 * 100 + 4
    assert whole.shape[0] - 30 in range(16, 20)
