"""The frames of a recorded run as splats of other programs, or as one skin of bones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying._files import atomic
from gaussian_swaying.gaussians.bones import INFLUENCES, fit_bones
from gaussian_swaying.gaussians.formats import FORMATS, export_cloud, export_frames, format_of, numbered
from gaussian_swaying.gaussians.gltf import encode_skinned_gltf
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.simulation.simulation import RecordedRun


def export_run(
    source: Path,
    target: Path,
    *,
    fps: float | None = None,
    box: Sequence[float] | None = None,
    bones: int | None = None,
    proxy: bool = False,
    apart: bool = False,
    spz_version: int = 3,
) -> list[str]:
    """Write the frames of a run, and return what there is to say.

    Args:
        source: Folder of the run.
        target: As in :func:`~gaussian_swaying.gaussians.formats.export_frames`; ``.glb`` for ``bones``.
        fps: Frames a second, by which those of the run can be divided; all if None.
        box: Lower and upper corner of the Gaussians to write, at rest [scene units].
        bones: Write one skin with so many bones; with ``proxy`` a mesh instead of Gaussians.
        apart: Write the Gaussians that never move once.

    Raises:
        ValueError: If there is no run, or an option does not fit it.
    """
    run = RecordedRun(source)
    scene, own, format = run.simulation.scene, 1 / run.simulation.frame_dt, FORMATS[format_of(target)]
    place: dict[str, Any] = {"metres_per_unit": scene.frame.metres_per_unit, "rotation": scene.frame.rotation}
    every = 1 if fps is None else max(round(own / fps), 1) if fps > 0 else 0
    if not every or abs(every * (fps or own) - own) > 1e-6 * own:
        raise ValueError(
            f"The run has {own:g} frames a second: --fps {own / (every or 1):g} is the nearest that can be."
        )
    inside = torch.ones(len(scene.model), dtype=torch.bool)
    if box is not None:
        inside = Box(box[:3], box[3:]).contains(scene.model.means)
    if not bool(inside.any()):
        raise ValueError("--box holds no Gaussian of the run: enlarge it, or leave it out.")
    if apart and (box is not None or bones is not None):
        raise ValueError("--apart cannot be combined with --box or --bones: leave it out.")
    if proxy and bones is None:
        raise ValueError("--proxy is a mesh that bones move: give their number, as in --bones 48.")
    motion = islice(run.frames(), 0, None, every)
    if bones is None:
        apart = apart and not format.film and not scene.all_move
        frames = (moved.part_to_cloud(True) if apart else moved.to_cloud() for moved in motion)
        frames = frames if box is None else (cloud.select(inside) for cloud in frames)
        files, told = export_frames(target, frames, own / every, spz_version=spz_version, **place), []
        if apart:
            still = target.with_name(numbered(target.name, "still"))
            export_cloud(still, scene.rest().part_to_cloud(moving=False), spz_version=spz_version, **place)
            told.append(f"wrote {still}, which never moves")
        if format.in_metres:
            up = [round(v, 3) + 0.0 for v in scene.frame.rotation[2].tolist()]
            told.append(f"up {up}, 1 scene unit = {scene.frame.metres_per_unit:.6g} m (from the run)")
        return [*told, f"wrote {target}" + (f", {len(files)} files" if len(files) > 1 else "")]
    moving = scene.moving[inside[scene.moving]]
    if not 2 <= bones <= min(256, len(moving) - 1):
        raise ValueError(f"Expected --bones from 2 to 256, and fewer than the {len(moving):,} Gaussians that move.")
    cloud, rest = scene.model.to_cloud(), scene.model.means[moving].double()
    places = torch.stack([moved.means[moving] for moved in motion])
    found = fit_bones(rest, places, bones)
    error = found.error(rest, places.double())
    weight = torch.zeros(len(inside), INFLUENCES, dtype=torch.float64)
    index = torch.zeros_like(weight, dtype=torch.long)
    weight[:, 0] = 1.0  # what does not move follows the bone that stays
    index[moving], weight[moving] = found.index, found.weight
    found = replace(found, index=index[inside], weight=weight[inside])
    with atomic(target) as temporary:
        temporary.write_bytes(encode_skinned_gltf(cloud.select(inside), found, own / every, **place, proxy=proxy))
    told = [f"{bones} bones, {error:.2%} of the motion missed"]
    if cloud.sh_degree:
        told.append("note: colours that depend on the direction of view are the same from all sides.")
    return [*told, f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)"]
