"""A capture made in code: photographs of a rippled flag with a known surface."""

from __future__ import annotations

import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as functional
from einops import rearrange
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_whole
from gaussian_swaying._files import PNG
from gaussian_swaying.rendering.cameras.camera import Camera, check_fov, look_at_camera

_STEPS = 24  # samples along a ray, to find the interval of the first crossing
_LIGHT = (0.4, -0.8, 0.45)


@dataclass(eq=False)
class GeneratedCapture:
    """Photographs of a rippled, patterned flag from all around, with its true normals and area.

    The flag is the sheet y = f(x, z) over 0 <= x <= ``width``, 0 <= z <= ``height``, in metres, a ripple that grows
    from the pole side at x = 0. It is drawn by intersecting a ray with the sheet for each sample of each pixel, so the
    images show the true surface and not a splat. Light is baked into the colours and is the same for both sides and all
    cameras. The cameras are spread evenly on a sphere around the flag, from 35 degrees below to 60 above, with z up.

    Args:
        views: Number of images.
        size: Width and height of the images [pixels].
        width: Length of the flag along x [m].
        height: Length along z [m].
        ripple: Amplitude of the ripple at the free end [m].
        waves: Number of waves along x.
        distance: Of the cameras from the centre of the flag [m].
        fov: Field of view [degrees].
        samples: Each pixel is the mean of ``samples`` x ``samples`` samples.
        seed: Seed of the pattern and of the positions of the cameras.

    Raises:
        ValueError: If a number is out of range.
    """

    views: int = 60
    size: int = 400
    width: float = 1.2
    height: float = 0.8
    ripple: float = 0.08
    waves: float = 1.5
    distance: float = 2.2
    fov: float = 40.0
    samples: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("views", "size", "samples"):
            check_whole(name, getattr(self, name), 1)
        for name in ("width", "height", "waves", "distance", "ripple"):
            check_positive(name, getattr(self, name), allow_zero=name == "ripple")
        check_fov("fov", self.fov)
        if self.distance <= math.hypot(0.5 * self.width, self.ripple, 0.5 * self.height):
            raise ValueError(f"Expected `distance` to keep the cameras outside the flag, but got {self.distance} m.")
        generator = torch.Generator().manual_seed(self.seed)
        self._phase = 2 * math.pi * float(torch.rand((), generator=generator))
        self._turn = 2 * math.pi * float(torch.rand((), generator=generator))
        self._waves = (torch.rand(6, 3, generator=generator) * torch.tensor([40.0, 40.0, 2 * math.pi])).tolist()

    # ---- the sheet

    def _ripple(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor, float, float]:
        """Phase of the ripple, its amplitude [m], and the slopes of the phase along x and z [1/m]."""
        k, tilt = 2 * math.pi * self.waves / self.width, 1.2 / self.height
        return k * x + tilt * z + self._phase, (self.ripple / self.width) * x, k, tilt

    def elevation(self, x: Tensor, z: Tensor) -> Tensor:
        """The height y = f(x, z) of the sheet [m], of the shape of ``x``."""
        phase, amplitude, _, _ = self._ripple(x, z)
        return amplitude * torch.sin(phase)

    def slopes(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of :meth:`elevation` along x and z, each of the shape of ``x``."""
        phase, amplitude, k, tilt = self._ripple(x, z)
        turned = amplitude * torch.cos(phase)
        return (self.ripple / self.width) * torch.sin(phase) + k * turned, tilt * turned

    def normals(self, x: Tensor, z: Tensor) -> Tensor:
        """Unit normals on the -y side, shape (..., 3)."""
        along, upward = self.slopes(x, z)
        return functional.normalize(torch.stack([along, -torch.ones_like(along), upward], -1), dim=-1)

    def colors(self, x: Tensor, z: Tensor) -> Tensor:
        """Colours in 0 to 1 that a camera sees: a pattern times diffuse light, shape (..., 3)."""
        u, v = x / self.width, z / self.height
        bands = x.new_tensor([[0.83, 0.30, 0.18], [0.95, 0.92, 0.85], [0.13, 0.33, 0.55]])
        band = ((1 - v) * 3).long().clamp(0, 2)
        pattern = bands[band]
        disc = torch.hypot(x - 0.5 * self.width, z - 0.5 * self.height) < 0.2 * self.height
        pattern = torch.where(disc[..., None], x.new_tensor([0.93, 0.68, 0.20]), pattern)
        checks = ((u * 24).floor() + (v * 16).floor()) % 2
        weave = sum(torch.sin(a * u + b * v + phase) for a, b, phase in self._waves) / len(self._waves)
        light = functional.normalize(x.new_tensor(_LIGHT), dim=0)
        shade = 0.4 + 0.6 * (self.normals(x, z) @ light).abs()
        return (pattern * ((0.8 + 0.2 * checks + 0.12 * weave) * shade)[..., None]).clamp(0, 1)

    # ---- the pictures

    def cameras(self) -> list[Camera]:
        """The cameras, in float64, in the order of the images."""
        center = (0.5 * self.width, 0.0, 0.5 * self.height)
        low, high = math.sin(math.radians(-35.0)), math.sin(math.radians(60.0))
        cameras = []
        for index in range(self.views):
            # two irrational steps, so that all views, and also every eighth of them, are spread evenly
            share = ((index + 0.5) * 0.5 * (math.sqrt(5) - 1)) % 1.0
            sine = low + (high - low) * share
            azimuth = self._turn + 2 * math.pi * ((index * (math.sqrt(2) - 1)) % 1.0)
            flat = math.sqrt(1 - sine * sine)
            ray = (flat * math.cos(azimuth), flat * math.sin(azimuth), sine)
            eye = [c + self.distance * r for c, r in zip(center, ray, strict=True)]
            up = (0.0, 0.0, 1.0)
            cameras.append(look_at_camera(eye, center, up, self.fov, self.size, self.size, dtype=torch.float64))
        return cameras

    def render(self, camera: Camera) -> Tensor:
        """Draw the sheet by ray casting.

        Returns:
            Colours in 0 to 1, multiplied with alpha, and alpha, each averaged over the pixel, shape (H, W, 4).
        """
        n = self.samples
        column = (torch.arange(camera.width * n, dtype=torch.float64) + 0.5) / n
        row = (torch.arange(camera.height * n, dtype=torch.float64) + 0.5) / n
        hit, x, z = self._cast(camera, row, column)
        packed = torch.zeros(*hit.shape, 4)
        packed[hit] = functional.pad(self.colors(x[hit], z[hit]), (0, 1), value=1.0)
        return rearrange(functional.avg_pool2d(rearrange(packed, "h w c -> 1 c h w"), n), "1 c h w -> h w c")

    def _cast(self, camera: Camera, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cast rays at the sheet; return hit or not, and x and z of the hit, each of shape (rows, columns)."""
        intrinsics, view = camera.intrinsics.double(), camera.world_to_camera.double()
        v, u = torch.meshgrid(
            (row - intrinsics[1, 2]) / intrinsics[1, 1], (column - intrinsics[0, 2]) / intrinsics[0, 0], indexing="ij"
        )
        rays = (torch.stack([u, v, torch.ones_like(u)], -1) @ view[:3, :3]).float().reshape(-1, 3)  # at depth 1
        eye = camera.position.double().float()
        # where the ray is inside the box of the flag
        slack = 1.0001 * self.ripple + 1e-5
        low, high = eye.new_tensor([0.0, -slack, 0.0]), eye.new_tensor([self.width, slack, self.height])
        safe = torch.where(rays.abs() < 1e-9, torch.full_like(rays, 1e-9), rays)
        bounds = torch.stack([(low - eye) / safe, (high - eye) / safe])
        enter, leave = bounds.amin(0).amax(-1).clamp_min(camera.near), bounds.amax(0).amin(-1)
        inside = (enter < leave).nonzero()[:, 0]
        hit = torch.zeros(len(rays), dtype=torch.bool)
        x, z = torch.zeros(2, len(rays))
        for chunk in inside.split(1 << 17):
            crosses, t = self._first_crossing(eye, rays[chunk], enter[chunk], leave[chunk])
            met = chunk[crosses]
            place = eye + t[:, None] * rays[met]
            hit[met], x[met], z[met] = True, place[:, 0], place[:, 2]
        return hit.view_as(v), x.view_as(v), z.view_as(v)

    def _first_crossing(self, eye: Tensor, rays: Tensor, enter: Tensor, leave: Tensor) -> tuple[Tensor, Tensor]:
        def above(t: Tensor, rays: Tensor) -> Tensor:
            x, y, z = (eye[axis] + t * rays[:, axis] for axis in range(3))
            return y - self.elevation(x, z)

        values = above(enter + torch.linspace(0, 1, _STEPS + 1)[:, None] * (leave - enter), rays)
        change = (values[:-1] > 0) != (values[1:] > 0)
        crosses, first = change.any(0), change.int().argmax(0)
        rays, enter, width, first = rays[crosses], enter[crosses], ((leave - enter) / _STEPS)[crosses], first[crosses]
        left = enter + first * width
        right = left + width
        side = above(left, rays) > 0
        for _ in range(12):
            middle = 0.5 * (left + right)
            before = (above(middle, rays) > 0) == side
            left, right = torch.where(before, middle, left), torch.where(before, right, middle)
        return crosses, 0.5 * (left + right)

    # ---- files

    def write(self, folder: str | os.PathLike[str], threads: int = 2) -> Path:
        """Write the capture: ``images/`` and ``transforms.json``.

        Images are PNG with alpha; colours are not multiplied with it. ``transforms.json`` is written last.
        """
        from imageio.v3 import imwrite

        folder = Path(folder)
        if folder.exists() and any(folder.iterdir()):
            raise ValueError(f"{folder} is not empty: give a new folder for the generated capture.")
        (folder / "images").mkdir(parents=True, exist_ok=True)
        cameras = self.cameras()

        def draw(index: int) -> dict[str, object]:
            camera = cameras[index]
            packed = self.render(camera)
            packed[..., :3] = (packed[..., :3] / packed[..., 3:].clamp_min(1e-6)).clamp(0, 1)
            pixels = packed.mul(255).round().to(torch.uint8)
            imwrite(folder / "images" / f"{index:04d}.png", pixels.numpy(), **PNG)
            pose = torch.linalg.inv(camera.world_to_camera) * torch.tensor([1.0, -1.0, -1.0, 1.0]).double()
            return {"file_path": f"images/{index:04d}.png", "transform_matrix": pose.tolist()}

        with ThreadPoolExecutor(max(threads, 1)) as pool:
            frames = list(pool.map(draw, range(self.views)))
        focal = float(cameras[0].intrinsics[0, 0])
        fields: dict[str, object] = {"camera_angle_x": math.radians(self.fov), "fl_x": focal, "fl_y": focal}
        fields |= {"cx": 0.5 * self.size, "cy": 0.5 * self.size, "w": self.size, "h": self.size, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(fields, indent=1), encoding="utf-8")
        return folder
