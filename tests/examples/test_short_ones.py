"""The short examples, at a small size."""

import importlib.util
from pathlib import Path

import imageio.v3 as iio
import pytest

FOLDER = Path(__file__).parents[2] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_first_flag_moves_and_is_drawn(tmp_path):
    moved = load("first_flag").main(tmp_path / "pictures", frames=13, spacing=0.1, device="cpu")
    assert 0.01 < moved < 1
    first, last = (iio.imread(path).astype(float) for path in sorted((tmp_path / "pictures").iterdir()))
    assert first.min() < 200  # something is drawn on the white ground
    assert abs(last - first).max() > 50


def test_each_wind_of_a_batch_moves_its_own_sheet():
    calm, weak, strong = load("winds_together").main([0.0, 1.0, 2.0], seconds=0.3, side=8)
    assert calm == 0
    assert 0 < weak < strong


def test_the_wind_is_found_by_its_gradient():
    assert load("wind_by_gradient").main(true=2.0, first=1.0, rounds=6, side=4, steps=15) == pytest.approx(2, rel=1e-3)
