"""Captures in every format, against the cameras and pictures that were written."""

import json
import math
import warnings

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from small_captures import POINTS, arc, picture, write_colmap, write_transforms
from torch.testing import assert_close

from gaussian_swaying.captures.capture import nearest_to_axes, read_capture
from gaussian_swaying.rendering.cameras.camera import look_at_camera


def _names(count, suffix=".png"):
    return [f"images/{index:03d}{suffix}" for index in range(count)]


def _same_camera(found, expected, atol=1e-6):
    assert_close(found.world_to_camera, expected.world_to_camera.float(), rtol=0, atol=atol)
    assert_close(found.intrinsics, expected.intrinsics.float(), rtol=1e-6, atol=1e-5)
    assert (found.width, found.height) == (expected.width, expected.height)


@pytest.fixture
def written(tmp_path):
    """A folder with a transforms.json of some cameras and their images."""

    def write(count=3, **fields):
        return write_transforms(tmp_path, arc(count), _names(count), **fields)

    return write


# ---- transforms.json


def test_one_transforms_file(tmp_path):
    poses = arc(9)
    write_transforms(tmp_path, poses, _names(9))
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.views] == _names(9)
    assert [view.split for view in capture.views] == ["test", *["train"] * 7, "test"]
    for index, (view, pose) in enumerate(zip(capture.views, poses, strict=True)):
        _same_camera(view.camera, pose)
        assert torch.equal(view.load(), torch.from_numpy(picture(index)))
    train = torch.stack([pose.position for pose in poses[1:8]])
    assert_close(capture.center, train.mean(0).float())
    assert capture.extent == pytest.approx(1.1 * float((train - train.mean(0)).norm(dim=-1).max()), rel=1e-5)
    assert capture.points is None
    assert len(read_capture(tmp_path / "transforms.json", test_every=3).split("test")) == 3
    assert read_capture(tmp_path, test_every=0).split("test") == ()


def test_blender_files_without_extensions_and_sizes(tmp_path):
    poses = arc(4)
    angle = 2 * float(torch.atan(10 / poses[0].intrinsics[0, 0]))
    for split, some in (("train", poses[:2]), ("val", poses[2:3]), ("test", poses[3:])):
        names = [f"./{split}/r_{index}" for index in range(len(some))]
        file = f"transforms_{split}.json"
        write_transforms(tmp_path, some, names, channels=4, file=file, camera_angle_x=angle)
    capture = read_capture(tmp_path)
    assert {view.name: view.split for view in capture.views} == {
        "test/r_0": "test",
        "train/r_0": "train",
        "train/r_1": "train",
        "val/r_0": "val",
    }
    _same_camera(capture.split("train")[1].camera, poses[1])
    assert capture.split("val")[0].load().shape == (16, 20, 4)


def test_intrinsics_of_a_frame_win_and_the_principal_point_is_kept(tmp_path, written):
    written(fl_x=18.0, fl_y=19.0, w=20, h=16, cx=9.0)
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"][1] |= {"fl_x": 30.0, "cy": 7.0}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    views = read_capture(tmp_path).views
    assert views[0].camera.intrinsics.tolist() == [[18, 0, 9], [0, 19, 8], [0, 0, 1]]
    assert views[1].camera.intrinsics.tolist() == [[30, 0, 9], [0, 19, 7], [0, 0, 1]]
    data["frames"][2]["camera_angle_x"] = 2 * math.atan(10 / 40)  # a zoom, with square pixels
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    zoomed = read_capture(tmp_path).views[2].camera.intrinsics
    assert [float(zoomed[0, 0]), float(zoomed[1, 1])] == pytest.approx([40.0, 40.0])


def test_frames_without_an_image_are_counted_once(tmp_path, written):
    written(6)
    for index in (1, 4):
        (tmp_path / f"images/{index:03d}.png").unlink()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = read_capture(tmp_path)
    assert len(caught) == 1
    assert "left out 2 of 6 frames that have no image, the first of them images/001.png" in str(caught[0].message)
    assert [view.name[-7:-4] for view in capture.views] == ["000", "002", "003", "005"]


