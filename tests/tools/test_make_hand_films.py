"""Films from a hand: cloth with its held edges, the room in Blender and as a splat, cameras, files, and starts."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from gaussian_swaying import Simulation
from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.videos import read_videos

from .conftest import beside

TOOL = "make_hand_films"
cases = beside("fit_cases")
motions = beside("flag_motion")


def _moved(tool, motions, name, folder, frames):
    pattern = replace(tool.CLOTHS[name], cells=10, fps=tool.FPS, frames=frames)
    grid = pattern.grid()
    rest = pattern.rest(grid.uv())[0]
    way = np.linspace(0, 0.02 * (frames - 1), frames)[:, None, None] * np.array([0.0, 1.0, 0.0])
    settings = json.dumps({"cells": 10})
    parts = {"faces": grid.faces(), "uv": grid.uv(), "columns": grid.columns, "rows": grid.rows, "settings": settings}
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "cloth.npz", positions=(rest + way).astype(np.float32), **parts)
    return pattern


@pytest.mark.parametrize("name", ["curtain", "banner", "pole_flag"])
def test_a_row_of_gaussians_lies_on_each_held_edge(tool, name):
    pattern = tool.CLOTHS[name]
    means = tool.cloth_cloud(pattern, 0.05).means
    x, z = means[:, 0], means[:, 2]
    ends = {"left": (x.min(), 0.0), "top": (z.max(), pattern.height), "sides": (x.min() - x.max(), -pattern.width)}
    found, line = ends[pattern.pinned]
    assert float(found) == pytest.approx(line, abs=1e-6)
    free = {"left": pattern.width - x.max(), "top": z.min(), "sides": z.min()}[pattern.pinned]
    assert 0.02 < free < 0.03  # half a patch


def test_films_that_begin_before_and_into_the_motion(tool, cases, motions, tmp_path):
    import imageio.v3 as iio

    pictures = 30
    pattern = _moved(tool, motions, "banner", tmp_path, pictures - tool.SHIFT)
    video = cases.FitVideo(1, (64, 112), 33.0, read_noise=0.0, shot_noise=0.0)
    thing = replace(tool.filmed_cloth(pattern, tmp_path, video, 0.05, 0.2), spacing=0.2)
    view = tool.aimed(thing, video)
    views = tool.in_hand(thing, view, pictures, 0)
    turns = [math.degrees(math.acos(min(1.0, (np.trace(v.pose[:3, :3].T @ view.pose[:3, :3]) - 1) / 2))) for v in views]
    assert 0.3 < np.sqrt(np.mean(np.square(turns))) < 2.0
    (tmp_path / "pictures").mkdir()
    for k in range(pictures):
        iio.imwrite(tmp_path / f"pictures/{k:04d}.png", np.full((112, 64, 3), 4 * k + 40, np.uint8))
    for name, start, first in (("still", 0.2, 0), ("moving", -0.2, 12)):
        folder = tmp_path / name
        tool.write_film(thing, tmp_path, folder, video, view, views)
        truth = json.loads((folder / "truth.json").read_text())
        assert truth["start"] == pytest.approx(start)
        assert len(truth["cameras"]) == 18
        np.testing.assert_allclose(truth["cameras"][0], views[first].pose)
        (film,) = read_videos(folder)
        assert len(film.times) == 18
        assert float(film.images[0].float().mean()) == pytest.approx(4 * first + 40, abs=2)
        plan = read_plan(folder / "fit.yaml")
        starts = {u.name: u.start for u in plan.unknowns}
        ratio = 3.0 if start < 0 else 1 / 3
        assert starts["wind.speed"] == pytest.approx(truth["speed"] * ratio, rel=1e-3)
        assert starts["material.E"] == pytest.approx(truth["E"] / ratio, rel=1e-3)
        assert abs(starts["wind.azimuth"] - truth["azimuth"]) == pytest.approx(60, abs=0.01)
        scene = yaml.safe_load((folder / "scene.yaml").read_text())
        assert np.linalg.norm(np.subtract(scene["wind"]["flow"], truth["flow"])) > 0.3 * truth["speed"]
        simulation = Simulation.from_yaml(folder / "scene.yaml", camera=None, device="cpu")
        assert len(torch.zeros(len(simulation.scene.rest().means))[simulation.scene.moving]) == len(thing.cloud)
        pins = simulation.solver.boundaries
        assert len(pins) == 2
        held = sum(int(pin.region.contains(thing.cloud.means).sum()) for pin in pins)
        assert held == 2 * round(pattern.height / 0.05)
