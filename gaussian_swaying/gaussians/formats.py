"""Splats in files: the one table that knows which format is read and written how."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice
from gaussian_swaying._files import atomic
from gaussian_swaying._inputs import check_regular
from gaussian_swaying._ply_table import read_header
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import CHUNK, read_compressed_ply, read_splat
from gaussian_swaying.gaussians.gltf import encode_gltf, read_gltf
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.gaussians.ply import check_folder, read_ply, write_ply
from gaussian_swaying.gaussians.repair import OPAQUE_LOGIT, repaired
from gaussian_swaying.gaussians.sog import PALETTE, encode_sog, read_sog
from gaussian_swaying.gaussians.spz import COLOR_SCALE, encode_spz, fraction_bits, read_spz
from gaussian_swaying.gaussians.usd import write_usd

_PAGES = (b"<!doctype", b"<html", b"<?xml")
_FAINTEST = 1 / 255  # opacity that a compressed .ply leaves out
_SLACK = 1e-4  # a number at the end of a range is in it


@dataclass(frozen=True)
class Format:
    """How a splat is stored in a file, and what it cannot hold.

    Args:
        endings: Endings of the names of its files, the usual one first.
        read: Reads the Gaussians of a path; None if the format is only written.
        encode: Makes the content of a file of a cloud; None if the format is only read, or has ``write``.
        write: Writes to a path itself: a large file, or a film.
        begins: What a file begins with, in small letters.
        beside: Endings of files that are read with others beside them.
        options: Arguments of :func:`export_cloud` that ``encode`` or ``write`` takes.
        film: Whether a file holds all frames of a motion, and ``write`` takes a cloud for each.
        small: Logarithm of the smallest size.
        large: Logarithm of the largest.
        color: Largest harmonic of degree 0.
        harmonics: Largest one above; 0 if it has none.
        faintest: Opacity of Gaussians that it leaves out.
        sets: Number of sets of harmonics.
        origin: Whether it keeps the point that centres count from.
        steps: Distance between the places that a centre can have [scene units], shape (N,), from a cloud of N and the
            options; None if they are those of float32.
    """

    endings: tuple[str, ...]
    read: Any = None
    encode: Any = None
    _: KW_ONLY
    write: Any = None
    begins: tuple[bytes, ...] = ()
    beside: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    film: bool = False
    small: float = -math.inf
    large: float = math.inf
    color: float = math.inf
    harmonics: float = math.inf
    faintest: float = 0.0
    sets: float = math.inf
    origin: bool = False
    steps: Callable[..., Tensor] | None = None

    @property
    def in_metres(self) -> bool:
        """True if the format stores the up direction and the length of a unit."""
        return "rotation" in self.options

    def losses(self, cloud: GaussianCloud, **options: object) -> list[str]:
        """What a file of this format will lose of a cloud, with counts: one phrase per kind."""
        told, count, cloud = list[str](), len(cloud), cloud.to("cpu", torch.float32)
        low, high, most, faintest = self.small, self.large, self.harmonics, self.faintest
        thin, wide = cloud.scales.amin(-1), cloud.scales.amax(-1)
        rest = cloud.sh.new_zeros(count, 1) if cloud.sh_degree == 0 or not most else cloud.sh[:, 1:].flatten(1).abs()
        steps = torch.zeros(count) if self.steps is None else self.steps(cloud, **options)
        factor = math.exp(min(low - float(thin.min()), 700))
        for lost, what in (
            (cloud.opacities.sigmoid() <= faintest, f"are fainter than {faintest:.2g} and left out"),
            (thin < low - _SLACK, f"have a size below {math.exp(low):.2g}, which becomes that: up to {factor:.3g} "
             "times as thick (scale the scene up, or choose .glb or .sog)"),
            (wide > high + _SLACK, f"have a size above {math.exp(min(high, 700)):.3g}, which becomes that: the largest "
             f"is {math.exp(float(wide.max())):.3g}"),
            (cloud.sh[:, 0].abs().amax(-1) > self.color + _SLACK, "have a colour that is cut off"),
            (rest.amax(-1) > most + _SLACK,
             f"have harmonics up to ±{float(rest.max()):.3g}, which are cut off at ±{most:g}"),
            (wide.exp() < steps, f"are smaller than the steps of their centres, {float(steps.max()):.3g} and less"),
        ):  # fmt: skip
            if bool(lost.any()):
                told.append(f"{int(lost.sum()):,} of {count:,} Gaussians {what}")
        if cloud.sh_degree and not most:
            told.append("harmonics of degree 1 and above are left out")
        if cloud.sh_degree and count > self.sets:
            told.append(f"the harmonics of {count:,} Gaussians share {self.sets:,} sets")
        if any(cloud.origin) and not self.origin:
            told.append(f"centres count from {list(cloud.origin)}, which the file does not hold")
        return told


def _steps_of_spz(cloud: GaussianCloud, spz_version: int) -> Tensor:
    farthest = float(cloud.means.double().abs().max())
    return torch.full_like(cloud.opacities, 2.0 ** -fraction_bits(farthest), dtype=torch.float64)


def _steps_of_sog(cloud: GaussianCloud) -> Tensor:
    places = cloud.means.double().abs()
    logs = cloud.means.double().sign() * places.log1p()
    return ((logs.amax(0) - logs.amin(0)) / 65535 * (1 + places)).amax(-1)


def _steps_of_chunks(cloud: GaussianCloud) -> Tensor:
    """Those of a compressed .ply: a chunk holds 256 Gaussians of its order, with 10 or 11 bits for their range."""
    from gsplat.exporter import sort_centers

    means, (index,) = cloud.means, (cloud.opacities.sigmoid() > _FAINTEST).nonzero(as_tuple=True)
    order = index[sort_centers(means[index], torch.arange(len(index)))]
    steps = torch.zeros_like(means[:, 0])
    for chunk in order.split(CHUNK):
        steps[chunk] = ((means[chunk].amax(0) - means[chunk].amin(0)) / 1023).max()
    return steps


def _read_any_ply(path: Path, sh_degree: int | None = None) -> GaussianCloud:
    fields = {name for element in read_header(path).elements for name, _ in element.fields}
    return read_compressed_ply(path) if "packed_position" in fields else read_ply(path, sh_degree)


def _gsplat(format: str, cloud: GaussianCloud) -> bytes:
    """The file as gsplat's exporter makes it, from float32 tensors on the CPU."""
    from gsplat.exporter import export_splats

    host, compressed = cloud.to("cpu", torch.float32), format == "ply_compressed"
    if compressed and not bool((host.opacities.sigmoid() > _FAINTEST).any()):  # the exporter fails if none is left
        raise ValueError("Nothing was written, as all Gaussians are fainter than 1/255: choose another format.")
    data: bytes = export_splats(
        means=host.means,
        scales=host.scales,
        quats=host.quats,
        opacities=host.opacities,
        sh0=host.sh[:, :1],
        shN=host.sh[:, 1:],
        format=format,
    )
    if compressed and host.sh_degree == 0:  # an element without properties, which breaks readers
        head, mark, body = data.partition(b"end_header\n")
        data = re.sub(rb"element sh \d+\n", b"", head) + mark + body
    return data


