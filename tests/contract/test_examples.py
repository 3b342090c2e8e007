"""The short examples, at a small size."""

import importlib.util
from pathlib import Path

import imageio.v3 as iio
import pytest

FOLDER = Path(__file__).parents[2] / "examples"


LONGER = {"fit_flag", "mass_spring_cloth"}
"""Two that docs/examples.md lists apart."""


def test_there_are_ten_of_fewer_than_eighty_lines():
    short = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in FOLDER.glob("*.py")}
    for name in LONGER:
        del short[FOLDER / f"{name}.py"]
    assert len(short) == 10
    assert {path.name: lines for path, lines in short.items() if lines >= 80} == {}


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


def test_a_splat_is_previewed_and_its_starter_runs(tmp_path):
    moved = load("own_splat").main(tmp_path / "own", frames=6, spacing=0.06)
    assert 0 < moved < 1
    assert {path.name for path in (tmp_path / "own").iterdir()} >= {"preview.png", "starter.yaml"}
    assert (tmp_path / "own" / "run" / "video.mp4").stat().st_size > 1000


def test_parts_of_a_plant_move_by_their_role_and_material(tmp_path):
    found = load("plant_with_parts").main(tmp_path, frames=12, spacing=0.06, dx=0.12)
    assert found["floor"] == 0
    assert found["pot"] < 1e-5 < found["wood"] < found["leaf"]
    assert (tmp_path / "plant.png").exists()


def test_the_wind_moves_the_cloth_of_another_code():
    """It hangs in the wind as a plate does: all loads are alike along it, so that it stays straight."""
    found, exact = load("wind_on_own_cloth").main(side=8, seconds=3.0)
    assert found == pytest.approx(exact, rel=0.03)


def test_a_sweep_becomes_batches(tmp_path):
    rows = load("sweep_to_dataset").main(tmp_path / "flags", frames=8, speeds=1, workers=1)
    assert [wind for wind, _ in rows] == [[1.5, -0.5, 0.0], [1.5, 0.0, 0.0], [1.5, 0.5, 0.0]]
    assert rows[0][1] < rows[1][1] < rows[2][1]


def test_a_live_page_is_one_file(tmp_path):
    assert load("live_page").main(tmp_path / "flag.html", spacing=0.06) > 100_000
    text = (tmp_path / "flag.html").read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert "http" + "://" not in text.split("<script")[0]  # it asks no other site for anything
