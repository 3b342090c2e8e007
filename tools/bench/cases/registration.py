"""What ``bench.py registration`` measures: cameras of pictures in another light, found from the splat and no pose."""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from bench.case import Case, Measurement, option
from bench.record import Row
from gaussian_swaying.cli.register import VIEW, first_cameras, fov_of, painter_of
from gaussian_swaying.fitting.registration import register
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.scenes.procedural import FlagScene

WIDTH, HEIGHT, FOV = 270, 480, 55.0
WANTED = {"degrees": 0.5, "distance": 0.01}
"""What is wanted of every camera: its angle, and its place per distance."""


def printed_flag() -> GaussianCloud:
    """A flag with features everywhere, which bulges."""
    return FlagScene(spacing=0.008, pattern="printed", ripple=0.06).generate()


def hidden(cloud: GaussianCloud, up: list[float], number: int) -> tuple[Camera, float]:
    """A camera that is to be found, and its distance to the object; from in front of a flag or behind it."""
    drawn = torch.Generator().manual_seed(number)
    turn, rise, far = torch.rand(3, generator=drawn, dtype=torch.float64).tolist()
    (near, *_) = first_cameras(cloud, up, FOV, WIDTH, HEIGHT)
    rotation = near.world_to_camera[:3, :3]
    reach = float((rotation @ cloud.means.double().median(0).values + near.world_to_camera[:3, 3])[2])
    middle = near.position + reach * rotation[2]
    flat = cloud.means.double().std(0).argmin()
    axis = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    front = torch.eye(3, dtype=torch.float64)[flat]
    side = torch.linalg.cross(axis, front)
    angle, high = math.radians(100 * turn - 50) + math.pi * (number % 2), math.radians(30 * rise)
    way = math.cos(high) * (math.cos(angle) * front + math.sin(angle) * side) + math.sin(high) * axis
    distance = (0.8 + 0.4 * far) * reach
    eye = middle + distance * way
    return look_at_camera(eye, middle, axis, FOV, WIDTH, HEIGHT, dtype=torch.float64), distance


def measured(cloud: GaussianCloud, up: list[float], poses: int, focal: bool) -> Row:
    """Cameras of some pictures, darker to one side, warmer and of another contrast."""
    draw, found = painter_of(cloud), []
    for number in range(poses):
        truth, distance = hidden(cloud, up, number)
        light = torch.linspace(1.0, 0.5, WIDTH)[None, :, None] * torch.tensor([1.0, 0.9, 0.7])
        frame = (255 * (light * draw(truth).color.clamp(0, 1) ** 1.2)).round().to(torch.uint8)
        start = first_cameras(cloud, up, VIEW if focal else FOV, WIDTH, HEIGHT)
        began = time.perf_counter()
        try:
            camera = register(draw, frame, start, focal=focal).camera
        except ValueError as error:
            found.append({"failed": str(error), "seconds": time.perf_counter() - began})
            continue
        turn = camera.world_to_camera[:3, :3] @ truth.world_to_camera[:3, :3].T
        angle = math.degrees(math.acos(max(-1.0, min(1.0, float((turn.trace() - 1) / 2)))))
        off = float((camera.position - truth.position).norm()) / distance
        row = {"degrees": angle, "distance": off, "fov": fov_of(camera) / FOV - 1}
        found.append(row | {"seconds": time.perf_counter() - began})
    right = [row for row in found if all(row.get(name, math.inf) <= most for name, most in WANTED.items())]
    known = [row for row in found if "failed" not in row]
    middle = {name: statistics.median(row[name] for row in known) if known else None for name in WANTED}
    largest = {f"most_{name}": max((row[name] for row in known), default=None) for name in WANTED}
    seconds = statistics.median(row["seconds"] for row in found)
    return {"poses": poses, "right": len(right), "found": found, "seconds": seconds, "focal": focal} | middle | largest


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The flag made in code, and the captures, with the field of view known and found."""
    clouds = {"printed flag": (printed_flag, [0.0, 0.0, 1.0])}
    for file in options.ply:
        clouds[Path(file).stem] = (partial(read_gaussians, file, 0), [0.0, -1.0, 0.0])
    for name, (make, up) in clouds.items():
        for focal in (False, True):
            work = partial(_one, make, up, options.poses, focal)
            yield ("rows", {"object": name, "field of view": "found" if focal else "known"}), work


def _one(make: partial[GaussianCloud], up: list[float], poses: int, focal: bool) -> Row:
    return measured(make(), up, poses, focal)


CASE = Case(
    "Measure how well the camera of a picture is found from a splat and no pose.",
    rows,
    (
        option("--ply", "a captured splat, y down; repeatable", action="append", default=[]),
        option("--poses", "cameras that are to be found", type=int, default=12),
    ),
    page="fit.md",
    device=False,
)
