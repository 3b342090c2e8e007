"""A small printed flag in the wind, and videos of it, as a fixture of conftest.py."""

import pytest
import yaml
from shared import merged

from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.simulation.simulation import Simulation

TRUTH = {"wind.speed": 5.0, "wind.azimuth": 36.869898, "material.E": 1e4}
FRAMES = 13


def base(**changes):
    """Settings of the flag: 48 Gaussians."""
    pole = {"class_path": "PinnedRegion", "init_args": {"kind": None, "region": _box(0.06)}}
    flag = {"width": 0.4, "height": 0.3, "spacing": 0.05, "ripple": 0.01, "pattern": "printed"}
    settings = {
        "frames": FRAMES,
        "frame_dt": 1 / 24,
        "scene": {"generator": {"class_path": "FlagScene", "init_args": flag}, "metres_per_unit": 1.0},
        "material": {"E": 1e4, "nu": 0.3, "density": 25.0, "thickness": 0.01},
        "solver": {"dx": 0.1, "boundaries": [pole]},
        "wind": {"flow": [4.0, 3.0, 0.0]},
        "aero": {"C_D": 0.1, "C_F": 0.3, "C_L": 0.005},
    }
    return merged(settings, changes)


def _box(x):
    return {"class_path": "Box", "init_args": {"min": [None, None, None], "max": [x, None, None]}}


def changed(folder, **changes):
    (folder / "made.yaml").write_text(yaml.safe_dump(base(**changes)))
    return Simulation.from_yaml(folder / "made.yaml", device="cpu")


def cameras(width=200, height=120):
    return {
        "left": look_at_camera((0.0, -0.8, 0.3), (0.2, 0.05, 0.12), (0, 0, 1), 38.0, width, height),
        "right": look_at_camera((0.65, -0.65, 0.25), (0.2, 0.05, 0.12), (0, 0, 1), 38.0, width, height),
    }


@pytest.fixture(scope="session")
def own(tmp_path_factory):
    from bench.problems.films import write_video  # takes long to import

    folder = tmp_path_factory.mktemp("own")
    (folder / "base.yaml").write_text(yaml.safe_dump(base()))
    simulation = Simulation.from_yaml(folder / "base.yaml", device="cpu")
    write_video(simulation, folder / "video", cameras(), FRAMES, noise=2.0)
    return folder