FORMATS: dict[str, Format] = {
    "ply": Format((".ply",), _read_any_ply, write=write_ply, begins=(b"ply\n", b"ply\r"), origin=True),
    "compressed_ply": Format(
        (".compressed.ply",),
        _read_any_ply,
        partial(_gsplat, "ply_compressed"),
        small=-20,
        large=20,
        harmonics=4,
        faintest=_FAINTEST,
        steps=_steps_of_chunks,
    ),
    "splat": Format(
        (".splat",),
        read_splat,
        partial(_gsplat, "splat"),
        color=0.5 / SH_DC,
        harmonics=0,
    ),
    "spz": Format(
        (".spz",),
        read_spz,
        encode_spz,
        begins=(b"ngsp", b"\x1f\x8b"),
        options=("spz_version",),
        small=-10,
        large=255 / 16 - 10,
        color=0.5 / COLOR_SCALE,
        harmonics=1,
        steps=_steps_of_spz,
    ),
    "sog": Format(
        (".sog",),
        read_sog,
        encode_sog,
        begins=(b"pk\3\4",),
        beside=(".json",),
        sets=PALETTE,
        steps=_steps_of_sog,
    ),
    "glb": Format(
        (".glb",),
        read_gltf,
        encode_gltf,
        begins=(b"gltf",),
        beside=(".gltf",),
        options=("metres_per_unit", "rotation"),
        origin=True,
    ),
    "usd": Format(
        (".usdc", ".usd", ".usda"),
        write=write_usd,
        options=("fps", "metres_per_unit", "rotation"),
        film=True,
        origin=True,
    ),
}
"""All formats by their names. Another entry is one more that is read and written everywhere."""


def endings(written: bool = False) -> dict[str, str]:
    """Readable, or with ``written`` writable, formats by the endings of their names."""
    return {
        ending: name
        for name, format in FORMATS.items()
        if (format.encode or format.write if written else format.read)
        for ending in (*format.endings, *(() if written else format.beside))
    }


def _named(path: Path, known: dict[str, str]) -> str | None:
    return known.get(max((ending for ending in known if path.name.lower().endswith(ending)), key=len, default=""))


