"""Points that Gaussians start from: those of a capture, of a file, of a mesh, or at random."""

from __future__ import annotations

import math
import os
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.data.capture import Capture, nearest_to_axes
from gaussian_swaying.data.point_cloud import PointCloud, read_obj_mesh, read_ply_points, sample_mesh


def initial_points(
    capture: Capture,
    source: str | os.PathLike[str] = "auto",
    count: int = 100_000,
    seed: int = 0,
    half_side: float | None = None,
) -> PointCloud:
    """Points that the training of a capture starts from.

    Args:
        capture: The capture.
        source: ``capture`` for the points that came with it, ``random`` for a cube, ``auto`` for the former if there
            are any and else the latter, or a file: .ply with points, .ply or .obj with a mesh.
        count: Number of points in the cube or on the mesh. Points of a capture or a file are all taken.
        seed: Of the random numbers.
        half_side: Half the side of the cube [scene units]. The default is what the median camera sees to either side
            of the point that all cameras look at.

    Returns:
        The points.

    Raises:
        ValueError: If the source does not exist or is not usable, or the cameras look at no common point.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"Expected `count` to be a positive whole number, but got {count!r}.")
    if source == "capture" or (source == "auto" and capture.points is not None):
        if capture.points is None or capture.colors is None:
            raise ValueError(
                f"The capture {capture.path} came with no points: set the initial points to random or to a file."
            )
        return PointCloud(capture.points, capture.colors)
    if source in ("auto", "random"):
        center, reach = _view_cube(capture) if half_side is None else (_focus(capture), half_side)
        return random_points(center, reach, count, seed)
    path = Path(source)
    if path.suffix.lower() == ".obj":
        return sample_mesh(*read_obj_mesh(path), count=count, seed=seed)
    if path.suffix.lower() == ".ply":
        vertices, faces = read_ply_points(path)
        return vertices if faces is None else sample_mesh(vertices, faces, count, seed)
    raise ValueError(f"Initial points cannot come from {source!s}: set auto, capture, random, or a .ply or .obj file.")


def random_points(center: Tensor, half_side: float, count: int, seed: int = 0) -> PointCloud:
    """Points of random colour, uniform in an upright cube.

    Args:
        center: Centre of the cube [scene units], shape (3,).
        half_side: Half its side [scene units].
        count: Number of points.
        seed: Of the random numbers.
    """
    check_vector("center", center)
    check_positive("half_side", half_side)
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(count, 6, generator=generator)
    return PointCloud(center.float() + half_side * (2 * draw[:, :3] - 1), draw[:, 3:].contiguous())


def _focus(capture: Capture) -> Tensor:
    """The point nearest to all optical axes, or an error if the cameras do not look at it."""
    cameras = [view.camera for view in capture.split("train")]
    focus = nearest_to_axes(cameras)
    ahead = 0
    for camera in cameras:
        ahead += bool((camera.world_to_camera[2, :3].double() @ focus + camera.world_to_camera[2, 3].double()) > 0)
    if not bool(torch.isfinite(focus).all()) or 2 * ahead <= len(cameras):
        raise ValueError(
            f"The cameras of {capture.path} look at no common point, so no cube for random initial points is known: "
            "set the initial points to a .ply or .obj file."
        )
    return focus


def _view_cube(capture: Capture) -> tuple[Tensor, float]:
    """Centre and half side of the cube that the median camera sees."""
    focus = _focus(capture)
    reach = []
    for view in capture.split("train"):
        camera = view.camera
        distance = math.dist(camera.position.tolist(), focus.tolist())
        across = 0.5 * camera.width / float(camera.intrinsics[0, 0])
        upward = 0.5 * camera.height / float(camera.intrinsics[1, 1])
        reach.append(distance * max(across, upward))
    return focus, sorted(reach)[len(reach) // 2]
