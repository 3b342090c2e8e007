"""Gaussians for viewers and other programs, in all formats: the one place that knows which is written how."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying._files import atomic
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.gltf import encode_gltf
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.losses import losses
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.gaussians.ply import check_folder, write_ply
from gaussian_swaying.gaussians.repair import OPAQUE_LOGIT, faults, repaired
from gaussian_swaying.gaussians.sog import encode_sog
from gaussian_swaying.gaussians.spz import encode_spz
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.rotations import quat_to_rotation

Format = Literal["ply", "compressed_ply", "splat", "spz", "sog", "glb", "usd"]
SUFFIXES: dict[str, str] = {
    "ply": ".ply",
    "compressed_ply": ".compressed.ply",
    "splat": ".splat",
    "spz": ".spz",
    "sog": ".sog",
    "glb": ".glb",
    "usd": ".usdc",
}
"""Formats, and the endings of their file names."""
_GSPLAT = {"compressed_ply": "ply_compressed", "splat": "splat"}
_PRIM = "/World/Gaussians"


def cleaned(path: Path, cloud: GaussianCloud) -> GaussianCloud:
    """Return a splat that every format can store.

    What has no meaning is left out with a warning, see :func:`~gaussian_swaying.gaussians.repair.repaired`. Logits of
    opacities are clamped to ±16, where float32 ends.

    Args:
        path: The file, for messages.
        cloud: The Gaussians.

    Returns:
        The same, or a smaller cloud, with quaternions of unit length.
    """
    kept = repaired(path, cloud, most=1)
    return replace(
        kept,
        quats=torch.nn.functional.normalize(kept.quats, dim=-1),
        opacities=kept.opacities.clamp(-OPAQUE_LOGIT, OPAQUE_LOGIT),
    )


def export_cloud(
    path: str | os.PathLike[str],
    cloud: GaussianCloud | DeformedGaussians,
    *,
    format: str | None = None,
    fps: float = 25.0,
    metres_per_unit: float = 1.0,
    rotation: Tensor | None = None,
    spz_version: int = 3,
) -> None:
    """Write Gaussians in one of several formats; the file gets its name only when it is complete.

    - ``ply``: as 3DGS stores them, with normals, see :func:`~gaussian_swaying.gaussians.ply.write_ply`.
    - ``compressed_ply``: PlayCanvas' format for SuperSplat, through gsplat: 16 bytes for each Gaussian, and harmonics
      with 8 bits each. Gaussians fainter than 1/255 are left out, their order changes, and there are no normals.
    - ``splat``: antimatter15's format, through gsplat: 32 bytes for each Gaussian. Colours are those of harmonics of
      degree 0; no normals.
    - ``spz``: Niantic's format, see :func:`~gaussian_swaying.gaussians.spz.encode_spz`.
    - ``sog``: PlayCanvas' format, see :func:`~gaussian_swaying.gaussians.sog.encode_sog`.
    - ``glb``: glTF with ``KHR_gaussian_splatting``, in metres with y up, see
      :func:`~gaussian_swaying.gaussians.gltf.encode_gltf`.
    - ``usd``: one frame, see :func:`write_usd`.

    Args:
        path: File to write; an existing one is replaced.
        cloud: Gaussians to write, see :func:`cleaned`; also those of a frame of a simulation.
        format: One of the above; by default that of the name's ending, see :func:`format_of`.
        fps: Frames per second, for USD.
        metres_per_unit: Length of a scene unit [m], for USD and glTF.
        rotation: Rotation from scene directions to z up, shape (3, 3), for USD and glTF; the scene's z is up if None.
        spz_version: Version of SPZ.

    Raises:
        FileNotFoundError: If the folder does not exist.
        ValueError: If the format is none of these or the ending unknown, no Gaussian is left, or the format cannot hold
            one of them.
        ImportError: If the format is ``usd`` and usd-core is not installed, or SPZ of version 4 and zstandard is not.

    Warns:
        UserWarning: If Gaussians were left out because they are not finite, and once with what the format cannot hold,
            counted (see :func:`~gaussian_swaying.gaussians.losses.losses`).
    """
    format = format_of(path) if format is None else format
    check_choice("format", format, tuple(SUFFIXES))
    path = Path(path)
    check_folder(path)
    kept = cleaned(path, cloud.to_cloud() if isinstance(cloud, DeformedGaussians) else cloud)
    if format == "usd":
        write_usd(path, [kept], fps, metres_per_unit=metres_per_unit, rotation=rotation)
    elif format == "ply":
        write_ply(path, kept)
    else:
        if format == "spz":
            content = encode_spz(kept, spz_version)
        elif format == "sog":
            content = encode_sog(kept)
        elif format == "glb":
            content = encode_gltf(kept, rotation, metres_per_unit)
        else:
            content = _gsplat_bytes(path, kept, format)
        with atomic(path) as temporary:
            temporary.write_bytes(content)
    told = losses(kept, format, spz_version)
    if told:
        warnings.warn(f"{path}: {'; '.join(told)}.", UserWarning, stacklevel=2)


def format_of(path: str | os.PathLike[str]) -> str:
    """The format that belongs to the ending of a file name."""
    name = Path(path).name
    for format, suffix in sorted(SUFFIXES.items(), key=lambda item: -len(item[1])):  # .compressed.ply before .ply
        if name.endswith(suffix):
            return format
    if name.endswith((".usd", ".usda")):
        return "usd"
    endings = ", ".join((*SUFFIXES.values(), ".usda"))
    raise ValueError(f"Cannot tell the format of {path}: give it a name that ends in one of {endings}.")


def export_frames(
    path: str | os.PathLike[str],
    clouds: Iterable[GaussianCloud],
    fps: float = 25.0,
    metres_per_unit: float = 1.0,
    rotation: Tensor | None = None,
    spz_version: int = 3,
) -> list[Path]:
    """Write the frames of a motion in the format given by the ending of a name, see :func:`format_of`.

    Args:
        path: File to write: for USD one with all frames, see :func:`write_usd`; otherwise its name has ``#`` in place
            of the digits of the frame, counted from 0: ``frame_####.spz`` makes frame_0000.spz, frame_0001.spz, ... Its
            folder is made.
        clouds: One for each frame; read one by one.
        fps: Frames per second, for USD.
        metres_per_unit: Length of a scene unit [m], for USD and glTF.
        rotation: Rotation from scene directions to z up, shape (3, 3), for USD and glTF; the scene's z is up if None.
        spz_version: Version of SPZ.

    Returns:
        The files.
    """
    target = Path(path)
    format = format_of(target)
    if format != "usd" and "#" not in target.name:
        raise ValueError(
            f"The frames of a run need a file each: give a target with # for their numbers, such as "
            f"frame_####{SUFFIXES[format]}, or one that ends in .usdc."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    place: dict[str, Any] = {"metres_per_unit": metres_per_unit, "rotation": rotation}
    if format == "usd":
        write_usd(target, clouds, fps, **place)
        return [target]
    files = []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for index, cloud in enumerate(clouds):
            files.append(target.with_name(numbered(target.name, str(index))))
            export_cloud(files[-1], cloud, format=format, spz_version=spz_version, **place)
    if told:
        more = f" {len(told)} warnings like this in {len(files)} files." if len(told) > 1 else ""
        warnings.warn(f"{told[0].message}{more}", UserWarning, stacklevel=2)
    return files


def numbered(name: str, number: str) -> str:
    """A name with a number, filled up with zeros, in place of each row of ``#``."""
    return re.sub("#+", lambda digits: number.rjust(len(digits[0]), "0"), name)


def _gsplat_bytes(path: Path, cloud: GaussianCloud, format: str) -> bytes:
    """The file as gsplat's exporter makes it, from float32 tensors on the CPU."""
    from gsplat.exporter import export_splats

    host = cloud.to("cpu", torch.float32)
    if format == "compressed_ply":
        visible = host.opacities.sigmoid() > 1 / 255  # the exporter leaves the others out, and fails if none is left
        if not bool(visible.any()):
            raise ValueError(f"{path} was not written because all Gaussians are fainter than 1/255.")
    data: bytes = export_splats(
        means=host.means,
        scales=host.scales,
        quats=host.quats,
        opacities=host.opacities,
        sh0=host.sh[:, :1],
        shN=host.sh[:, 1:],
        format=_GSPLAT[format],
    )
    if format == "compressed_ply" and host.sh_degree == 0:  # an element without properties, which breaks readers
        head, mark, body = data.partition(b"end_header\n")
        data = re.sub(rb"element sh \d+\n", b"", head) + mark + body
    return data


# ---- USD


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
        path: File to write; an existing one is replaced.
        clouds: One for each frame, all of the same size; read one by one.
        fps: Frames per second.
        start: Number of the first frame.
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

    Args:
        cloud: N Gaussians with K harmonics each.

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
