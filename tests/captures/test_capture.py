import json
import math
from contextlib import nullcontext

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from shared import double, longest, peak, user_warning, value_error
from small_captures import POINTS, arc, picture, write_colmap, write_transforms
from torch.testing import assert_close

from gaussian_swaying.captures.capture import nearest_to_axes, read_capture
from gaussian_swaying.captures.capture_camera import read_views
from gaussian_swaying.captures.initial_points import initial_points
from gaussian_swaying.geometry.origin import NO_ORIGIN
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.training.data.datamodule import CaptureDataModule


def _names(count, suffix=".png"):
    return [f"images/{index:03d}{suffix}" for index in range(count)]


def _same_camera(found, expected, atol=1e-6):
    assert_close(found.world_to_camera, expected.world_to_camera.float(), rtol=0, atol=atol)
    assert_close(found.intrinsics, expected.intrinsics.float(), rtol=1e-6, atol=1e-5)
    assert (found.width, found.height) == (expected.width, expected.height)


def write_points(path, places, kind="<f4"):
    dtype = [(n, kind) for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.array([(*place, 255, 0, 51) for place in places], dtype=dtype)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


@pytest.fixture
def written(tmp_path):
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
    assert capture.extent == pytest.approx(1.1 * float(longest(train - train.mean(0))), rel=1e-5)
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
    message = r"left out 2 of 6 cameras that have no photo on disk, the first of them that of images/001\.png\."
    with user_warning(message) as caught:
        capture = read_capture(tmp_path)
    assert len(caught) == 1
    assert [view.name[-7:-4] for view in capture.views] == ["000", "002", "003", "005"]
    assert (
        "4 of 4 photos have a camera in transforms.json; 2 cameras without a photo; no points; no masks"
        in capture.found
    )


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
    write_points(tmp_path / "points3d.ply", [(0, 0.125, 0.25)])
    capture = read_capture(tmp_path)
    assert capture.points.tolist() == [[0, 0.125, 0.25]]
    assert capture.colors[0].tolist() == pytest.approx([1.0, 0.0, 0.2])


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
    with value_error(r"cameras\.(bin|txt).*camera 7.*OPENCV_FISHEYE.*image_undistorter"):
        read_capture(tmp_path)


def test_colmap_comes_before_transforms_unless_told(tmp_path):
    poses = arc(3)
    write_colmap(tmp_path, poses, ["000.png", "001.png", "002.png"])
    write_transforms(tmp_path, poses[:2], _names(2))
    assert len(read_capture(tmp_path).views) == 3
    with user_warning(r"left out 1 of 3 photos.*no camera in transforms\.json.*002\.png"):
        assert len(read_capture(tmp_path, "transforms", test_every=0).views) == 2


@pytest.mark.parametrize(
    ("models", "read", "found"),
    [
        ({"sparse/0": 2, "sparse/1": 6}, 6, "COLMAP model sparse/1 with 6 images (the COLMAP model sparse/0 has 2)"),
        ({"sparse/2": 3, "sparse/10": 3}, 3, "3 of 6 photos have a camera in the COLMAP model sparse/2 with 3"),
        ({"sparse": 2}, 2, "2 of 6 photos have a camera in the COLMAP model sparse;"),
        ({"colmap/sparse/0": 6}, 6, "6 of 6 photos have a camera in the COLMAP model colmap/sparse/0;"),
        ({".": 6}, 6, "in the COLMAP model .; no cameras without a photo; 3 points; no masks."),
    ],
)
def test_the_model_with_most_images_is_read(tmp_path, models, read, found):
    names = _names(6)
    for sparse, count in models.items():
        write_colmap(tmp_path, arc(count), names[:count], sparse=sparse, images=False)
    write_transforms(tmp_path, arc(6), names)
    (tmp_path / "images/000_depth_1.png").write_bytes(b"made of 000.png")
    with user_warning(f"left out {6 - read} of 6 photos") if read < 6 else nullcontext():
        capture = read_capture(tmp_path, test_every=0)
    assert len(capture.views) == len(read_views(tmp_path)) == read
    assert found in capture.found


def test_images_without_their_second_lines(tmp_path):
    names = ["1", "2 3.5 4.png", "7  8.png", "9"]
    write_colmap(tmp_path, arc(4), [f"{name.removesuffix('.png')}.png" for name in names], binary=False)
    file = tmp_path / "sparse/0/images.txt"
    lines = [line.replace(" 1.png", " 1").replace(" 9.png", " 9") for line in file.read_text().split("\n") if line]
    for kept in (lines, [line for line in lines if not line.startswith("1.0")]):
        file.write_text("\r\n".join(kept))
        assert [view.name for view in read_capture(tmp_path, test_every=0).views] == sorted(names)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(tmp_path, encoding, written):
    write_colmap(tmp_path, arc(3), _names(3), binary=False, images=False)
    written()
    for file in (*(tmp_path / "sparse/0").glob("*.txt"), tmp_path / "transforms.json"):
        file.write_bytes(file.read_text().encode(encoding))
    for kind in ("colmap", "transforms"):
        assert len(read_capture(tmp_path, kind).views) == 3


# ---- turns and masks


def _turned(index, orientation, size):
    image, tags = Image.fromarray(picture(index, *size)), Image.Exif()
    tags[0x112] = orientation
    back = {3: Image.ROTATE_180, 5: Image.TRANSPOSE, 6: Image.ROTATE_90, 8: Image.ROTATE_270}
    return image.transpose(back[orientation]), tags


@pytest.mark.parametrize("told", [True, False], ids=["turned cameras", "stored cameras"])
@pytest.mark.parametrize(
    ("orientation", "size"), [(6, (20, 16)), (8, (20, 16)), (6, (18, 18)), (3, (20, 16)), (5, (18, 18))]
)
def test_photos_are_turned_as_their_cameras_are(tmp_path, orientation, size, told):
    """Sizes tell, or else a warning says that nothing does."""
    names, files = ["0.png", "1.png", "2.png"], []
    for index, name in enumerate(names):
        (tmp_path / "images").mkdir(exist_ok=True)
        image, tags = _turned(index, orientation, size)
        image.save(tmp_path / "images" / name, exif=tags)
        files.append(picture(index, *size) if told else np.asarray(image))
    poses = arc(3, *files[0].shape[1::-1])
    write_colmap(tmp_path, poses, names, images=False)
    sure = size[0] != size[1] and orientation >= 5
    with nullcontext() if sure else user_warning("3 photos have an EXIF tag.*remove the tag"):
        views = read_capture(tmp_path, test_every=0).views
    assert [view.turned for view in views] == [told and sure] * 3
    if sure or not told:
        for view, pixels in zip(views, files, strict=True):
            assert torch.equal(view.load(), torch.from_numpy(pixels.copy()))


@pytest.mark.parametrize("white", [255, 1])
def test_masks_are_alpha(tmp_path, white, written):
    written()
    mask = np.zeros((16, 20), dtype=np.uint8)
    mask[:, :10] = white
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/all.png")
    with user_warning("not used are the masks in .*masks: name them.*`mask_path`"):
        read_capture(tmp_path)
    _edit(tmp_path, lambda d: [frame.update(mask_path=".\\masks\\ALL.jpg") for frame in d["frames"]])
    capture = read_capture(tmp_path)
    assert "3 masks, in whose black parts nothing is to be" in capture.found
    loaded = capture.views[1].load()
    assert torch.equal(loaded[:, :10, :3], torch.from_numpy(picture(1))[:, :10])
    assert loaded[:, :10, 3].unique().tolist() == [255]
    assert loaded[:, 10:].unique().tolist() == [0]
    assert read_capture(tmp_path, downscale=2).views[1].load().shape == (8, 10, 4)
    Image.fromarray(mask[:8]).save(tmp_path / "masks/all.png")
    with value_error(r"mask .*all\.png has 20 x 8 pixels.*proportions of the photo"):
        capture.views[1].load()
    (tmp_path / "masks/all.png").unlink()
    with value_error(r"masks/ALL\.jpg does not exist"):
        read_capture(tmp_path)


# ---- map coordinates

FAR_AWAY = double([500123.25, 4649776.5, 312.0])


@pytest.mark.parametrize("kind", ["bin", "txt", "transforms"])
def test_map_coordinates_keep_their_detail(tmp_path, kind):
    captures, views = [], []
    for folder, offset in ((tmp_path / "near", 0 * FAR_AWAY), (tmp_path / "far", FAR_AWAY)):
        poses, names = arc(5), _names(5)
        for pose in poses:
            pose.world_to_camera[:3, 3] -= pose.world_to_camera[:3, :3] @ offset
        points = [((offset + torch.tensor(place)).tolist(), color) for place, color in POINTS]
        if kind == "transforms":
            write_transforms(folder, poses, names)
            write_points(folder / "points3d.ply", [place for place, _ in points], "<f8")
        else:
            write_colmap(folder, poses, names, binary=kind == "bin", points=points, images=False)
            write_transforms(folder, poses, names)
        captures.append(read_capture(folder, "transforms" if kind == "transforms" else "colmap", images="."))
        views.append(read_views(folder, origin=captures[-1].origin))
    near, far = captures
    assert near.origin == NO_ORIGIN
    shift = (double(far.origin) - FAR_AWAY).float()
    assert peak(shift) < 4
    assert_close(far.points, near.points - shift, rtol=0, atol=1e-6)
    assert far.extent == pytest.approx(near.extent, rel=1e-6)
    for a, b, (_, c) in zip(near.views, far.views, views[1], strict=True):
        assert_close(b.camera.position, a.camera.position - shift, rtol=0, atol=2e-6)
        assert_close(c.world_to_camera, b.camera.world_to_camera, rtol=0, atol=1e-6)
    assert f"coordinates count from {list(far.origin)} of the file" in far.found
    data = CaptureDataModule(far.path, "transforms")
    assert data.initial_cloud(0).origin == far.origin


# ---- what does not belong together


def _opencv(data):
    for frame in data["frames"]:
        frame["transform_matrix"] = [[row[0], -row[1], -row[2], row[3]] for row in frame["transform_matrix"]]


def test_axes_of_opencv(tmp_path, written):
    written()
    expected = [view.camera.world_to_camera for view in read_capture(tmp_path).views]
    _edit(tmp_path, _opencv)
    with user_warning("optical axes meet behind.*set `axes` of the transforms.json to opencv"):
        capture = read_capture(tmp_path)
    with value_error(r"look at no common point.*set `axes`"):
        initial_points(capture)
    write_points(tmp_path / "points3d.ply", [(0, 0.125, 0.25)])
    with value_error(r"Only 0 of 3 cameras .* see any of its points: y and z.*set `axes`"):
        read_capture(tmp_path)
    _edit(tmp_path, lambda data: data.update(axes="opencv"))
    for view, (_, other), pose in zip(read_capture(tmp_path).views, read_views(tmp_path), expected, strict=True):
        assert_close(view.camera.world_to_camera, pose)
        assert_close(other.world_to_camera, pose)
    _edit(tmp_path, lambda data: data.update(axes="OpenCV"))
    with value_error(r"`axes`.*'OpenCV': set it to opengl or opencv"):
        read_capture(tmp_path)


def test_points_of_something_else(tmp_path):
    write_colmap(tmp_path, arc(3), ["a.png", "b.png", "c.png"], points=[((0.0, 0.0, 5000.0), (1, 2, 3))])
    with value_error(r"Only 0 of 3 cameras .* not of the same reconstruction.*remove the points"):
        read_capture(tmp_path)


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
    with value_error(r"images_3/000\.png has 7 x 9 pixels.*remove the folder"):
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
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, float("nan")), "finite numbers, but has NaN"),
        (lambda d: d["frames"][2].pop("transform_matrix"), r"no `frames\[2\].transform_matrix`"),
        (lambda d: d["frames"][0].update(file_path=7), r"`frames\[0\].file_path`.*set it to an image"),
        (lambda d: d.update(k4=0.1), "`k4`.*undistort the images first"),
        (lambda d: d.update(k1="big"), "`k1`.*set it to a number"),
        (lambda d: d.update(k1=-50.0), r"images/000\.png.*(folds the image|leaves)"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "asks for OPENCV_FISHEYE"),
        (lambda d: d.update(is_fisheye=True), "asks for a fisheye lens"),
        (lambda d: d.update(w=21), r"images/000\.png has 20 x 16 pixels, but its camera has 21 x 16"),
        (lambda d: d.update(w=0), "`w`.*set it from 1 to 32768 pixels"),
        (lambda d: d.update(test_filenames=_names(3)), "train split.*empty.*train split"),
        (lambda d: d.update(train_filenames=5), "`train_filenames`.*list of file paths"),
        (lambda d: [f.update(file_path=f"gone/{i}") for i, f in enumerate(d["frames"])], "no images: all 3.*gone/0"),
        (lambda d: [f.update(transform_matrix=d["frames"][0]["transform_matrix"]) for f in d["frames"]], "same place"),
    ],
)
def test_bad_transforms_are_named(tmp_path, change, message, written):
    written()
    _edit(tmp_path, change)
    with value_error(message):
        read_capture(tmp_path)