def test_an_image_with_another_extension_is_found(tmp_path, written):
    written(2)
    data = (tmp_path / "transforms.json").read_text().replace(".png", ".jpg").replace("images/", "images\\\\")
    (tmp_path / "transforms.json").write_text(data)
    assert [view.image_path.name for view in read_capture(tmp_path, test_every=0).views] == ["000.png", "001.png"]


def test_lists_of_file_names_are_the_split(tmp_path):
    names = _names(4)
    lists = {"train_filenames": names[:2], "val_filenames": names[2:3], "test_filenames": [f"./{names[3]}"]}
    write_transforms(tmp_path, arc(4), names, **lists)
    assert [view.split for view in read_capture(tmp_path).views] == ["train", "train", "val", "test"]


def test_distortion_is_taken_out(tmp_path, written):
    lens = {"fl_x": 20.0, "w": 20, "h": 16, "k1": 0.3, "p2": 0.01}
    written(2, **lens)
    view = read_capture(tmp_path, test_every=0).views[0]
    assert view.lens.distortion == (0.3, 0.0, 0.0, 0.01, 0.0)
    seen = view.lens.undistorted()
    assert (view.camera.width, view.camera.height) == (seen.width, seen.height) != (20, 16)
    assert view.load().shape == (seen.height, seen.width, 3)
    assert_close(view.camera.intrinsics, seen.intrinsics().float())


def test_points_of_a_transforms_capture(tmp_path, written):
    written()
    rows = np.array([(1, 2, 3, 255, 0, 51)], dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in _RGB])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "points3d.ply"))
    capture = read_capture(tmp_path)
    assert capture.points.tolist() == [[1, 2, 3]]
    assert capture.colors[0].tolist() == pytest.approx([1.0, 0.0, 0.2])


_RGB = ("red", "green", "blue")


# ---- COLMAP


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize("sparse", ["sparse/0", "sparse"])
def test_colmap(tmp_path, binary, sparse):
    poses, names = arc(9), [f"left eye/{index:03d}.png" for index in range(9)]
    order = [3, 0, 8, 1, 2, 7, 4, 5, 6]
    write_colmap(tmp_path, [poses[i] for i in order], [names[i] for i in order], binary=binary, sparse=sparse)
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.views] == names
    assert [view.split for view in capture.views] == ["test", *["train"] * 7, "test"]
    for view, pose in zip(capture.views, poses, strict=True):
        _same_camera(view.camera, pose)
    assert torch.equal(capture.views[3].load(), torch.from_numpy(picture(0)))
    expected = torch.tensor([place for place, _ in POINTS])
    assert_close(capture.points, expected)
    assert_close(capture.colors, torch.tensor([c for _, c in POINTS]) / 255)


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize(
    ("model", "parameters", "expected"),
    [
        ("SIMPLE_PINHOLE", [19.0, 9.5, 8.25], (19.0, 19.0, 9.5, 8.25, (0, 0, 0, 0, 0))),
        ("PINHOLE", [19.0, 18.0, 9.5, 8.25], (19.0, 18.0, 9.5, 8.25, (0, 0, 0, 0, 0))),
        ("SIMPLE_RADIAL", [19.0, 9.5, 8.25, 0.1], (19.0, 19.0, 9.5, 8.25, (0.1, 0, 0, 0, 0))),
        ("RADIAL", [19.0, 9.5, 8.25, 0.1, -0.02], (19.0, 19.0, 9.5, 8.25, (0.1, -0.02, 0, 0, 0))),
        (
            "OPENCV",
            [19.0, 18.0, 9.5, 8.25, 0.1, -0.02, 0.003, 0.004],
            (19.0, 18.0, 9.5, 8.25, (0.1, -0.02, 0.003, 0.004, 0)),
        ),
    ],
)
def test_colmap_camera_models(tmp_path, binary, model, parameters, expected):
    write_colmap(tmp_path, arc(2), ["a.png", "b.png"], model, parameters, binary)
    lens = read_capture(tmp_path, test_every=0).views[0].lens
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion) == expected


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_other_camera_models_are_refused(tmp_path, binary):
    fisheye = [19.0, 18.0, 9.5, 8.25, 0.1, -0.02, 0.003, 0.004]
    write_colmap(tmp_path, arc(2), ["a.png", "b.png"], "OPENCV_FISHEYE", fisheye, binary)
    with pytest.raises(ValueError, match=r"cameras\.(bin|txt).*camera 7.*OPENCV_FISHEYE.*image_undistorter"):
        read_capture(tmp_path)