def _check_beginning(path: Path, own: Format) -> None:
    with check_regular(path, "the splat").open("rb") as stream:
        start = stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if start.startswith(_PAGES):
        raise ValueError(f"{path} is a web page, such as an error of a server, and no splat: download the file again.")
    if start.startswith(b"version https://git-lfs"):
        raise ValueError(f"{path} is a pointer of Git LFS, not the splat itself: run `git lfs pull` in its repository.")
    for other in FORMATS.values():
        if start.startswith(other.begins) and other.read is not own.read and not start.startswith(own.begins):
            ending = other.endings[0]
            raise ValueError(f"{path} begins as a {ending} file: if it is one, rename it to end in {ending}.")


def read_gaussians(path: str | os.PathLike[str], sh_degree: int | None = None) -> GaussianCloud:
    """Read a splat in any supported format: 3DGS .ply, compressed .ply, .splat, .spz, SOG, glTF or one of your own.

    The ending of the name chooses the format; a file with any other ending is read as a .ply. The content tells whether
    a .ply is compressed.

    Args:
        path: File to read.
        sh_degree: Largest degree of spherical harmonics that is kept; None for all. A large .ply takes less memory so.

    Returns:
        The Gaussians as float32 tensors on the CPU.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be used; the message names the file, the field and the remedy.
        ImportError: If a package is missing that the format needs; the message says how to install it.
    """
    path = Path(path)
    format = FORMATS[_named(path, endings()) or "ply"]
    _check_beginning(path, format)
    cloud = _read_any_ply(path, sh_degree) if format.read is _read_any_ply else format.read(path)
    if sh_degree is not None and cloud.sh_degree > sh_degree:
        cloud = replace(cloud, sh=cloud.sh[:, : (sh_degree + 1) ** 2].clone())
    return cloud


def cleaned(path: Path, cloud: GaussianCloud) -> GaussianCloud:
    """Return a splat that every format can store.

    What has no meaning is left out with a warning, see :func:`~gaussian_swaying.gaussians.repair.repaired`. Logits of
    opacities are clamped to ±16, where float32 ends.

    Args:
        path: The file, for messages.

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

    docs/formats.md says what each keeps.

    Args:
        path: File to write; an existing one is replaced.
        cloud: Gaussians to write, see :func:`cleaned`; also those of a frame of a simulation.
        format: One of :data:`FORMATS`; by default that of the name's ending.
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
            counted (see :meth:`Format.losses`).
    """
    given = {"fps": fps, "metres_per_unit": metres_per_unit, "rotation": rotation, "spz_version": spz_version}
    format = format_of(path) if format is None else format
    check_choice("format", format, tuple(dict.fromkeys(endings(written=True).values())))
    path, own = Path(path), FORMATS[format]
    check_folder(path)
    kept = cleaned(path, cloud.to_cloud() if isinstance(cloud, DeformedGaussians) else cloud)
    options = {name: given[name] for name in own.options}
    if own.write:
        own.write(path, [kept] if own.film else kept, **options)
    else:
        with atomic(path) as temporary:
            temporary.write_bytes(own.encode(kept, **options))
    told = own.losses(kept, **options)
    if told:
        warnings.warn(f"{path}: {'; '.join(told)}.", UserWarning, stacklevel=2)


def format_of(path: str | os.PathLike[str]) -> str:
    """The format in which a file is written, by the ending of its name."""
    known = endings(written=True)
    found = _named(Path(path), known)
    if found is None:
        raise ValueError(f"Cannot tell the format of {path}: give it a name that ends in one of {', '.join(known)}.")
    return found


def export_frames(
    path: str | os.PathLike[str], clouds: Iterable[GaussianCloud], fps: float = 25.0, **options: Any
) -> list[Path]:
    """Write the frames of a motion in the format given by the ending of a name, see :func:`format_of`.

    Args:
        path: File to write: for USD one with all frames; otherwise its name has ``#`` in place of the digits of the
            frame, counted from 0: ``frame_####.spz`` makes frame_0000.spz, frame_0001.spz, ... Its folder is made.
        clouds: One for each frame; read one by one.
        fps: Frames per second, for USD.

    Returns:
        The files.
    """
    target, format = Path(path), FORMATS[format_of(path)]
    if not format.film and "#" not in target.name:
        raise ValueError(
            f"The frames of a run need a file each: give a target with # for their numbers, such as "
            f"frame_####{format.endings[0]}, or one that ends in .usdc."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    if format.film:
        given = {"fps": fps, **options}
        format.write(target, clouds, **{name: given[name] for name in format.options if name in given})
        return [target]
    files = []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for index, cloud in enumerate(clouds):
            files.append(target.with_name(numbered(target.name, str(index))))
            export_cloud(files[-1], cloud, **options)
    if told:
        more = f" {len(told)} warnings like this in {len(files)} files." if len(told) > 1 else ""
        warnings.warn(f"{told[0].message}{more}", UserWarning, stacklevel=2)
    return files


def numbered(name: str, number: str) -> str:
    """Replace the ``#`` of a name by a number padded with zeros."""
    return re.sub("#+", lambda digits: number.rjust(len(digits[0]), "0"), name)
