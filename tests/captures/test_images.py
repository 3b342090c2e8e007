import os

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image
from shared import value_error

from gaussian_swaying.captures.images import image_size, load_image, read_image, straight_colors
from gaussian_swaying.captures.lens import Lens


def _plain(width, height, distortion=(0.0,) * 5):
    return Lens(30.0, 30.0, 0.5 * width, 0.5 * height, width, height, distortion)


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (6, 9, 4), dtype=np.uint8)


def test_colour_and_alpha_come_back(tmp_path, pixels):
    iio.imwrite(tmp_path / "rgb.png", pixels[..., :3])
    iio.imwrite(tmp_path / "rgba.png", pixels)
    opaque = pixels.copy()
    opaque[..., 3] = 255
    iio.imwrite(tmp_path / "opaque.png", opaque)
    assert torch.equal(read_image(tmp_path / "rgb.png"), torch.from_numpy(pixels[..., :3]))
    assert torch.equal(read_image(tmp_path / "rgba.png"), torch.from_numpy(pixels))
    assert torch.equal(read_image(tmp_path / "opaque.png"), torch.from_numpy(pixels[..., :3]))
    assert image_size(tmp_path / "rgb.png") == (9, 6)


def test_grey_deep_palette_and_cmyk_images_become_rgb(tmp_path, pixels):
    grey = pixels[..., 0]
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png")
    for name in ("grey.png", "deep.png", "palette.png"):
        assert torch.equal(read_image(tmp_path / name), torch.from_numpy(np.stack([grey] * 3, -1))), name
    flat = Image.new("RGB", (16, 8), (200, 100, 50))
    flat.convert("CMYK").save(tmp_path / "print.jpg", quality=95)
    read = read_image(tmp_path / "print.jpg")
    assert read.shape == (8, 16, 3)
    assert read.float().mean((0, 1)).tolist() == pytest.approx([200, 100, 50], abs=4)


def test_averaging_multiplies_with_alpha_first(tmp_path):
    """One opaque white pixel among three transparent red ones is a quarter of white, not pink."""
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[..., 0] = 255
    image[0, 0] = 255
    iio.imwrite(tmp_path / "a.png", image)
    loaded = load_image(tmp_path / "a.png", _plain(2, 2), 2)
    assert loaded.tolist() == [[[64, 64, 64, 64]]]
    colors, alpha = straight_colors(loaded)
    assert colors.tolist() == [[[1.0, 1.0, 1.0]]]
    assert float(alpha) == pytest.approx(0.25, abs=0.002)
    assert straight_colors(torch.zeros(1, 1, 4, dtype=torch.uint8))[0].tolist() == [[[0.0, 0.0, 0.0]]]


def test_averaging_is_the_mean_over_squares(tmp_path, pixels):
    iio.imwrite(tmp_path / "a.png", pixels[..., :3])
    loaded = load_image(tmp_path / "a.png", _plain(9, 6), 2)
    expected = pixels[:6, :8, :3].reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(loaded.numpy(), expected, atol=0.5)
    assert loaded.shape == (3, 4, 3)


def test_an_undistorted_image_has_the_size_of_its_lens(tmp_path, pixels):
    iio.imwrite(tmp_path / "a.png", pixels)
    lens = _plain(9, 6, (0.5, 0.0, 0.0, 0.0, 0.0))
    seen = lens.undistorted()
    assert (seen.width, seen.height) != (9, 6)
    assert load_image(tmp_path / "a.png", lens).shape == (seen.height, seen.width, 4)


def test_bad_images_are_named(tmp_path, pixels):
    with value_error(r"none\.png does not exist"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("not a picture")
    for function in (read_image, image_size):
        with value_error(r"text\.png cannot be read.*copy it again"):
            function(tmp_path / "text.png")
    iio.imwrite(tmp_path / "cut.png", np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8))
    data = (tmp_path / "cut.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    with value_error(r"cut\.png cannot be read"):
        read_image(tmp_path / "cut.png")
    iio.imwrite(tmp_path / "a.png", pixels)
    with value_error(r"a\.png has 9 x 6 pixels, but its camera has 8 x 6"):
        load_image(tmp_path / "a.png", _plain(8, 6))
    Image.fromarray(np.zeros((4, 4), dtype=np.float32)).save(tmp_path / "float.tiff")
    with value_error(r"float\.tiff has floating-point numbers"):
        read_image(tmp_path / "float.tiff")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="makes a named pipe")
def test_a_pipe_keeps_nobody_waiting(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    for read in (image_size, read_image):
        with value_error(r"a\.png is not a regular file"):
            read(tmp_path / "a.png")
