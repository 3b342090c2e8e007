"""Videos for finding wind and material: cases, cameras, noise, files. Only the last test needs Blender."""

import io
import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from gaussian_swaying import Simulation
from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.captures.capture_camera import read_views
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import beside

TOOL = "make_fit_data"
cases = beside("fit_cases")
videos = beside("fit_video")


def _swing(pattern, frames=5):
    """The flag turned about its upper edge, by up to 60 degrees."""
    grid = pattern.grid()
    rest = pattern.rest(grid.uv())[0]
    top = np.array([0.0, 0.0, pattern.height])
    shapes = []
    for angle in np.linspace(0, math.pi / 3, frames):
        c, s = math.cos(angle), math.sin(angle)
        shapes.append((rest - top) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) + top)
    return np.stack(shapes).astype(np.float32), grid.faces()


# ---- cases


def test_cases_are_three_winds_on_two_materials_and_more(cases):
    flags = {name: case for name, case in cases.CASES.items() if name.startswith("flag_")}
    assert len({case.flow for case in flags.values()}) == 3
    assert len({(case.youngs_modulus, case.density) for case in flags.values()}) == 2
    assert len(flags) == 6
    assert {case.pinned for case in cases.CASES.values()} == {"top", "left"}
    assert {case.texture for case in cases.CASES.values()} == {"printed"}


def test_the_fit_starts_wrong_and_its_ranges_hold_the_truth(cases):
    video = cases.FitVideo()
    for pattern in cases.CASES.values():
        truth = cases.truth_fields(pattern, video)
        ranges = {name: row["range"] for name, row in cases.fit_settings("data")["unknowns"].items()}
        for name in ("speed", "azimuth"):
            assert ranges[f"wind.{name}"][0] < truth[name] < ranges[f"wind.{name}"][1]
        assert ranges["material.E"][0] < truth["E"] < ranges["material.E"][1]
        turn = math.radians(truth["azimuth"])
        direction = [truth["speed"] * math.cos(turn), truth["speed"] * math.sin(turn), 0.0]
        np.testing.assert_allclose(direction, truth["flow"], atol=1e-9)
        scene = cases.scene_settings(pattern, video, "projected", "data")
        assert scene["material"]["E"] < 0.7 * truth["E"]
        assert np.linalg.norm(np.subtract(scene["wind"]["flow"], truth["flow"])) > 0.3 * truth["speed"]


def test_scenes_can_be_simulated_and_hold_the_right_edge(cases, tmp_path):
    for name in ("flag_wind1_a", "curtain", "pole_wind1"):
        pattern = cases.CASES[name]
        path = tmp_path / f"{name}.yaml"
        settings = cases.scene_settings(pattern, cases.FitVideo(), "projected", "data", spacing=0.05)
        settings["solver"]["dx"] = 0.2
        path.write_text(yaml.safe_dump(settings))
        simulation = Simulation.from_yaml(path, camera=None, device="cpu")
        assert simulation.frames_wanted == pattern.frames
        region = simulation.solver.boundaries[0].region
        means = simulation.scene.model.means
        held = means[region.contains(means)]
        # the reference holds the line itself; on a pole the first column stands half a spacing off it
        axis, line = (2, pattern.height) if pattern.pinned == "top" else (0, 0.025)
        spacing = settings["scene"]["generator"]["init_args"]["spacing"]
        assert 0.045 < spacing <= 0.05
        assert len(held) == round((pattern.width if axis == 2 else pattern.height) / spacing)
        torch.testing.assert_close(held[:, axis], torch.full((len(held),), line), atol=1e-5, rtol=0)


def test_the_texture_is_that_of_the_splat(cases):
    pictures = sys.modules["flag_pictures"]
    pattern = cases.CASES["flag_wind1_a"]
    texture = pictures.draw_texture(pattern, 200)  # pixels of 5 mm
    assert texture.shape == (140, 200, 3)
    settings = cases.scene_settings(pattern, cases.FitVideo(), "projected", "data")["scene"]["generator"]["init_args"]
    cloud = FlagScene(**(settings | {"height": pattern.height, "spacing": 0.005})).generate()  # one to each pixel
    columns, rows = (cloud.means[:, 0] / 0.005).long(), 139 - (cloud.means[:, 2] / 0.005).long()
    colours = 0.5 + 0.28209479177387814 * cloud.sh[:, 0]
    torch.testing.assert_close(torch.from_numpy(texture)[rows, columns], colours, atol=1e-3, rtol=0)


def test_bad_settings_are_named(cases, tool, monkeypatch, tmp_path, capsys):
    for change in ({"cameras": 9}, {"quality": 0}, {"samples": 0}, {"size": (8, 8)}, {"read_noise": -1.0}):
        with pytest.raises(ValueError, match=f"`{next(iter(change))}`"):
            cases.FitVideo(**change)
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    assert tool.main(["--cameras", "0", "--out", str(tmp_path / "data")]) == 1
    assert "`cameras`" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


# ---- cameras


def test_all_cameras_see_all_of_the_motion(cases, videos):
    pattern = replace(cases.CASES["flag_wind1_a"], cells=10)
    positions, faces = _swing(pattern)
    normal = videos.mean_normal(positions, faces, pattern.normal())
    np.testing.assert_allclose(normal, [0.0, -1.0, 0.0], atol=1e-6)
    views = videos.ring_views(positions, normal, cases.FitVideo(cameras=8))
    assert len({tuple(view.pose[:3, 3].round(3)) for view in views}) == 8
    for view in views:
        pixels = view.project(positions.reshape(-1, 3).astype(float))
        assert pixels.min() >= 0
        assert (pixels.max(0) <= [480, 270]).all()
        assert max(np.ptp(pixels, 0) / [480, 270]) > 0.7  # and nothing is small
    sides = [np.cross(normal, view.pose[:3, 2])[2] for view in views[:2]]
    assert sides[0] < 0 < sides[1]


