"""Gaussians as USD, still or moving."""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._files import atomic
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.repair import faults
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.rotations import quat_to_rotation

_PRIM = "/World/Gaussians"


def write_usd(
    path: str | os.PathLike[str],
    clouds: Iterable[GaussianCloud],
    fps: float = 25.0,
    start: int = 0,
    metres_per_unit: float = 1.0,
    rotation: Tensor | None = None,
) -> None:
    """Write static or moving Gaussians as USD (.usd, .usdc or .usda).

    The prim is a ``ParticleField3DGaussianSplat`` with positions, orientations, scales, opacities and harmonics, with
    values after exponential and sigmoid, and normals. Each number that changes has a sample for every frame. For
    programs that cannot draw splats there are ``displayColor`` and ``displayOpacity``.

    Args:
        clouds: One for each frame, all of the same size; read one by one.
        metres_per_unit: Length of a scene unit [m].
        rotation: Rotation from scene directions to z up, shape (3, 3); the scene's z is up if None.
    """
    check_positive("fps", fps)
    check_positive("metres_per_unit", metres_per_unit)
    film, origin = None, NO_ORIGIN
    for frame, cloud in enumerate(clouds, start):
        if film is None:
            film, origin = UsdFilm(fps, metres_per_unit, rotation, cloud.origin), cloud.origin
        film.add(frame, usd_arrays(cloud.rebased(origin)))
    if film is None:
        raise ValueError(f"{path} was not written because there are no frames; give at least one cloud.")
    film.save(path)


