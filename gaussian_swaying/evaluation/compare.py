"""Comparison of a run with a reference, frame by frame: pictures, surface and, with a network, video."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from einops import rearrange
from torch import Tensor
from tqdm import tqdm

from gaussian_swaying._checks import check_positive
from gaussian_swaying._files import without_nan, write_json, write_text
from gaussian_swaying._inputs import check_archive, read_json
from gaussian_swaying._parallel import in_threads
from gaussian_swaying._provenance import describe_device, versions
from gaussian_swaying.captures.images import image_size, read_image
from gaussian_swaying.evaluation.comparison_picture import comparison_picture
from gaussian_swaying.evaluation.reference import Cloth, frame_files, read_cloth, surface_points
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.metrics.nearest import nearest_distances
from gaussian_swaying.metrics.ssim import SSIM_TAPS, ssim_map
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.recording.video import VideoEncoder

if TYPE_CHECKING:
    from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance


def _errors(image: Tensor, target: Tensor) -> dict[str, Tensor]:
    """``ssim`` and ``mse`` on the device of the pictures, so that the host need not wait for each frame."""
    return {"ssim": ssim_map(image, target, "reflect").mean(), "mse": (image - target).square().mean()}


def _psnr(mse: float) -> float:
    return -10 * math.log10(mse) if mse > 0 else math.inf


def compare_run(
    run: str | os.PathLike[str],
    reference: str | os.PathLike[str],
    *,
    reference_offset: int = 0,
    frames: int | None = None,
    side: float | None = None,
    points: int = 10_000,
    seed: int = 0,
    device: str | torch.device = "cpu",
    fvd: FrechetVideoDistance | None = None,
    video: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Compare a run with a reference, frame by frame.

    Frame i of the run, which is at rest at i = 0, is compared with frame i + ``reference_offset`` of the reference.
    Frames are counted from 0, sorted by their numbers.

    Pictures are compared if both folders have ``frames/*.png`` (in the reference also ``video/frames``). Surfaces are
    compared if the reference has ``cloth.npz`` (see :func:`read_cloth`) and the run ``trajectory.npz``: random points
    on the reference's surface against the simulated Gaussians, transformed from the frame of the simulation to that of
    the scene, in metres. The Chamfer distance is the average of the two mean distances, so two equal sheets at a
    distance h have h. ``sampling_m`` tells how much of it is due to sampling: it is the distance between that many
    random points of the reference and as many other points as there are particles.

    Args:
        run: Folder of a run, as a simulation writes it.
        reference: Folder of the reference.
        reference_offset: The reference's frame that is compared with frame 0 of the run; may be negative.
        frames: Compare only this many frames; by default all, and then both must have the same number.
        side: Longer side of the reference's surface [m]; by default that of ``cloth.npz``, if it has one.
        points: Number of points on the reference's surface, and largest number of particles.
        seed: Seed of the points.
        device: Device on which the metrics are computed.
        fvd: Computes the Fréchet video distance; None for none. It is reset first.
        video: An .mp4 of reference, run and error side by side; None for none.
        progress: Show a progress bar.

    Returns:
        The content of ``eval.json``: ``mean`` and ``worst`` over the frames and ``per_frame``, with ``psnr_db``,
        ``ssim``, ``mse``, ``chamfer_m`` and its two terms ``run_to_reference_m`` and ``reference_to_run_m``;
        ``psnr_of_mean_db``, the PSNR of the mean square over all frames; ``chamfer_share``, the mean Chamfer distance
        over ``side_m``; ``fvd`` with its protocol; ``skipped``, what was not compared and why; sizes, numbers, seed,
        device and versions. What is not finite is None.

    Raises:
        ValueError: If a folder or its content is missing, numbers of frames or sizes differ, or there is nothing to
            compare.
        OSError: If the video cannot be written.
    """
    run, reference, device = Path(run), Path(reference), torch.device(device)
    check_positive("points", points)
    if frames is not None:
        check_positive("frames", frames)
    if side is not None:
        check_positive("side", side)
    summary = _read_summary(run)
    if not reference.is_dir():
        raise ValueError(f"The reference folder {reference} does not exist: give one with frames/*.png or cloth.npz.")
    skipped: list[str] = []
    run_pictures, pictures = frame_files(run), frame_files(reference) or frame_files(reference / "video")
    has_surface, has_particles = (reference / "cloth.npz").exists(), (run / "trajectory.npz").exists()
    if not (run_pictures and pictures):
        skipped.append(f"pictures: {reference if run_pictures else run} has no frames/*.png")
    if not (has_surface and has_particles):
        missing = reference / "cloth.npz" if not has_surface else run / "trajectory.npz"
        skipped.append(f"surface: there is no {missing}")
    if len(skipped) == 2:
        raise ValueError(f"Nothing can be compared ({'; '.join(skipped)}): record the run with images or trajectory.")
    with_pictures, with_surface = bool(run_pictures and pictures), has_surface and has_particles
    cloth = read_cloth(reference / "cloth.npz") if with_surface else None
    counts: dict[str, tuple[int, int]] = {}
    if with_pictures:
        counts["pictures"] = (len(run_pictures), len(pictures))
    if cloth is not None:
        counts["surfaces"] = (_trajectory_length(run / "trajectory.npz"), len(cloth.positions))
    first, first_reference = max(0, -reference_offset), max(0, reference_offset)
    count = _common_count(run, reference, counts, first, first_reference, frames)
    run_pictures, pictures = run_pictures[first:][:count], pictures[first_reference:][:count]
    size = _common_size(run, reference, run_pictures, pictures) if with_pictures else None
    if fvd is not None:
        if not with_pictures:
            raise ValueError(f"The Fréchet video distance needs pictures ({skipped[0]}): remove its network.")
        if count < fvd.clip_length + fvd.stride:
            raise ValueError(
                f"Two clips of {fvd.clip_length} frames need {fvd.clip_length + fvd.stride} frames, but {count} are "
                "compared: lower `clip_length`, or remove the network."
            )
        fvd.to(device)
        fvd.reset()
    surface = None if cloth is None else _Surface(run, summary, cloth, first_reference, points, seed, device)

    encoder = None
    if video is not None and with_pictures:
        encoder = VideoEncoder(Path(video), 1 / float(summary.get("frame_dt_s") or 0.04))

    @torch.inference_mode()
    def compared(number: int) -> tuple[dict[str, Any], np.ndarray | None, list[Tensor]]:
        """The numbers of a frame, its picture for the video, and what the network gets: reference and run."""
        row: dict[str, Any] = {"frame": first + number, "reference_frame": first_reference + number}
        film, small = None, []
        if with_pictures:
            image, target = (_read_frame(files[number], device) for files in (run_pictures, pictures))
            row |= _errors(image, target)
            if encoder is not None:
                labels = (f"reference, frame {row['reference_frame']}", f"run, frame {row['frame']}")
                film = comparison_picture(target, image, labels)
            if fvd is not None:
                small = [fvd.prepare(rearrange(picture, "h w c -> c h w")) for picture in (target, image)]
        if surface is not None:
            row |= surface.distances(first + number, first_reference + number)
        return row, film, small

    rows: list[dict[str, Any]] = []
    prepared: list[list[Tensor]] = []
    try:
        # reading and writing pictures takes longer than comparing them
        done = in_threads(compared, range(count), threads=min(8, os.cpu_count() or 1))
        for row, film, small in tqdm(done, total=count, unit="frame", disable=not progress, file=sys.stderr):
            if encoder is not None and film is not None:
                encoder.write(film)
            prepared += [small] if small else []
            rows.append(row)
        video_distance: dict[str, Any] | None = None
        if fvd is not None:
            for real, pile in zip((True, False), zip(*prepared, strict=True), strict=True):
                fvd.update(torch.stack(pile), real=real)
            video_distance = {"fvd": float(fvd.compute()), **fvd.protocol()}
        if encoder is not None:
            encoder.finish()
    finally:
        if encoder is not None:
            encoder.abort()

    _read_all(rows)
    names = [name for name in rows[0] if name not in ("frame", "reference_frame")]
    mean = {name: float(np.mean([row[name] for row in rows])) for name in names}
    higher_is_better = ("psnr_db", "ssim")
    worst = {n: (min if n in higher_is_better else max)(row[n] for row in rows) for n in names}
    result: dict[str, Any] = {
        "run": str(run),
        "reference": str(reference),
        "frames": count,
        "first_frame": first,
        "first_reference_frame": first_reference,
        "reference_offset": reference_offset,
        "size": None if size is None else list(size),
        "mean": mean,
        "worst": worst,
        "fvd": video_distance,
        "skipped": skipped,
        "seed": seed,
        "device": describe_device(device),
        "versions": versions(),
        "run_status": summary.get("status"),
    }
    if with_pictures:
        result["psnr_of_mean_db"] = _psnr(mean["mse"])
    if surface is not None and cloth is not None:
        side = side if side is not None else cloth.side
        result |= surface.about() | {"side_m": side, "chamfer_share": mean["chamfer_m"] / side if side else None}
    return dict(without_nan(result | {"per_frame": rows}))