def test_the_mean_normal_turns_with_the_cloth_and_stays_on_its_side(cases, videos):
    pattern = replace(cases.CASES["flag_wind1_a"], cells=10)
    positions, faces = _swing(pattern)
    c, s = math.cos(0.7), math.sin(0.7)
    turned = positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=np.float32)
    np.testing.assert_allclose(videos.mean_normal(turned, faces, pattern.normal()), [s, -c, 0.0], atol=1e-5)
    flat = np.stack([positions[..., 0], positions[..., 2], 0 * positions[..., 1]], -1)  # a table
    np.testing.assert_array_equal(videos.mean_normal(flat[:1], faces, pattern.normal()), pattern.normal())


# ---- pixels


def test_noise_has_the_strength_that_is_asked_for_and_is_repeatable(cases, videos):
    video = cases.FitVideo(read_noise=0.01, shot_noise=4e-4, seed=3)
    for level in (0.2, 0.7):
        picture = np.full((200, 200, 3), level)
        noisy = videos.add_noise(picture, video, (0, 5))
        assert noisy.dtype == np.uint8
        expected = math.sqrt(0.01**2 + 4e-4 * level + (1 / 255) ** 2 / 12)
        assert (noisy / 255.0).std() == pytest.approx(expected, rel=0.02)
        assert (noisy / 255.0).mean() == pytest.approx(level, abs=1e-3)
        np.testing.assert_array_equal(noisy, videos.add_noise(picture, video, (0, 5)))
        for other in ((1, 5), (0, 6)):
            assert (noisy != videos.add_noise(picture, video, other)).mean() > 0.5
    without = videos.add_noise(picture, replace(video, read_noise=0.0, shot_noise=0.0), (0, 0))
    np.testing.assert_array_equal(without, np.full_like(without, round(0.7 * 255)))


def test_compression_keeps_the_picture_and_drops_quality(videos):
    from PIL import Image

    x = np.linspace(0, 1, 64)
    picture = (255 * np.stack([x * x[:, None], x[::-1] * x[:, None], 0.5 + 0 * x * x[:, None]], -1)).astype(np.uint8)
    good, bad = (videos.compress(picture, quality) for quality in (85, 10))
    assert len(bad) < len(good)
    errors = [np.abs(np.asarray(Image.open(io.BytesIO(data))).astype(int) - picture).mean() for data in (good, bad)]
    assert errors[0] < 2 < errors[1]


def test_what_is_transparent_shows_the_background(videos):
    rgba = np.array([[[255, 0, 0, 255], [9, 9, 9, 0], [255, 255, 255, 51]]], dtype=np.uint8)
    found = videos.composite(rgba, (0.5, 0.25, 0.0))
    np.testing.assert_allclose(found[0], [[1, 0, 0], [0.5, 0.25, 0.0], [0.6, 0.4, 0.2]], atol=1e-9)


# ---- files


def test_the_camera_file_is_a_capture_with_times(cases, videos, tmp_path):
    pattern = replace(cases.CASES["flag_wind1_a"], cells=10)
    positions, _ = _swing(pattern, frames=3)
    video = cases.FitVideo(size=(48, 32))
    views = videos.ring_views(positions, pattern.normal(), video)
    fields = videos.video_fields(views, 3, pattern.fps)
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    for row in fields["frames"]:
        path = tmp_path / row["file_path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(videos.compress(np.zeros((32, 48, 3), dtype=np.uint8), 85))
    assert [row["time"] for row in fields["frames"]] == pytest.approx([0, 1 / 24, 2 / 24] * 2)
    assert [row["camera"] for row in fields["frames"]] == ["camera0"] * 3 + ["camera1"] * 3
    assert len({row["mask_path"] for row in fields["frames"]}) == 6
    assert len(read_capture(tmp_path).views) == 6
    found = dict(read_views(tmp_path))
    points = positions[1].astype(np.float64)
    for row, view in zip(fields["frames"], [views[0]] * 3 + [views[1]] * 3, strict=True):
        camera = found[row["file_path"]]
        assert (camera.width, camera.height) == (48, 32)
        seen = torch.from_numpy(points).float() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        pixels = seen @ camera.intrinsics.T
        np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], view.project(points), atol=1e-2)


def test_a_case_is_made_once_and_other_settings_are_refused(tool, tmp_path, capsys):
    pytest.importorskip("bpy", reason="needs the extra [blender]")
    from PIL import Image

    small = ["--case", "flag_wind2_a", "--out", str(tmp_path), "--cells", "10", "--frames", "3", "--size", "64", "36"]
    assert tool.main([*small, "--cameras", "1"]) == 0
    folder = tmp_path / "flag_wind2_a"
    fields = json.loads((folder / "transforms.json").read_text())
    assert len(fields["frames"]) == 3
    assert {"scene.yaml", "fit.yaml", "truth.json", "cloth.npz"} <= {path.name for path in folder.iterdir()}
    first = (folder / fields["frames"][0]["file_path"]).read_bytes()
    mask = np.asarray(Image.open(folder / fields["frames"][0]["mask_path"]))
    assert 0.1 < (mask > 0).mean() < 0.9
    capsys.readouterr()
    assert tool.main([*small, "--cameras", "2"]) == 0  # one more camera
    assert ": 3 pictures" in capsys.readouterr().out
    assert (folder / fields["frames"][0]["file_path"]).read_bytes() == first
    assert tool.main([*small, "--cameras", "2", "--noise", "2"]) == 1
    assert "read_noise" in capsys.readouterr().err
