"""Small captures, written as the tools of the field write them."""

import json
import struct

import imageio.v3 as iio
import numpy as np
import torch

from gaussian_swaying.geometry.rotations import rotation_to_quat
from gaussian_swaying.rendering.cameras.camera import look_at_camera

MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def arc(count, width=20, height=16):
    """Cameras on an arc that look at (0, 0, 0.2), in float64."""
    eyes = [(2 * np.sin(0.4 * i), -2 * np.cos(0.4 * i), 0.1 * i) for i in range(count)]
    return [
        look_at_camera(eye, (0, 0, 0.2), (0, 0, 1), 50.0, width, height, dtype=torch.float64).to(dtype=torch.float64)
        for eye in eyes
    ]


def picture(index, width=20, height=16, channels=3):
    rows, columns = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    layers = [np.full((height, width), 10 * index), rows * 8, columns * 8, 255 - rows * 5 - columns]
    return np.stack(layers[:channels], -1).astype(np.uint8)


def write_transforms(folder, poses, names, channels=3, file="transforms.json", images=True, **fields):
    """A transforms.json with images of 20 x 16 pixels; names without extension are written as .png."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, (camera, name) in enumerate(zip(poses, names, strict=True)):
        flip = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
        pose = torch.linalg.inv(camera.world_to_camera) * flip
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        if images:
            path = folder / name
            path = path if path.suffix else path.with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(path, picture(index, channels=channels))
    if not {"camera_angle_x", "fl_x"} & set(fields):
        focal = float(poses[0].intrinsics[0, 0])
        fields |= {"fl_x": focal, "w": poses[0].width, "h": poses[0].height}
    (folder / file).write_text(json.dumps({**fields, "frames": frames}))
    return folder


POINTS = [((0.5, -0.25, 1.5), (255, 0, 51)), ((0.0, 0.1, 0.2), (0, 102, 255)), ((1.0, 2.0, 3.0), (9, 8, 7))]


def write_colmap(
    folder, poses, names, model="PINHOLE", parameters=None, binary=True, sparse="sparse/0", points=POINTS, images=True
):
    target = folder / sparse
    target.mkdir(parents=True, exist_ok=True)
    width, height = poses[0].width, poses[0].height
    fx, fy = (float(poses[0].intrinsics[i, i]) for i in range(2))
    parameters = [fx, fy, 0.5 * width, 0.5 * height] if parameters is None else parameters
    rows = [[*rotation_to_quat(c.world_to_camera[:3, :3]).tolist(), *c.world_to_camera[:3, 3].tolist()] for c in poses]
    if binary:
        data = struct.pack("<QiiQQ", 1, 7, MODELS[model], width, height) + struct.pack(
            f"<{len(parameters)}d", *parameters
        )
        (target / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(rows))
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            seen = 2 if i == 0 else 0
            data += struct.pack("<i7di", i + 1, *row, 7) + name.encode() + b"\0" + struct.pack("<Q", seen)
            data += struct.pack("<ddq", 1.0, 2.0, 1) * seen
        (target / "images.bin").write_bytes(data)
        data = struct.pack("<Q", len(points))
        for i, (place, color) in enumerate(points):
            data += struct.pack("<Q3d3BdQ", i + 1, *place, *color, 0.5, 2) + struct.pack("<ii", 1, 0) * 2
        (target / "points3D.bin").write_bytes(data)
    else:
        words = " ".join(map(repr, map(float, parameters)))
        (target / "cameras.txt").write_text(f"# Camera list\n7 {model} {width} {height} {words}\n")
        lines = ["# Image list with two lines of data per image:"]
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            seen = "1.0 2.0 1 1.0 2.0 1" if i == 0 else ""
            lines += [f"{i + 1} {' '.join(repr(float(v)) for v in row)} 7 {name}", seen]
        (target / "images.txt").write_text("\n".join(lines) + "\n")
        lines = [f"{i + 1} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5 1 0 1 1" for i, (p, c) in enumerate(points)]
        (target / "points3D.txt").write_text("# 3D point list\n" + "\n".join(lines) + "\n")
    for index, name in enumerate(names):
        if images:
            (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(folder / "images" / name, picture(index))
    return folder