def table(result: dict[str, Any]) -> str:
    """The numbers of :func:`compare_run` as Markdown that is also readable as plain text; None is infinite."""
    mean, worst = result["mean"], result["worst"]
    width = max(map(len, mean))
    lines = [f"| {'':{width}} |        mean | worst frame |", f"|{'-' * (width + 2)}|------------:|------------:|"]
    for name in mean:
        cells = ("infinite" if value is None else f"{value:.5g}" for value in (mean[name], worst[name]))
        lines.append(f"| {name:{width}} | {' | '.join(f'{cell:>11}' for cell in cells)} |")
    told = {name: value for name, value in result.items() if name not in ("mean", "worst", "per_frame")}
    return "\n".join([*lines, "", *(f"{name}: {value}" for name, value in told.items() if value is not None)]) + "\n"


def evaluate(
    run: str | os.PathLike[str],
    reference: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    video: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Compare, and write ``eval.json``, ``eval.md`` and ``comparison.mp4``, each completely or not at all."""
    folder = Path(output)
    _read_summary(Path(run))  # before the folder, which may be inside the run's, is made
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"The output folder {folder} cannot be written ({error.strerror or error}): choose another with --output."
        ) from error
    try:
        made = folder / "comparison.mp4"
        result = compare_run(run, reference, video=made if video else None, **options)
        if not (video and result["size"]):
            made.unlink(missing_ok=True)  # the video of an earlier comparison
        write_json(folder / "eval.json", result)
        write_text(folder / "eval.md", table(result))
    except BaseException:
        with suppress(OSError):  # folders with content stay
            for path in missing:
                path.rmdir()
        raise
    return result


class _Surface:
    def __init__(
        self,
        run: Path,
        summary: dict[str, Any],
        cloth: Cloth,
        first_reference: int,
        points: int,
        seed: int,
        device: torch.device,
    ) -> None:
        self.trajectory, self.cloth = run / "trajectory.npz", cloth
        self.points, self.seed, self.device = points, seed, device
        try:
            self.frame = SimFrame.from_summary(summary)
        except ValueError as error:
            raise ValueError(f"The summary.json of {run} cannot be used: {error}.") from error
        recorded = len(load_trajectory(self.trajectory, 0)[0])
        names = ("recorded_surface", "surface_particles", "simulated_gaussians")
        surface = next((summary[name] for name in names if summary.get(name)), None)
        self.particles = min(int(surface or recorded), recorded)  # the other particles follow them
        generator = torch.Generator().manual_seed(seed)
        self.chosen = torch.randperm(self.particles, generator=generator)[:points].sort().values
        others = surface_points(cloth.positions[first_reference], cloth.faces, len(self.chosen), seed + 1)
        self.sampling = float(self._distances(others, first_reference)["chamfer_m"])

    def distances(self, frame: int, reference_frame: int) -> dict[str, Tensor]:
        position = load_trajectory(self.trajectory, frame)[0]
        if not bool(torch.isfinite(position).all()):
            raise ValueError(
                f"{self.trajectory} has positions that are NaN or infinite at frame {frame}: compare the frames before "
                "with --frames."
            )
        in_scene = self.frame.point_to_scene(position[self.chosen].double()) * self.frame.metres_per_unit
        return self._distances(in_scene.float(), reference_frame)

    def _distances(self, points: Tensor, reference_frame: int) -> dict[str, Tensor]:
        surface = surface_points(self.cloth.positions[reference_frame], self.cloth.faces, self.points, self.seed)
        there, back = (d.mean() for d in nearest_distances(points.to(self.device), surface.to(self.device)))
        return {"chamfer_m": 0.5 * (there + back), "run_to_reference_m": there, "reference_to_run_m": back}

    def about(self) -> dict[str, Any]:
        return {
            "chamfer": "average of the mean distances [m] from the run to the reference and back",
            "particles": self.particles,
            "run_points": len(self.chosen),
            "reference_points": self.points,
            "sampling_m": self.sampling,
        }


def _read_all(rows: list[dict[str, Any]]) -> None:
    names = [name for name, value in rows[0].items() if isinstance(value, Tensor)]
    table = torch.stack([torch.stack([row[name].double() for name in names]) for row in rows]).tolist()
    for row, values in zip(rows, table, strict=True):
        row |= dict(zip(names, values, strict=True))
        if "mse" in row:
            row["psnr_db"] = _psnr(row["mse"])


def _read_summary(run: Path) -> dict[str, Any]:
    if not run.is_dir():
        raise ValueError(f"The run folder {run} does not exist: give the folder of a simulation.")
    try:
        return dict(read_json(run / "summary.json", "summary"))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(
            f"The run {run} has no readable summary.json: give the folder of a finished simulation."
        ) from error


def _trajectory_length(path: Path) -> int:
    try:
        with np.load(check_archive(path, "the run")) as arrays:
            return len(arrays.files) // 2
    except Exception as error:  # not a zip, truncated, ...
        raise ValueError(f"{path} cannot be read as a trajectory ({error}): run the simulation again.") from error


def _common_count(
    run: Path,
    reference: Path,
    counts: dict[str, tuple[int, int]],
    first: int,
    first_reference: int,
    frames: int | None,
) -> int:
    left = [(of_run - first, of_reference - first_reference) for of_run, of_reference in counts.values()]
    shared = min(min(pair) for pair in left)
    told = ", ".join(
        f"{of_run} {name} in {run} and {of_reference} in {reference}" for name, (of_run, of_reference) in counts.items()
    )
    begins = f"beginning with frame {first} of the run and {first_reference} of the reference"
    if shared < 1:
        raise ValueError(f"There are {told}, so nothing is left {begins}: correct --reference-offset.")
    if frames is not None:
        if frames > shared:
            raise ValueError(f"There are {told}, so {begins} only {shared} frames can be compared: lower --frames.")
        return frames
    if any(pair != (shared, shared) for pair in left):
        raise ValueError(
            f"The numbers of frames differ: there are {told}, {begins}; compare the first ones with --frames {shared}, "
            "or correct --reference-offset."
        )
    return shared


def _common_size(run: Path, reference: Path, ours: Sequence[Path], theirs: Sequence[Path]) -> tuple[int, int]:
    """Width and height of all pictures [pixels]."""
    size, wanted = image_size(ours[0]), image_size(theirs[0])
    if size != wanted:
        raise ValueError(
            f"The pictures of {run} have {size[0]} x {size[1]} pixels, but those of {reference} {wanted[0]} x "
            f"{wanted[1]}: render the run with `camera.init_args.width` and `height` of the reference."
        )
    for path in (*ours, *theirs):
        if (other := image_size(path)) != size:
            raise ValueError(
                f"The picture {path} has {other[0]} x {other[1]} pixels, but the first one {size[0]} x {size[1]}: make "
                "it again."
            )
    if min(size) < SSIM_TAPS:
        raise ValueError(f"The pictures have {size[0]} x {size[1]} pixels, but SSIM needs 11 x 11: make larger ones.")
    return size


def _read_frame(path: Path, device: torch.device) -> Tensor:
    """A picture from 0 to 1, float32, shape (H, W, 3)."""
    pixels = read_image(path)
    if pixels.shape[-1] != 3:
        raise ValueError(f"The picture {path} has transparent pixels: render it over its background.")
    return pixels.to(device).float() / 255
