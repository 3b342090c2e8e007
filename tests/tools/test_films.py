"""The moving picture of the README."""

import numpy as np
import pytest
from bench import films
from imageio.v3 import imwrite
from PIL import Image


def _run(folder, colour, shape=(40, 60, 3), frames=4):
    (folder / "frames").mkdir(parents=True)
    for number in range(frames):
        picture = np.zeros(shape, np.uint8)
        picture[:, 20 : shape[1] - 20] = colour  # the middle, which a square panel keeps
        picture[number] = 255
        imwrite(folder / "frames" / f"{number:05d}.png", picture)
    return folder


def test_runs_side_by_side(tmp_path):
    runs = [_run(tmp_path / "a", (200, 0, 0)), _run(tmp_path / "b", (0, 0, 200), (60, 40, 3))]
    films.film(runs, tmp_path / "film.webp", range(0, 4, 2), (16, 16), 80, quality=90)
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.size, film.n_frames, film.info["loop"]) == ((32, 16), 2, 0)
        film.seek(1)
        film.load()
        assert film.info["duration"] == 80
        pixels = np.asarray(film.convert("RGB")).astype(int)
    assert pixels[12, 8, 0] > 150 > 60 > pixels[12, 8, 2]


def test_a_missing_frame_is_named(tmp_path):
    run = _run(tmp_path / "a", (0, 200, 0), frames=2)
    with pytest.raises(ValueError, match=r"00002\.png is missing: choose --frames_shown"):
        films.film([run], tmp_path / "film.webp", range(3), (8, 8), 40)
    assert not (tmp_path / "film.webp").exists()