def test_colmap_comes_before_transforms_unless_told(tmp_path):
    poses = arc(3)
    write_colmap(tmp_path, poses, ["000.png", "001.png", "002.png"])
    write_transforms(tmp_path, poses[:2], _names(2))
    assert len(read_capture(tmp_path).views) == 3
    assert len(read_capture(tmp_path, "transforms", test_every=0).views) == 2


# ---- sizes


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_downscale_averages_or_reads_the_smaller_folder(tmp_path, kind):
    poses, names = arc(3), ["000.png", "001.png", "002.png"]
    if kind == "colmap":
        write_colmap(tmp_path, poses, names)
    else:
        write_transforms(tmp_path, poses, _names(3))
    view = read_capture(tmp_path, downscale=3).views[1]
    full = torch.from_numpy(picture(1)).float()
    mean = full[:15, :18].reshape(5, 3, 6, 3, 3).mean((1, 3))
    assert_close(view.load().float(), mean, rtol=0, atol=0.51)
    focal = float(poses[0].intrinsics[0, 0])
    expected = torch.tensor([[focal / 3, 0, 10 / 3], [0, focal / 3, 8 / 3], [0, 0, 1]])
    assert_close(view.camera.intrinsics, expected)
    (tmp_path / "images_3").mkdir()
    for name in names:
        iio.imwrite(tmp_path / "images_3" / name, np.full((5, 7, 3), 77, dtype=np.uint8))
    view = read_capture(tmp_path, downscale=3).views[1]
    assert view.image_path.parent.name == "images_3"
    assert view.load().unique().tolist() == [77]
    assert (view.camera.width, view.camera.height) == (7, 5)
    assert float(view.camera.intrinsics[0, 0]) == pytest.approx(focal * 7 / 20)
    assert read_capture(tmp_path).views[1].camera.width == 20
    iio.imwrite(tmp_path / "images_3" / names[0], np.zeros((9, 7, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match=r"images_3/000\.png has 7 x 9 pixels.*remove the folder"):
        read_capture(tmp_path, downscale=3)


# ---- bad input


def _edit(folder, change):
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def _scale(data):
    data["frames"][1]["transform_matrix"] = [[2 * v for v in row] for row in data["frames"][1]["transform_matrix"]]


def _mirror(data):
    for row in data["frames"][1]["transform_matrix"]:
        row[0] = -row[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_scale, r"frames\[1\].transform_matrix.*transforms\.json.*not rigid.*apply the scale"),
        (_mirror, r"frames\[1\].transform_matrix.*transforms\.json.*reflection"),
        (lambda d: d["frames"][1].update(transform_matrix=[[0.0] * 4] * 4), r"frames\[1\].*singular"),
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, float("nan")), "finite numbers"),
        (lambda d: d["frames"][2].pop("transform_matrix"), r"no `frames\[2\].transform_matrix`"),
        (lambda d: d["frames"][0].update(file_path=7), r"`frames\[0\].file_path`.*set it to an image"),
        (lambda d: d.update(k4=0.1), "`k4`.*undistort the images first"),
        (lambda d: d.update(k1="big"), "`k1`.*set it to a number"),
        (lambda d: d.update(k1=-50.0), r"images/000\.png.*(folds the image|leaves)"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "asks for OPENCV_FISHEYE"),
        (lambda d: d.update(is_fisheye=True), "asks for a fisheye lens"),
        (lambda d: d.update(w=21), r"images/000\.png has 20 x 16 pixels, but its camera has 21 x 16"),
        (lambda d: d.update(w=0), "`w`.*positive"),
        (lambda d: d.update(test_filenames=_names(3)), "train split.*empty.*train split"),
        (lambda d: d.update(train_filenames=5), "`train_filenames`.*list of file paths"),
        (lambda d: [f.update(file_path=f"gone/{i}") for i, f in enumerate(d["frames"])], "no images: all 3.*gone/0"),
        (lambda d: [f.update(transform_matrix=d["frames"][0]["transform_matrix"]) for f in d["frames"]], "same place"),
    ],
)
def test_bad_transforms_are_named(tmp_path, change, message, written):
    written()
    _edit(tmp_path, change)
    with pytest.raises(ValueError, match=message):
        read_capture(tmp_path)


