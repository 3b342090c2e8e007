"""The add-on for Blender: its reader of .sway files, and the whole where Blender is installed."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from gaussian_swaying.cli.simulate import main as simulate
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.player.film.page import read_bundle, write_film

ADDON = Path(__file__).parents[2] / "tools/blender/sway_addon.py"


@pytest.fixture(scope="module")
def sway(tmp_path_factory):
    """A film of a flag with its pole, and the configuration that it was made of."""
    folder = tmp_path_factory.mktemp("sway")
    (folder / "flag.yaml").write_text(
        "scene:\n  generator: {class_path: FlagScene, init_args: {spacing: 0.08, stand: pole}}\n"
        "  region: {class_path: Box, init_args: {min: [0, -0.005, 0], max: [null, 0.005, 0.8]}}\n"
        "solver: {dx: 0.16, boundaries: [{class_path: PinnedRegion, init_args: {region: {class_path: Box, "
        "init_args: {min: [null, null, null], max: [0.1, null, null]}}}}]}\n"
        "wind: {flow: [4, 2, 0]}\nframes: 6\ndevice: cpu\nrecorder: {renders: []}\n"
    )
    assert simulate(["--config", str(folder / "flag.yaml"), "--output", str(folder / "run")]) == 0
    write_film(folder / "run", folder / "flag.sway")
    return folder / "flag.sway"


@pytest.fixture
def addon(monkeypatch):
    """The add-on as a module, with what it imports of Blender left empty."""
    bpy = ModuleType("bpy")
    bpy.types, bpy.props = (
        SimpleNamespace(Operator=type("Operator", (), {})),
        SimpleNamespace(StringProperty=lambda **_: None),
    )
    helper = type("ImportHelper", (), {})
    empty = {
        "bpy": bpy,
        "bpy.app": SimpleNamespace(),
        "bpy.app.handlers": SimpleNamespace(persistent=lambda function: function),
        "bpy_extras.io_utils": SimpleNamespace(ImportHelper=helper),
        "bpy_extras": SimpleNamespace(),
        "mathutils": SimpleNamespace(Vector=tuple),
    }
    for name, module in empty.items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("sway_addon", ADDON)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_its_reader_is_that_of_the_package(addon, sway):
    film, wanted = addon.Film(sway), read_bundle(sway)
    metre = wanted.head["metre"]
    for frame in (0, 5):
        centre, shape = film.moved(frame)
        known = [part.numpy() for part in wanted.moved(frame)]
        assert np.abs(centre - known[0] / metre).max() < 1e-7
        assert np.abs(shape - known[1] / metre**2).max() < 1e-7 * np.abs(shape).max()
    assert np.allclose(film.moved(2.5)[0], 0.5 * (film.moved(2)[0] + film.moved(3)[0]))
    assert np.array_equal(film.moved(99)[0], film.moved(5)[0])
    with pytest.raises(ValueError, match=r"no \.sway file of version 1"):
        addon.Film(ADDON)


def test_quaternions_of_all_turns(addon):
    quats = np.concatenate([np.random.default_rng(0).normal(size=(200, 4)), np.eye(4), [[0, 1, 1, 0], [0, 0, 1, -1]]])
    matrix = addon.rotations(quats)
    found = addon.quaternions(matrix)
    assert np.abs(addon.rotations(found) - matrix).max() < 1e-12


IN_BLENDER = """
import json, sys
sys.path.insert(0, sys.argv[1])
import bpy, numpy as np, sway_addon
bpy.ops.wm.read_factory_settings(use_empty=True)
sway_addon.register()
bpy.ops.import_scene.sway(filepath=sys.argv[2])
scene, cloud = bpy.context.scene, bpy.data.pointclouds[0]
scene.render.fps = 25
found = []
for frame in (1, 6):
    scene.frame_set(frame)
    kinds = {"position": ("vector", 3), "rotation": ("value", 4), "scale": ("vector", 3), "color": ("color", 4)}
    rows = {}
    for name, (field, width) in kinds.items():
        numbers = np.zeros(len(cloud.points) * width, np.float32)
        cloud.attributes[name].data.foreach_get(field, numbers)
        rows[name] = numbers.reshape(-1, width).tolist()
    found.append(rows)
bpy.ops.object.sway_wind()
wind, scene.frame_end = bpy.data.objects["wind"], 6
for frame, speed in ((1, 2.0), (6, 7.0)):
    wind["wind"] = speed
    wind.keyframe_insert('["wind"]', frame=frame)
keys = sway_addon.wind_keys(scene, wind)
sway_addon.unregister()
print(json.dumps({"frames": found, "keys": keys}))
"""


def test_in_blender_the_points_follow_and_the_wind_is_keyed(sway):
    pytest.importorskip("bpy")
    command = [sys.executable, "-c", IN_BLENDER, str(ADDON.parent), str(sway)]
    said = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
    wanted = read_bundle(sway)
    for frame, rows in zip((0, 5), said["frames"], strict=True):
        centre, shape = (part / wanted.head["metre"] ** k for k, part in enumerate(wanted.moved(frame), 1))
        place, quats, sizes = (torch.tensor(rows[name]).double() for name in ("position", "rotation", "scale"))
        assert (place - centre).abs().max() < 1e-6
        assert (covariance(quats, sizes.log()) - shape).abs().max() < 1e-5 * shape.abs().max()
    first, last = said["keys"][0], said["keys"][-1]
    assert first["flow"] == pytest.approx([2.0, 0.0, 0.0], abs=1e-4)
    assert (last["time"], last["flow"]) == (pytest.approx(0.2), pytest.approx([7.0, 0.0, 0.0], abs=1e-4))