def usd_arrays(cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """The arrays of a splat for a USD prim, float32.

    A Gaussian of a moving splat cannot be left out of a frame, so one that is not finite becomes a transparent point at
    the origin.

    Returns:
        ``positions`` (N, 3), ``orientations`` (N, 4) wxyz, ``scales`` (N, 3) and ``opacities`` (N,) as displayed,
        ``harmonics`` (N, K, 3), ``normals`` (N, 3) and ``colors`` (N, 3), those of harmonics of degree 0.
    """
    host = cloud.to("cpu", torch.float32)
    bad = torch.stack([*faults(host).values()]).any(0)
    neutral = torch.tensor([1.0, 0.0, 0.0, 0.0])
    quats = torch.nn.functional.normalize(torch.where(bad[:, None], neutral, host.quats), dim=-1)
    scales = torch.where(bad[:, None], 0.0, host.scales)
    sh = torch.where(bad[:, None, None], 0.0, host.sh)
    normals = smallest_axis_normal(quats, scales) if host.normals is None else host.normals
    arrays = {
        "positions": torch.where(bad[:, None], 0.0, host.means),
        "orientations": quats,
        "scales": scales.exp(),
        "opacities": torch.where(bad, 0.0, host.opacities.sigmoid()),
        "harmonics": sh,
        "normals": torch.where(bad[:, None], torch.tensor([0.0, 0.0, 1.0]), normals),
        "colors": sh_to_color(sh[:, :1], torch.ones_like(host.means)).clamp(0, 1),
    }
    return {name: np.ascontiguousarray(value.detach().numpy()) for name, value in arrays.items()}


class UsdFilm:
    """A USD stage to which frames are added one by one.

    The whole film is in memory until it is saved, about 60 bytes for each Gaussian and frame without view-dependent
    colours.

    Args:
        fps: Frames per second.
        metres_per_unit: Length of a scene unit [m].
        rotation: Rotation from scene directions to z up, shape (3, 3); the scene's z is up if None.
        origin: Point that the centres count from, see :class:`~gaussian_swaying.gaussians.cloud.GaussianCloud`.

    Raises:
        ImportError: If usd-core is not installed, or has no splats yet.
    """

    def __init__(
        self, fps: float, metres_per_unit: float = 1.0, rotation: Tensor | None = None, origin: Origin = NO_ORIGIN
    ) -> None:
        usd, geom = _pxr("Usd"), _pxr("UsdGeom")
        splat = getattr(_pxr("UsdVol"), "ParticleField3DGaussianSplat", None)
        if splat is None:
            raise ImportError("usd-core before 26.3 has no splats: run pip install -U usd-core.", name="pxr")
        self._stage = usd.Stage.CreateInMemory()
        geom.SetStageUpAxis(self._stage, geom.Tokens.z)
        geom.SetStageMetersPerUnit(self._stage, metres_per_unit)
        self._stage.SetTimeCodesPerSecond(fps)
        self._stage.SetFramesPerSecond(fps)
        world = geom.Xform.Define(self._stage, "/World")
        self._stage.SetDefaultPrim(world.GetPrim())
        if rotation is not None or any(origin):
            Gf = _pxr("Gf")
            turn = torch.eye(3, dtype=torch.float64) if rotation is None else rotation.double()
            matrix = Gf.Matrix4d(1.0)
            matrix.SetRotateOnly(Gf.Matrix3d(*turn.T.flatten().tolist()))  # USD multiplies rows
            matrix.SetTranslateOnly(Gf.Vec3d(*(turn @ torch.tensor(origin, dtype=torch.float64)).tolist()))
            world.AddTransformOp().Set(matrix)
        self._prim = splat.Define(self._stage, _PRIM)
        self._last: dict[str, tuple[int, np.ndarray]] = {}
        self._first: int | None = None
        self._end = 0

    def add(self, frame: int, arrays: dict[str, np.ndarray]) -> None:
        """Add a frame as arrays from :func:`usd_arrays`; add frames in order."""
        if self._first is None:
            self._first = self._end = frame
            self._stage.SetStartTimeCode(frame)
            self._create(arrays)
        elif len(arrays["positions"]) != len(self._last["positions"][1]):
            raise ValueError(f"Frame {frame} has another number of Gaussians than frame {self._first}.")
        for name, array in arrays.items():
            written, last = self._last.get(name, (frame, None))
            if last is not None and np.array_equal(array, last):
                continue
            if last is not None and written < self._end:  # it was constant up to the previous frame
                self._set(name, last, self._end)
            self._set(name, array, frame)
            self._last[name] = (frame, array)
        low, high = _extent(arrays)
        self._prim.GetExtentAttr().Set(_vec3(np.stack([low, high])), frame)
        self._stage.SetEndTimeCode(frame)
        self._end = frame

    def save(self, path: str | os.PathLike[str]) -> None:
        with atomic(Path(path)) as temporary:
            self._stage.GetRootLayer().Export(str(temporary))

    def _create(self, arrays: dict[str, np.ndarray]) -> None:
        geom, prim = _pxr("UsdGeom"), self._prim.GetPrim()
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(round(arrays["harmonics"].shape[1] ** 0.5) - 1)
        kind = _pxr("Sdf").ValueTypeNames.Normal3fArray
        self._normals = geom.PrimvarsAPI(prim).CreatePrimvar("normals", kind, geom.Tokens.vertex).GetAttr()
        for primvar in (self._prim.CreateDisplayColorPrimvar(), self._prim.CreateDisplayOpacityPrimvar()):
            primvar.SetInterpolation(geom.Tokens.vertex)

    def _set(self, name: str, array: np.ndarray, frame: int) -> None:
        Vt, prim = _pxr("Vt"), self._prim.GetPrim()
        if name == "orientations":
            prim.GetAttribute(name).Set(Vt.QuatfArray.FromNumpy(array[:, [1, 2, 3, 0]]), frame)
        elif name == "opacities":
            values = Vt.FloatArray.FromNumpy(array)
            prim.GetAttribute(name).Set(values, frame)
            self._prim.GetDisplayOpacityAttr().Set(values, frame)
        elif name == "harmonics":
            prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Set(_vec3(array.reshape(-1, 3)), frame)
        elif name == "colors":
            self._prim.GetDisplayColorAttr().Set(_vec3(array), frame)
        elif name == "normals":
            self._normals.Set(_vec3(array), frame)
        else:
            prim.GetAttribute(name).Set(_vec3(array), frame)


def _pxr(name: str) -> Any:
    try:
        return import_module(f"pxr.{name}")
    except ImportError as error:
        raise ImportError(
            "USD files need usd-core: run pip install 'gaussian-swaying[usd]', or choose another format.", name="pxr"
        ) from error


def _vec3(array: np.ndarray) -> Any:
    return _pxr("Vt").Vec3fArray.FromNumpy(np.ascontiguousarray(array, dtype=np.float32))


def _extent(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    axes = quat_to_rotation(torch.from_numpy(arrays["orientations"])).numpy()
    reach = 3 * np.sqrt(np.square(axes * arrays["scales"][:, None, :]).sum(-1))
    return (arrays["positions"] - reach).min(0), (arrays["positions"] + reach).max(0)
