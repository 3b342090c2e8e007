import dataclasses

import pytest
import torch
import yaml
from shared import merged
from small_scenes import together

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Simulation

FRAMES = 6

SETTINGS = {
    "background": [0.55, 0.68, 0.8],
    "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.05}}, "max_stretch": None},
    "material": {"E": 9e3, "nu": 0.3, "density": 30.0, "thickness": 0.01},
    "solver": {
        "formulation": "total",
        "dx": 0.1,
        "boundaries": [
            {
                "class_path": "PinnedRegion",
                "init_args": {
                    "region": {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.1, None, None]}}
                },
            }
        ],
    },
    "wind": {"flow": [6.0, 3.0, 0.0]},
    "shader": {
        "class_path": "DiffuseShader",
        "init_args": {"light": [-0.3, -1.0, 0.6], "two_sided": True, "ambient": 0.3},
    },
    "camera": {
        "class_path": "OrbitCamera",
        "init_args": {"width": 320, "height": 180, "azimuth": -70.0, "elevation": 8.0, "radius": 1.5},
    },
    "recorder": {"video": False, "checkpoint_every": 1},
}


@pytest.fixture(scope="session")
def make_flag(tmp_path_factory):
    def make(**changes):
        path = tmp_path_factory.mktemp("flag") / "flag.yaml"
        path.write_text(yaml.safe_dump(merged(SETTINGS, changes)))
        return Simulation.from_yaml(path, device="cpu")

    return make


@pytest.fixture(scope="session")
def flags(tmp_path_factory):
    flag = FlagScene(spacing=0.05).generate()
    path = tmp_path_factory.mktemp("flags") / "flags.ply"
    places = [flag.means + torch.tensor([0.0, y, 0.0]) for y in (-0.045, 0.04)]
    write_ply(path, together(*(dataclasses.replace(flag, means=place) for place in places)))
    return {"generator": None, "ply": str(path), "connected": "surface", "metres_per_unit": 1.0}


@pytest.fixture(scope="session")
def run(make_flag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "flag"
    make_flag().run(folder, FRAMES, progress=False)
    return folder
