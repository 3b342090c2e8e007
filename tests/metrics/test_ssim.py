import torch
from shared import rand, value_error
from torch.testing import assert_close
from torchmetrics.functional.image import structural_similarity_index_measure

from gaussian_swaying.metrics.ssim import ssim_map


def _pictures():
    x = rand(24, 31, 3)
    return x, (x + 0.2 * torch.randn_like(x)).clamp(0, 1)


def test_ssim_equals_torchmetrics(device):
    x, y = (picture.to(device) for picture in _pictures())
    planes = [picture.movedim(-1, 0)[None] for picture in (x, y)]
    mean, full = structural_similarity_index_measure(*planes, data_range=1.0, return_full_image=True)
    assert_close(ssim_map(x, y, "reflect").mean(), mean, rtol=1e-7, atol=1e-9)
    result = ssim_map(x, y)
    assert result.shape == (14, 21, 3)
    assert_close(result, full[0, :, 5:-5, 5:-5].movedim(0, -1), rtol=1e-7, atol=1e-9)


def test_ssim_of_equal_pictures_is_one_and_padding_keeps_the_size():
    x, y = _pictures()
    assert_close(ssim_map(x, x), torch.ones(14, 21, 3).double())
    padded = ssim_map(x, y, "reflect")
    assert padded.shape == x.shape
    assert_close(padded[5:-5, 5:-5], ssim_map(x, y))
    batch = ssim_map(torch.stack([x, y]), torch.stack([y, y]))
    assert_close(batch, torch.stack([ssim_map(x, y), ssim_map(y, y)]))


def test_ssim_refuses():
    x, y = _pictures()
    with value_error(r"at least 11 x 11 pixels, but got 31 x 10"):
        ssim_map(x[:10], y[:10])
