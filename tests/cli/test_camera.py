"""``gaussian-swaying camera``: the files that it writes are what ``fit`` reads, and its answers to bad input."""

import json
import math

import pytest
import torch
from PIL import Image
from shared import refused

from gaussian_swaying.captures.capture_camera import read_views
from gaussian_swaying.cli.camera import main
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.inverse.registration import fov_of, painter_of
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.scenes.procedural import FlagScene

pytest.importorskip("cv2")
CAMERA = look_at_camera([1.0, -1.8, 0.8], [0.6, 0.0, 0.4], [0.0, 0.0, 1.0], 42.0, 320, 240)


@pytest.fixture
def flag(tmp_path):
    cloud = FlagScene(spacing=0.012, pattern="printed", ripple=0.06).generate()
    write_ply(tmp_path / "flag.ply", cloud)
    picture = (painter_of(cloud)(CAMERA).color.clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(picture.numpy()).save(tmp_path / "first.png")
    return tmp_path


def _off(camera):
    a, b = camera.world_to_camera.double()[:3, :3], CAMERA.world_to_camera.double()[:3, :3]
    return math.degrees(math.acos(min(1.0, float(((a @ b.T).trace() - 1) / 2))))


def test_the_camera_of_a_picture_and_its_field_of_view(flag, capsys):
    given = [str(flag / "first.png"), str(flag / "flag.ply"), "--up", "0", "0", "1", "--output", str(flag / "out")]
    assert main(given) == 0
    assert fov_of(read_views(flag / "out/transforms.json")[0][1]) == pytest.approx(42, abs=1.5)
    assert main([*given, "--fov", "42"]) == 0
    assert "points agree on the camera" in capsys.readouterr().out
    found = read_views(flag / "out/transforms.json")[0][1]
    assert _off(found) < 0.5
    assert (found.position - CAMERA.position).norm() < 0.02
    assert json.loads((flag / "out/transforms.json").read_text())["frames"][0]["file_path"] == "../first.png"
    assert Image.open(flag / "out/registration.png").size == (3 * 320, 240 + 22)


def test_what_cannot_be_is_refused_and_writes_nothing(flag, capsys):
    picture, splat = str(flag / "first.png"), str(flag / "flag.ply")
    refused(main, [picture, splat, "--fov", "190"], capsys, "`--fov` to be between 0 and 180")
    refused(main, [str(flag / "none.mp4"), splat], capsys, "none.mp4")
    Image.new("RGB", (320, 240), (90, 90, 90)).save(flag / "grey.png")
    refused(main, [str(flag / "grey.png"), splat, "--output", str(flag / "out")], capsys, "was not found in the frame")
    assert not (flag / "out").exists()
