import numpy as np
import torch

from gaussian_swaying.evaluation.comparison_picture import ERROR_SCALE, PANEL_WIDTH, comparison_picture
from gaussian_swaying.rendering.passes import colormap


def test_the_picture_shows_reference_run_and_error():
    reference, image = torch.zeros(60, 80, 3), torch.full((60, 80, 3), ERROR_SCALE)
    reference[:30] = ERROR_SCALE
    whole = comparison_picture(reference, image)
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
    width = PANEL_WIDTH * 3 // 2  # twice too large, as it is averaged by whole numbers
    whole = comparison_picture(torch.rand(60, width, 3), torch.rand(60, width, 3))
    assert whole.shape[1] == 3 * (width // 2) + 4
    assert whole.shape[0] - 30 in range(16, 20)