def test_an_unreadable_image_is_named_before_anything_is_loaded(tmp_path, written):
    written()
    (tmp_path / "images/001.png").write_text("no image")
    with pytest.raises(ValueError, match=r"images/001\.png cannot be read"):
        read_capture(tmp_path)


def test_an_empty_split_and_bad_arguments(tmp_path, written):
    written()
    with pytest.raises(ValueError, match=r"train split.*empty.*set it to 0"):
        read_capture(tmp_path, test_every=1)
    for name, value in (("downscale", 0), ("downscale", 1.5), ("test_every", -1)):
        with pytest.raises(ValueError, match=f"`{name}`"):
            read_capture(tmp_path, **{name: value})
    with pytest.raises(ValueError, match="lower `downscale`"):
        read_capture(tmp_path, downscale=17)
    with pytest.raises(ValueError, match="`format`"):
        read_capture(tmp_path, format="nerf")
    with pytest.raises(FileNotFoundError, match="check the path"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"not a capture.*sparse.*transforms\.json"):
        read_capture(tmp_path / "empty")
    with pytest.raises(ValueError, match="no sparse/0 or sparse"):
        read_capture(tmp_path, "colmap")


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_bad_colmap_models_are_named(tmp_path, binary):
    def write(**changes):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        return write_colmap(folder, arc(3), ["a.png", "b.png", "c.png"], binary=binary, **changes)

    suffix = "bin" if binary else "txt"
    folder = write()
    (folder / f"sparse/0/cameras.{suffix}").unlink()
    with pytest.raises(ValueError, match="Cannot read cameras of the COLMAP model"):
        read_capture(folder)
    for name in ("cameras", "images", "points3D"):
        folder = write()
        file = folder / f"sparse/0/{name}.{suffix}"
        data = file.read_bytes()
        file.write_bytes(data[:-9] if binary else data + b"8 OPENCV x\n")
        with pytest.raises(ValueError, match=rf"{name}\.{suffix} is damaged.*export the model again"):
            read_capture(folder)
    folder = write(images=False)
    (folder / "images").mkdir()
    with pytest.raises(ValueError, match=r"all 3 are missing, the first of them a\.png"):
        read_capture(folder)
    with pytest.raises(ValueError, match=r"no folder photos/.*`images`"):
        read_capture(write(), images="photos")


def test_a_zero_quaternion_and_an_unknown_camera_are_named(tmp_path):
    write_colmap(tmp_path, arc(2), ["a.png", "b.png"], binary=False)
    file = tmp_path / "sparse/0/images.txt"
    good = file.read_text()
    words = good.splitlines()[1].split()
    file.write_text(good.replace(" ".join(words[1:5]), "0 0 0 0"))
    with pytest.raises(ValueError, match=r"image a\.png.*not rigid"):
        read_capture(tmp_path)
    file.write_text(good.replace("7 a.png", "3 a.png"))
    with pytest.raises(ValueError, match=r"image a\.png.*names camera 3"):
        read_capture(tmp_path)


def test_the_point_nearest_to_all_axes():
    target = (0.3, -0.2, 0.1)
    eyes = [(2, 0, 0), (0, 2, 1), (-1, -2, 0.5)]
    found = nearest_to_axes([look_at_camera(eye, target, (0, 0, 1), 40.0, 8, 8) for eye in eyes])
    assert found.tolist() == pytest.approx(list(target), abs=1e-5)
    parallel = [look_at_camera((x, -2, 0), (x, 0, 0), (0, 0, 1), 40.0, 8, 8) for x in (0.0, 1.0)]
    assert torch.isnan(nearest_to_axes(parallel)).all()
