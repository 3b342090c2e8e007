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
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.rotations import quat_to_rotation

_PRIM = "/World/Gaussians"
_SEEN = 1e-3  # changes below leave no sample


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
    values after exponential and sigmoid, and normals. What changes has a sample for every frame; rotations, scales and
    normals only when a shape or a normal has changed by a thousandth. For programs that cannot draw splats there are
    ``displayColor`` and ``displayOpacity``.

    Args:
        clouds: One for each frame, all of the same size; read one by one.
        metres_per_unit: Length of a scene unit [m].
        rotation: Rotation from scene directions to z up, shape (3, 3); the scene's z is up if None.
    """
    check_positive("fps", fps)
    check_positive("metres_per_unit", metres_per_unit)
    last, origin, frame = dict[str, tuple[int, dict[str, np.ndarray]]](), NO_ORIGIN, start - 1
    stage: Any = None
    for frame, cloud in enumerate(clouds, start):
        if stage is None:
            origin = cloud.origin
            stage, prim, attributes = _stage(cloud.sh_degree, fps, metres_per_unit, rotation, origin)
            stage.SetStartTimeCode(frame)
        arrays = usd_arrays(cloud.rebased(origin))
        if last and len(arrays["positions"]) != len(last["positions"][1]["positions"]):
            raise ValueError(f"Frame {frame} has another number of Gaussians than frame {start}.")
        for name, array in arrays.items():
            written, before = last.get(name, (frame, None))
            if before is not None and _alike(name, arrays, before):
                continue
            if before is not None and np.array_equal(array, before[name]):  # but others of the shape are not
                last[name] = (written, arrays)
                continue
            constant = [(before[name], frame - 1)] if before is not None and written < frame - 1 else []
            for value, time in [*constant, (array, frame)]:
                for attribute in attributes[name]:
                    attribute.Set(_values(name, value), time)
            last[name] = (frame, arrays)
        prim.GetExtentAttr().Set(_values("extent", np.stack(_extent(arrays))), frame)
    if stage is None:
        raise ValueError(f"{path} was not written because there are no frames; give at least one cloud.")
    stage.SetEndTimeCode(frame)
    with atomic(Path(path)) as temporary:
        stage.GetRootLayer().Export(str(temporary))


def _stage(
    degree: int, fps: float, metres_per_unit: float, rotation: Tensor | None, origin: Origin
) -> tuple[Any, Any, dict[str, list[Any]]]:
    """A stage, its splat, and the attributes that each of :func:`usd_arrays` sets."""
    usd, geom, splat = _pxr("Usd"), _pxr("UsdGeom"), getattr(_pxr("UsdVol"), "ParticleField3DGaussianSplat", None)
    if splat is None:
        raise ImportError("usd-core before 26.3 has no splats: run pip install -U usd-core.", name="pxr")
    stage = usd.Stage.CreateInMemory()
    geom.SetStageUpAxis(stage, geom.Tokens.z)
    geom.SetStageMetersPerUnit(stage, metres_per_unit)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    world = geom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    if rotation is not None or any(origin):
        Gf = _pxr("Gf")
        turn = torch.eye(3, dtype=torch.float64) if rotation is None else rotation.double()
        matrix = Gf.Matrix4d(1.0)
        matrix.SetRotateOnly(Gf.Matrix3d(*turn.T.flatten().tolist()))  # USD multiplies rows
        matrix.SetTranslateOnly(Gf.Vec3d(*(turn @ torch.tensor(origin, dtype=torch.float64)).tolist()))
        world.AddTransformOp().Set(matrix)
    made = splat.Define(stage, _PRIM)
    prim, kind = made.GetPrim(), _pxr("Sdf").ValueTypeNames.Normal3fArray
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(degree)
    shown = made.CreateDisplayColorPrimvar(), made.CreateDisplayOpacityPrimvar()
    for primvar in shown:
        primvar.SetInterpolation(geom.Tokens.vertex)
    attributes = {name: [prim.GetAttribute(name)] for name in ("positions", "orientations", "scales", "opacities")}
    attributes["opacities"].append(shown[1].GetAttr())
    attributes["harmonics"] = [prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")]
    attributes["normals"] = [geom.PrimvarsAPI(prim).CreatePrimvar("normals", kind, geom.Tokens.vertex).GetAttr()]
    return stage, made, attributes | {"colors": [shown[0].GetAttr()]}


def _values(name: str, array: np.ndarray) -> Any:
    """An array as USD has it: quaternions, numbers or vectors."""
    Vt = _pxr("Vt")
    if name == "orientations":
        return Vt.QuatfArray.FromNumpy(array[:, [1, 2, 3, 0]])
    if name == "opacities":
        return Vt.FloatArray.FromNumpy(array)
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(array.reshape(-1, 3), dtype=np.float32))


def _alike(name: str, now: dict[str, np.ndarray], before: dict[str, np.ndarray]) -> bool:
    """Whether numbers look the same: the shapes of rotations and scales, of which one has several, and normals."""
    if name == "normals":
        return bool(np.abs(now[name] - before[name]).max(initial=0.0) < _SEEN)
    if name not in ("orientations", "scales"):
        return np.array_equal(now[name], before[name])
    own, other = (
        covariance(torch.from_numpy(one["orientations"]).double(), torch.from_numpy(one["scales"]).double().log())
        for one in (now, before)
    )
    size = torch.from_numpy(before["scales"]).double().amax(1) ** 2
    return bool(((own - other).abs().amax((1, 2)) <= _SEEN * size).all())


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


def _pxr(name: str) -> Any:
    try:
        return import_module(f"pxr.{name}")
    except ImportError as error:
        raise ImportError(
            "USD files need usd-core: run pip install 'gaussian-swaying[usd]', or choose another format.", name="pxr"
        ) from error


def _extent(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    axes = quat_to_rotation(torch.from_numpy(arrays["orientations"])).numpy()
    reach = 3 * np.sqrt(np.square(axes * arrays["scales"][:, None, :]).sum(-1))
    return (arrays["positions"] - reach).min(0), (arrays["positions"] + reach).max(0)
