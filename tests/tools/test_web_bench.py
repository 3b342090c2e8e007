"""``bench.py web`` measures films in a browser."""

import pytest
import yaml
from bench.cases import web

from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import write_film

from .conftest import shown


@pytest.mark.usefixtures("chromium")
def test_size_error_and_speed_of_a_film(tmp_path):
    scene = {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1}}}
    settings = {"scene": scene, "solver": {"dx": 0.2}, "recorder": {"images": False, "video": False}}
    (tmp_path / "flag.yaml").write_text(yaml.safe_dump(settings))
    Simulation.from_yaml(tmp_path / "flag.yaml").run(tmp_path / "run", 4, progress=False)
    row = web.film_of(tmp_path / "run", 1.0)
    assert row["frames"] == 4
    assert row["gaussians"] == 96
    assert 0 < row["error"] < 1e-3
    assert row["pictures_per_s"] > 0
    write_film(tmp_path / "run", tmp_path / "film.html")
    assert row["bytes"] == (tmp_path / "film.html").stat().st_size
    table = shown(
        "web.films", {"films": {row["title"]: row}, "device": "a CPU", "versions": {"torch": "2", "gsplat": "1"}}
    )
    assert any(line.startswith("| Flag in the wind | 96 | ") for line in table)
