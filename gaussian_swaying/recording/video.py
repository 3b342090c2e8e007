"""Videos of a run, encoded by ffmpeg."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from gaussian_swaying._files import temporary_name


class VideoEncoder:
    """Encodes frames one by one with ffmpeg in a separate process.

    The format is H.264 in yuv420p; odd sizes are padded by a row or column, as it needs even ones. The file gets its
    name in :meth:`finish`. An encoder that is aborted earlier leaves no process and no file behind.

    Args:
        path: The .mp4 file.
        fps: Frames per second.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps
        self._temporary = temporary_name(path)
        self._lock = threading.Lock()
        self._closed = False
        self._size: tuple[int, ...] = ()
        self._process: subprocess.Popen[bytes] | None = None
        self._end: Callable[[], Any] = lambda: None

    def write(self, image: np.ndarray) -> None:
        """Add a frame, uint8 (H, W, 3). Only one thread may call this at a time."""
        with self._lock:
            if self._closed:
                raise OSError(f"{self.path.name} is closed")
            if self._process is None:
                self._start(*image.shape[:2])
        if image.shape[:2] != self._size:
            (height, width), (first_height, first_width) = image.shape[:2], self._size
            raise OSError(
                f"ffmpeg could not write {self.path.name}: a frame is {width} x {height}, the first one is "
                f"{first_width} x {first_height}"
            )
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(image).data)
        except BrokenPipeError:
            raise self._failure() from None

    def finish(self) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the exit status shows the error
            self._process.stdin.close()
        if self._process.wait() != 0:
            raise self._failure()
        os.replace(self._temporary, self.path)
        self.abort()

    def abort(self) -> None:
        with self._lock:
            self._closed = True
        self._end()

    def _start(self, height: int, width: int) -> None:
        import imageio_ffmpeg

        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", str(self.fps), "-i", "-", "-an", "-vcodec", "libx264"]
        command += ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-preset", "veryfast", "-crf", "18"]
        command += ["-movflags", "+faststart", str(self._temporary.resolve())]
        self._size = (height, width)
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115 - unlike a pipe, never full
        # in a separate session, so that Ctrl-C does not end it before its last frame
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=self._messages, start_new_session=True)
        self._end = weakref.finalize(self, _end_process, self._process, self._messages, self._temporary)

    def _failure(self) -> OSError:
        assert self._process is not None
        self._process.wait()
        self._messages.seek(0)
        message = self._messages.read().decode(errors="replace").strip()
        return OSError(f"ffmpeg could not write {self.path.name}: {message.splitlines()[-1] if message else '?'}")


def _end_process(process: subprocess.Popen[bytes], messages: IO[bytes], temporary: Path) -> None:
    process.kill()
    process.wait()
    assert process.stdin is not None
    with suppress(OSError):
        process.stdin.close()
    messages.close()
    temporary.unlink(missing_ok=True)


def encode_video(frames: list[Path], path: Path, fps: float) -> None:
    """Encode images with :class:`VideoEncoder`.

    Args:
        path: The .mp4 file.
    """
    import imageio.v3 as iio

    encoder = VideoEncoder(path, fps)
    try:
        for frame in frames:
            encoder.write(iio.imread(frame)[..., :3])
        encoder.finish()
    finally:
        encoder.abort()
