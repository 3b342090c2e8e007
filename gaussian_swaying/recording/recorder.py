"""The output files of a run. Every file is written under a temporary name and then renamed.

Frames are written in the background (:mod:`.writer`), while the video is encoded (:mod:`.video`). Positions and
deformation gradients are packed into one file (:mod:`.trajectory`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying._files import atomic, is_blank, remove_temporaries, save_png, write_json, write_table, write_text
from gaussian_swaying._fixed import fixed
from gaussian_swaying.recording.checkpoint import read_checkpoint
from gaussian_swaying.recording.layout import frame_folder, names, raw_folder, video_file
from gaussian_swaying.recording.nodes import NODES, split_far
from gaussian_swaying.recording.resume import packed_frames, tell_missing
from gaussian_swaying.recording.trajectory import pack_trajectory
from gaussian_swaying.recording.video import VideoEncoder, encode_video
from gaussian_swaying.recording.writer import FrameWriter, HostCopy
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder, mark
from gaussian_swaying.runs.lock import FolderLock
from gaussian_swaying.runs.saved import save_whole


class _Film:
    def __init__(self) -> None:
        self.encoder: VideoEncoder | None = None
        self.encoded: list[int] = []

    def give_up(self) -> None:
        if self.encoder is not None:
            self.encoder.abort()
            self.encoder = None


def _write_png(path: Path, pixels: np.ndarray) -> None:
    with atomic(path) as temporary:
        save_png(temporary, pixels)


@fixed
@dataclass(eq=False)
class Recorder:
    """Writes frames, trajectory, checkpoint, summary and video of a run to one folder.

    Layout: ``frames/00000.png``, ``trajectory.npz`` (arrays ``position_00000`` and
    ``F_00000``), ``nodes.npz`` (arrays ``displacement_00000`` and ``far_00000``), ``checkpoint.pt``, ``summary.json``,
    ``diagnostics.csv`` (a row per frame), ``config.yaml``, ``video.mp4``.

    Other renders have separate folders with their names, and videos with these names.
    Further cameras have the same layout in ``cameras/<name>``. Pixels of depth, normal and force without
    Gaussians are black.

    - ``depth``: along the optical axis, from yellow, one longest side of the object in front of its centre at rest, to
      violet, as far behind it. The numbers are in ``depth_raw`` as 16-bit PNG: 0 for empty pixels, else steps
      of 1 mm.
    - ``normal``: flipped towards the camera, (n + 1) / 2 in red, green and blue; x right, y up, z towards the
      camera.
    - ``force``: wind force per area [Pa], violet at 0 to yellow at the largest of the wind, without gusts, on
      a patch at rest; that value is in summary.json.
    - ``wind``: the colour picture, paler, with streaks of air that drift with the wind, near a plane through the object
      along the flow, violet in still air to yellow at 1.5 times the flow.
    - ``vorticity``: the colour picture, paler, with the vorticity of computed air across the same plane: blue turns
      clockwise as the camera sees it, red the other way.

    Images, trajectory and checkpoint are written in the background: the methods make a copy and return. They wait
    only if the disk or ffmpeg is so slow that the queue is full. If something cannot be written, the next method call,
    :meth:`wait` or :meth:`close` raises the error.

    Args:
        video: Encode the frames.
        trajectory: Write position (float32, metres, z up) and F (float16) of the simulated particles for each frame.
        checkpoint_every: Write the state for ``--resume`` every ``checkpoint_every`` frames; 0 for never.
        fps: Frames per second of the video; null for real time, 1 / frame_dt.
        loop: Time [s] in which the end of the motion becomes its beginning, so that a film closes; 0 for none. The
            first frames, as many as that takes, are recorded only as that end.
        renders: Pictures of each frame: ``color``, ``depth``, ``normal``, ``force``, ``wind``, ``vorticity``; none for
            motion alone.
        nodes: In ``total``, write the displacement (metres, z up; float16, or float32 where it is long) of the nodes
            that the Gaussians follow for each frame, for ``gaussian-swaying export``. Runs of ``updated`` have
            nothing to write.
    """

    live_as = "recorder"

    video: bool = True
    _: KW_ONLY
    trajectory: bool = True
    checkpoint_every: int = 1
    fps: float | None = None
    loop: float = 0.0
    renders: Sequence[str] = ("color",)
    nodes: bool = True

    def __post_init__(self) -> None:
        for name in ("checkpoint_every", "fps", "loop"):
            if (value := getattr(self, name)) is not None:
                check_positive(f"recorder.{name}", value, allow_zero=name != "fps")
        renders = self.renders
        if len(set(renders)) < len(renders):
            raise ValueError(
                f"Expected `recorder.renders` to be a list of different ones of {', '.join(PASSES)}, but got "
                f"{renders!r}."
            )
        for render in renders:
            check_choice("recorder.renders", render, tuple(PASSES))
        self._folder: Path | None = None
        self._writer = FrameWriter()
        self._films: dict[str, _Film] = {}  # by the folder of their frames
        self._lock: FolderLock | None = None
        self._checkpoint_frame: int | None = None
        self._real_time_fps = 25.0
        self._blank: list[tuple[str, int]] = []

    @property
    def images(self) -> bool:
        """True if there are pictures."""
        return bool(self.renders)

    def __getstate__(self) -> dict[str, Any]:
        """The settings: a copy has no folder, no open files and nothing that waits to be written."""
        closed: dict[str, Any] = {"_folder": None, "_writer": None, "_films": {}, "_lock": None, "_blank": []}
        return vars(self) | closed | {"_checkpoint_frame": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the settings."""
        vars(self).update(state, _writer=FrameWriter())

    @property
    def checkpoint_frame(self) -> int | None:
        """The frame of the last checkpoint."""
        return self._checkpoint_frame

    @property
    def folder(self) -> Path:
        """The output folder, once :meth:`open` was called."""
        if self._folder is None:
            raise RuntimeError("The recorder has no folder yet: call `open(folder)` first.")
        return self._folder

    def open(
        self,
        folder: str | os.PathLike[str],
        config: str = "",
        resume: bool = False,
        real_time_fps: float = 25.0,
        cameras: Sequence[str] = (),
        check: Callable[[dict[str, Any]], None] | None = None,
        alone: bool = True,
    ) -> dict[str, Any] | None:
        """Prepare the output folder.

        An earlier run in it is moved aside, never overwritten. Other files in the folder are not touched; if one of
        them has a name from the layout, the folder is refused.

        Args:
            folder: The output folder.
            config: The whole configuration as YAML, stored with the results and compared when resuming.
            resume: Continue the run in the folder.
            real_time_fps: Frames per second at which the video shows the simulated time.
            cameras: Names of the further cameras.
            check: Called with the checkpoint before anything in the folder is changed; raises an error if it is bad.
            alone: Whether no other recorder is at work in this process. One of many uses a single thread, and encodes
                its video at the end.

        Returns:
            The checkpoint to continue from, or None. The folder is locked until :meth:`close` or :meth:`release`.

        Raises:
            FolderLocked: If another run writes to the folder.
            ValueError: If the folder cannot be written, there is nothing to resume, the run is a different one, or its
                files are damaged.
            OSError: If files of an earlier folder that was not closed could not be written.
        """
        self.wait()
        self._give_up_video()
        self.release()
        self._writer, self._real_time_fps = FrameWriter() if alone else FrameWriter(workers=1), real_time_fps
        path = Path(folder)
        places = [frame_folder(render, camera) for camera in ("", *cameras) for render in self.renders]
        self._films = {place: _Film() for place in places} if self.images else {}
        self._checkpoint_frame, self._blank = None, []
        try:
            checkpoint = self._continue(path, config, check) if resume else None
            if not resume:
                self._lock = claim_folder(path, names(), "choose another with --output")
            self._folder = path
            try:
                self._make_folders()
                if config and not (path / "config.yaml").exists():
                    write_text(path / "config.yaml", config)
            except OSError as error:
                raise ValueError(
                    f"The output folder {path} cannot be written ({error.strerror or error}): choose another with "
                    "--output."
                ) from error
        except BaseException:
            self.release()
            raise
        if self.video and alone and not resume:  # a resumed run makes its video from the PNGs
            for place, film in self._films.items():
                film.encoder = VideoEncoder(path / video_file(place), self.fps or real_time_fps)
        return checkpoint

    def _continue(self, path: Path, config: str, check: Callable[[dict[str, Any]], None] | None) -> dict[str, Any]:
        if not path.is_dir():
            raise ValueError(f"There is nothing to resume in {path}: it has no checkpoint.pt; leave out --resume.")
        self._lock = hold_folder(path, "check its permissions")
        checkpoint = read_checkpoint(path / "checkpoint.pt", config)
        if check is not None:
            check(checkpoint)
        told = self._missing(path, checkpoint)
        for folder in (path, path / "nodes", *(path / name for name in self._folders())):
            remove_temporaries(folder)  # of a run that was killed while writing
        if not (path / MARKER).exists():
            mark(path)
        for sentence in told:
            print(f"warning: {sentence}", file=sys.stderr)
        self._checkpoint_frame = checkpoint["frame"]
        return checkpoint

    def _missing(self, path: Path, checkpoint: dict[str, Any]) -> list[str]:
        """Sentences about missing files of the frames so far."""
        frames, told = range(checkpoint["recorded"]), []
        for place in self._picture_folders():
            film = video_file(place) if self.video and place in self._films else None
            told += tell_missing(path / place, ".png", frames, film)
        for name, kept in (("trajectory", self.trajectory), ("nodes", self.nodes and checkpoint["nodes"])):
            if kept:
                film = f"{name}.npz"
                told += tell_missing(path / name, ".npz", {*frames} - packed_frames(path / film), film)
        return told

    def release(self) -> None:
        """Unlock the folder for other runs."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _folders(self) -> list[str]:
        return [*self._picture_folders(), *(["trajectory"] if self.trajectory else [])]

    def _make_folders(self) -> None:
        for name in self._folders():
            (self.folder / name).mkdir(parents=True, exist_ok=True)

    def _picture_folders(self) -> list[str]:
        raw = [raw_folder(place) for place in self._films if (own := PASSES.get(Path(place).name)) and own.raw]
        return [*self._films, *raw]

    def write_image(self, index: int, image: Tensor, place: str = "frames") -> None:
        """Write one frame as 8-bit PNG from colours in [0, 1], shape (H, W, 3), and add it to the video.

        Args:
            index: Frame number.
            image: The colours.
            place: Folder of the frames, see :func:`frame_folder`.

        Raises:
            OSError: If an earlier file could not be written. The other methods that write raise it too.
        """
        path = self.folder / place / f"{index:05d}.png"
        copy = HostCopy((image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8))

        def write() -> None:
            pixels = copy.get().numpy()
            _write_png(path, pixels)
            if is_blank(pixels):
                self._blank.append((place, index))

        self._submit(path, write)
        film = self._films.get(place)
        if film is not None and film.encoder is not None:
            encoder, encoded = film.encoder, film.encoded

            def encode() -> None:
                try:
                    encoder.write(copy.get().numpy())
                    encoded.append(index)
                except Exception:
                    encoder.abort()  # `close` notices the missing frame, encodes the PNGs and reports errors

            self._submit(encoder.path, encode)

    def told(self) -> list[str]:
        """A sentence for each folder with blank pictures, of those written so far."""
        found = {place: sorted(index for other, index in self._blank if other == place) for place, _ in self._blank}
        return [
            f"{len(frames)} pictures in {place} show nothing, the first in frame {frames[0]}: check `near` and the "
            "place of the camera, and that the Gaussians are opaque."
            for place, frames in sorted(found.items())
        ]

    def write_raw(self, index: int, steps: Tensor, place: str) -> None:
        """Write one frame's numbers as 16-bit PNG, beside the frames of ``place``.

        Args:
            index: Frame number.
            steps: Whole numbers from 0 to 65535, int32, shape (H, W).
            place: Folder of the coloured frames, see :func:`frame_folder`.
        """
        path, copy = self.folder / raw_folder(place) / f"{index:05d}.png", HostCopy(steps)
        self._submit(path, lambda: _write_png(path, copy.get().numpy().astype(np.uint16)))

    def write_trajectory(self, index: int, position: Tensor, F: Tensor) -> None:
        """Write position [m] (P, 3) and F (P, 3, 3) of one frame; :meth:`close` packs all into one file."""
        copy = HostCopy({"position": position.float(), "F": F.half()})
        self._write_arrays("trajectory", index, lambda: {name: part.numpy() for name, part in copy.get().items()})

    def write_nodes(self, index: int, displacement: Tensor, limit: float) -> None:
        """Write the displacement of the nodes [m] (N, 3) of one frame; :meth:`close` packs all into one file.

        Args:
            index: Frame number.
            displacement: The displacements.
            limit: Longest displacement that float16 may round [m].
        """
        copy = HostCopy(displacement.float())
        self._write_arrays("nodes", index, lambda: dict(zip(NODES, split_far(copy.get().numpy(), limit), strict=True)))

    def _write_arrays(self, place: str, index: int, arrays: Callable[[], dict[str, np.ndarray]]) -> None:
        path = self.folder / place / f"{index:05d}.npz"

        def write() -> None:
            named: dict[str, Any] = {f"{name}_{index:05d}": array for name, array in arrays().items()}
            path.parent.mkdir(exist_ok=True)  # that of the nodes is made by the first frame: `updated` has none
            with atomic(path) as temporary:
                np.savez(temporary, **named)

        self._submit(path, write)

    def write_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write the checkpoint for a resumed run.

        It is written only after everything submitted before is on disk, so that it never refers to an incomplete frame.
        """
        path, copy = self.folder / "checkpoint.pt", HostCopy(checkpoint)

        def write() -> None:
            save_whole(path, copy.get())
            self._checkpoint_frame = checkpoint["frame"]

        self._submit(path, write, after_all=True)

    def _submit(self, path: Path, write: Callable[[], None], after_all: bool = False) -> None:
        self._writer.submit(path.relative_to(self.folder).as_posix(), write, after_all)

    def wait(self) -> None:
        """Return when everything submitted is on disk, except for the end of the video.

        Raises:
            OSError: If something could not be written and no other method has raised it yet.
        """
        self._writer.wait()

    def frame_files(self, count: int, place: str = "frames") -> list[Path]:
        """The existing PNGs of the first ``count`` frames in the folder ``place``."""
        files = [self.folder / place / f"{index:05d}.png" for index in range(count)]
        return [file for file in files if file.exists()]

    def close(self, frames: int, summary: dict[str, Any], release: bool = True) -> list[Path]:
        """Wait for all files, pack the trajectory, finish the video and write the summary of the frames so far.

        Args:
            frames: Number of frames recorded.
            summary: Content of ``summary.json``.
            release: Unlock the folder at the end.

        Returns:
            The files and folders of the run, to show to the user.

        Raises:
            OSError: If something could not be written and no other method has raised it yet. Everything that does not
                depend on it is still written.
        """
        failure = None
        try:
            self.write_summary(summary)
            made = [self.folder / "summary.json"]
            try:
                self.wait()
            except Exception as error:
                failure = error
            moved = self.nodes and ((self.folder / "nodes").exists() or (self.folder / "nodes.npz").exists())
            for name, kept in (("trajectory", self.trajectory), ("nodes", moved)):
                if kept and frames:
                    pack_trajectory(self.folder / name, self.folder / f"{name}.npz", frames)
                    made.append(self.folder / f"{name}.npz")
            if self.images and frames:
                made += [self.folder / place for place in self._picture_folders()]
                for place in self._films:
                    files = self.frame_files(frames, place)
                    if self.video and files:  # last, as it needs another program
                        self._finish_video(place, files)
                        made.append(self.folder / video_file(place))
        finally:
            self._give_up_video()
            if release:
                self.release()
        if failure is not None:
            raise failure
        return made

    def _finish_video(self, place: str, files: list[Path]) -> None:
        film = self._films[place]
        encoder = film.encoder
        if encoder is not None and film.encoded == [int(file.stem) for file in files]:
            with suppress(OSError):
                return encoder.finish()
        film.give_up()  # before a new one with the same name is made
        encode_video(files, self.folder / video_file(place), self.fps or self._real_time_fps)

    def _give_up_video(self) -> None:
        for film in self._films.values():
            film.give_up()

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json``, and its entry ``per_frame`` also as ``diagnostics.csv``."""
        write_json(self.folder / "summary.json", summary)
        if summary.get("per_frame"):
            write_table(self.folder / "diagnostics.csv", summary["per_frame"])