def test_an_unreadable_image_is_named_before_anything_is_loaded(tmp_path, written):
    written()
    (tmp_path / "images/001.png").write_text("no image")
    with value_error(r"images/001\.png cannot be read"):
        read_capture(tmp_path)


def test_an_empty_split_and_bad_arguments(tmp_path, written):
    written()
    with value_error(r"train split.*empty.*set it to 0"):
        read_capture(tmp_path, test_every=1)
    for name, value in (("downscale", 0), ("downscale", 1.5), ("test_every", -1)):
        with value_error(f"`{name}`"):
            read_capture(tmp_path, **{name: value})
    with value_error("lower `downscale`"):
        read_capture(tmp_path, downscale=17)
    with value_error("`format`"):
        read_capture(tmp_path, format="nerf")
    with pytest.raises(FileNotFoundError, match="check the path"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with value_error(r"not a capture.*sparse.*transforms\.json"):
        read_capture(tmp_path / "empty")
    with value_error("no sparse/0 or sparse"):
        read_capture(tmp_path, "colmap")


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_bad_colmap_models_are_named(tmp_path, binary):
    def write(**changes):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        return write_colmap(folder, arc(3), ["a.png", "b.png", "c.png"], binary=binary, **changes)

    suffix = "bin" if binary else "txt"
    folder = write()
    (folder / f"sparse/0/cameras.{suffix}").unlink()
    with value_error("Cannot read cameras of the COLMAP model"):
        read_capture(folder)
    for name in ("cameras", "images", "points3D"):
        folder = write()
        file = folder / f"sparse/0/{name}.{suffix}"
        data = file.read_bytes()
        file.write_bytes(data[:-9] if binary else data + b"8 OPENCV x\n")
        with value_error(rf"{name}\.{suffix} is damaged.*export the model again"):
            read_capture(folder)
    folder = write(images=False)
    (folder / "images").mkdir()
    with value_error(r"all 3 are missing, the first of them a\.png"):
        read_capture(folder)
    with value_error(r"no folder photos/.*`images` to one of images, sparse\."):
        read_capture(write(), images="photos")


def test_the_folder_of_photos_may_have_another_case(tmp_path):
    write_colmap(tmp_path, arc(3), ["a.png", "b.png", "c.png"])
    (tmp_path / "images").rename(tmp_path / "Images")
    assert read_capture(tmp_path).views[0].image_path == tmp_path / "Images/a.png"


def test_one_photo_with_two_cameras(tmp_path):
    names = ["left/0.png", "right/0.png", "0.png"]
    write_colmap(tmp_path, arc(3), names)
    for name in names[:2]:
        (tmp_path / "images" / name).unlink()
    with value_error(r"cameras of 0\.png and left/0\.png .* the same photo .*correct the names"):
        read_capture(tmp_path)


def test_a_zero_quaternion_and_an_unknown_camera_are_named(tmp_path):
    write_colmap(tmp_path, arc(2), ["a.png", "b.png"], binary=False)
    file = tmp_path / "sparse/0/images.txt"
    good = file.read_text()
    words = good.splitlines()[1].split()
    file.write_text(good.replace(" ".join(words[1:5]), "0 0 0 0"))
    with value_error(r"image a\.png.*not rigid"):
        read_capture(tmp_path)
    file.write_text(good.replace("7 a.png", "3 a.png"))
    with value_error(r"image a\.png.*names camera 3"):
        read_capture(tmp_path)


def test_the_point_nearest_to_all_axes():
    target = (0.3, -0.2, 0.1)
    eyes = [(2, 0, 0), (0, 2, 1), (-1, -2, 0.5)]
    found = nearest_to_axes([look_at_camera(eye, target, (0, 0, 1), 40.0, 8, 8) for eye in eyes])
    assert found.tolist() == pytest.approx(list(target), abs=1e-5)
    parallel = [look_at_camera((x, -2, 0), (x, 0, 0), (0, 0, 1), 40.0, 8, 8) for x in (0.0, 1.0)]
    assert torch.isnan(nearest_to_axes(parallel)).all()
