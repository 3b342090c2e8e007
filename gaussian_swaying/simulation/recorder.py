"""What a run leaves on disk. Every file is written under a temporary name and then renamed."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive

MARKER = "run.json"
# what a run writes, and so must not find in a folder that no run made
_OURS = ["frames", "ply", "trajectory", "trajectory.npz", "checkpoint.pt", "summary.json", "diagnostics.csv"]
_OURS += ["config.yaml", "video.mp4"]


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder that becomes ``path`` if the block succeeds, and nothing if not."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write JSON, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2) + "\n")


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write dicts as CSV with a header, whole or not at all; what a row lacks stays empty."""
    names = list({name: None for row in rows for name in row})
    with atomic(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)


def to_uint8(image: Tensor) -> np.ndarray:
    """Colours in [0, 1], shape (H, W, 3), to 8 bits, rounded."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def encode_video(frames: list[Path], path: Path, fps: float) -> None:
    """Encode images as H.264 in yuv420p; odd sizes are padded by a row or column, as the format needs even ones.

    Args:
        frames: PNG files in order.
        path: The .mp4 file.
        fps: Frames per second.

    Raises:
        OSError: If ffmpeg fails, with its last message.
    """
    import imageio.v3 as iio
    import imageio_ffmpeg

    height, width = iio.imread(frames[0]).shape[:2]
    with atomic(path) as temporary:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", str(fps), "-i", "-", "-an", "-vcodec", "libx264"]
        command += ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-crf", "18"]
        command += ["-movflags", "+faststart", str(temporary.resolve())]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdin is not None
        assert process.stderr is not None
        with suppress(BrokenPipeError):  # ffmpeg's own message, read below, says why it stopped
            for frame in frames:
                process.stdin.write(iio.imread(frame)[..., :3].tobytes())
        with suppress(BrokenPipeError):
            process.stdin.close()
        message = process.stderr.read().decode(errors="replace").strip()
        if process.wait() != 0:
            raise OSError(f"ffmpeg could not write {path.name}: {message.splitlines()[-1] if message else '?'}")


class Recorder:
    """Writes frames, trajectory, checkpoint, summary and video of a run to one folder.

    Layout: ``frames/00000.png``, ``ply/00000.ply``, ``trajectory.npz`` (arrays ``position_00000`` and ``F_00000``),
    ``checkpoint.pt``, ``summary.json``, ``diagnostics.csv`` (a row per frame), ``config.yaml``, ``video.mp4``.

    Args:
        images: Write a PNG per frame.
        video: Encode the PNGs at the end; needs ``images``.
        ply_every: Write the deformed Gaussians as a 3DGS .ply every so many frames; 0 for never.
        trajectory: Keep position (float32, metres, z up) and F (float16) of the simulated particles per frame.
        checkpoint_every: Keep the state for ``--resume`` every so many frames; 0 for never.
        fps: Frames per second of the video; null for real time, 1 / frame_dt.
    """

    def __init__(
        self,
        images: bool = True,
        video: bool = True,
        ply_every: int = 0,
        trajectory: bool = True,
        checkpoint_every: int = 1,
        fps: float | None = None,
    ) -> None:
        for name, value in (("ply_every", ply_every), ("checkpoint_every", checkpoint_every)):
            check_positive(f"recorder.{name}", value, allow_zero=True)
        if fps is not None:
            check_positive("recorder.fps", fps)
        if video and not images:
            raise ValueError("The video is made from the images: set `recorder.images` to true or `video` to false.")
        self.images, self.video, self.trajectory = images, video, trajectory
        self.ply_every, self.checkpoint_every, self.fps = int(ply_every), int(checkpoint_every), fps
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """The output folder, once :meth:`open` was called."""
        if self._folder is None:
            raise RuntimeError("The recorder has no folder yet: call `open(folder)` first.")
        return self._folder

    def open(self, folder: str | os.PathLike[str], config: str = "", resume: bool = False) -> dict[str, Any] | None:
        """Prepare the output folder.

        An earlier run found there is moved aside, never overwritten. Any other files in the folder are left alone; if
        one of them bears a name of the layout, the folder is refused.

        Args:
            folder: Where to write.
            config: The whole configuration as YAML, kept beside the results and compared when resuming.
            resume: Continue the run in the folder.

        Returns:
            The checkpoint to continue from, or None.

        Raises:
            ValueError: If the folder cannot be written, or there is nothing to resume or something else.
        """
        path = Path(folder)
        if resume:
            checkpoint = self._load_checkpoint(path, config)
            self._folder = path
            self._make_folders()
            for folder in (path, *(path / name for name in ("frames", "ply", "trajectory"))):
                for leftover in folder.glob(".*.*.*"):  # of a run that was killed while it wrote
                    leftover.unlink()
            return checkpoint
        try:
            if (path / MARKER).exists():
                aside = _free_name(path)
                path.rename(aside)
                print(f"An earlier run in {path} was moved to {aside}.")
            foreign = [name for name in _OURS if (path / name).exists()]
            if foreign:
                raise ValueError(
                    f"The output folder {path} holds {', '.join(foreign)} of something else, which would be "
                    "overwritten: choose another with --output."
                )
            path.mkdir(parents=True, exist_ok=True)
            self._folder = path
            write_json(path / MARKER, {"made_by": "gaussian_swaying", "format": 1})
            self._make_folders()
            if config:
                with atomic(path / "config.yaml") as temporary:
                    temporary.write_text(config)
        except OSError as error:
            raise ValueError(
                f"The output folder {path} cannot be written ({error.strerror or error}): choose another with --output."
            ) from error
        return None

    def _make_folders(self) -> None:
        wanted = {"frames": self.images, "ply": self.ply_every > 0, "trajectory": self.trajectory}
        for name, needed in wanted.items():
            if needed:
                (self.folder / name).mkdir(exist_ok=True)

    def _load_checkpoint(self, path: Path, config: str) -> dict[str, Any]:
        file = path / "checkpoint.pt"
        if not file.exists():
            raise ValueError(f"There is nothing to resume in {path}: it holds no checkpoint.pt; leave out --resume.")
        try:
            checkpoint = dict(torch.load(file, map_location="cpu", weights_only=True))
            missing = [name for name in ("frame", "state", "log", "config", "wall_s") if name not in checkpoint]
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}")
        except Exception as error:
            why = (str(error).splitlines() or ["empty"])[0]
            raise ValueError(f"{file} cannot be read as a checkpoint ({why}): start again without --resume.") from error
        if config and checkpoint["config"] != config:
            raise ValueError(
                f"The configuration differs from that of the run in {path} "
                f"({_first_change(checkpoint['config'], config)}): resume with the same one, or start again without "
                "--resume."
            )
        return checkpoint

    def write_image(self, index: int, image: Tensor) -> None:
        """Write one frame as PNG from colours in [0, 1], shape (H, W, 3)."""
        import imageio.v3 as iio

        with atomic(self.folder / "frames" / f"{index:05d}.png") as temporary:
            iio.imwrite(temporary, to_uint8(image), compress_level=3)

    def write_trajectory(self, index: int, position: Tensor, F: Tensor) -> None:
        """Keep position [m] (P, 3) and F (P, 3, 3) of one frame; packed into one file by :meth:`close`."""
        with atomic(self.folder / "trajectory" / f"{index:05d}.npz") as temporary:
            arrays: dict[str, Any] = {f"position_{index:05d}": position.float().cpu().numpy()}
            arrays[f"F_{index:05d}"] = F.half().cpu().numpy()
            np.savez(temporary, **arrays)

    def write_ply(self, index: int, write: Callable[[Path], None]) -> None:
        """Write one frame's Gaussians; ``write(path)`` is itself whole or nothing."""
        write(self.folder / "ply" / f"{index:05d}.ply")

    def write_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what a resumed run needs. Written last, so that it never names a frame that is not complete."""
        with atomic(self.folder / "checkpoint.pt") as temporary:
            torch.save(checkpoint, temporary)

    def frame_files(self, count: int) -> list[Path]:
        """The PNGs of the first ``count`` frames that exist."""
        files = [self.folder / "frames" / f"{index:05d}.png" for index in range(count)]
        return [file for file in files if file.exists()]

    def close(self, frames: int, summary: dict[str, Any], real_time_fps: float = 25.0) -> list[Path]:
        """Pack the trajectory, encode the video and write the summary of the frames recorded so far.

        Args:
            frames: Number of frames recorded.
            summary: What goes to ``summary.json``.
            real_time_fps: Frames per second at which the video shows the simulated time.

        Returns:
            The files and folders of the run, for telling the user.
        """
        self.write_summary(summary)
        made = [self.folder / "summary.json"]
        if self.ply_every and frames:
            made.append(self.folder / "ply")
        if self.trajectory and frames:
            self._pack_trajectory(frames)
            made.append(self.folder / "trajectory.npz")
        if self.images and frames:
            made.append(self.folder / "frames")
            files = self.frame_files(frames)
            if self.video and files:  # last: it needs another program
                encode_video(files, self.folder / "video.mp4", self.fps or real_time_fps)
                made.append(self.folder / "video.mp4")
        return made

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json``, and its entry ``per_frame`` as ``diagnostics.csv`` too."""
        write_json(self.folder / "summary.json", summary)
        if summary.get("per_frame"):
            write_table(self.folder / "diagnostics.csv", summary["per_frame"])

    def _pack_trajectory(self, frames: int) -> None:
        """Join the frames into one .npz, copying their arrays without unpacking all of them at once."""
        target, shards = self.folder / "trajectory.npz", self.folder / "trajectory"
        wanted = {f"{index:05d}" for index in range(frames)}
        with atomic(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as out:
            sources = [target] if target.exists() else []
            done: set[str] = set()
            # frames of a resumed run replace those of the run before it
            for source in [*sorted(shards.glob("[0-9]*.npz"), reverse=True), *sources]:
                with zipfile.ZipFile(source) as archive:
                    for name in archive.namelist():
                        if name.rsplit("_", 1)[1][:5] in wanted and name not in done:
                            done.add(name)
                            out.writestr(name, archive.read(name))
        shutil.rmtree(shards)


def load_trajectory(path: str | os.PathLike[str], frame: int) -> tuple[Tensor, Tensor]:
    """Position [m, z up] (P, 3) and F (P, 3, 3) of the simulated particles at one recorded frame.

    Args:
        path: ``trajectory.npz`` of a run.
        frame: Frame number from 0.

    Raises:
        ValueError: If the file does not hold the frame.
    """
    with np.load(path) as arrays:
        name = f"{frame:05d}"
        if f"position_{name}" not in arrays:
            raise ValueError(f"{path} holds no frame {frame}: it has {len(arrays.files) // 2} frames.")
        return torch.from_numpy(arrays[f"position_{name}"]), torch.from_numpy(arrays[f"F_{name}"]).float()


def _first_change(old: str, new: str) -> str:
    """The first field in which two configurations differ, by its dotted name."""
    import yaml

    before, after = _flat(yaml.safe_load(old)), _flat(yaml.safe_load(new))
    for name in [*after, *before]:
        if before.get(name) != after.get(name):
            return f"`{name}` was {before.get(name, 'absent')}, now {after.get(name, 'absent')}"
    return "in its order"


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = {k: v for key, item in items for k, v in _flat(item, f"{name}.{key}" if name else str(key)).items()}
    return found or {name: value}


def _free_name(path: Path) -> Path:
    number = 1
    while (candidate := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    return candidate


__all__ = ["Recorder", "atomic", "encode_video", "load_trajectory", "write_json"]
