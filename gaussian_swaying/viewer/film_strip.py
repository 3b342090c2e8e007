"""A video of what a browser sees, in simulated time."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_swaying.recording.video import VideoEncoder

FPS = 25.0
LONGEST = 120.0  # s


class FilmStrip:
    """Collects pictures and encodes them so that the video shows real time, however slowly they come."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name) / "video.mp4"
        self._encoder = VideoEncoder(self._path, FPS)
        self._start: float | None = None
        self._size: tuple[int, ...] | None = None
        self._last: np.ndarray | None = None
        self._frames = 0
        self._lock, self._done = threading.Lock(), False

    @property
    def seconds(self) -> float:
        """Length so far [s]."""
        return self._frames / FPS

    @property
    def full(self) -> bool:
        """True if the video has its greatest length, and takes no more pictures."""
        return self.seconds >= LONGEST

    def add(self, time: float, picture: np.ndarray) -> None:
        """Add a picture, uint8 (H, W, 3), at a simulated time [s]; it gets the size of the first."""
        with self._lock:
            if not self._done and not self.full:
                self._add(time, picture)

    def _add(self, time: float, picture: np.ndarray) -> None:
        if self._size is None:
            self._start, self._size = time, picture.shape
        if picture.shape != self._size:
            picture = np.asarray(Image.fromarray(picture).resize((self._size[1], self._size[0])))
        assert self._start is not None
        wanted = int((time - self._start) * FPS) + 1
        if wanted < self._frames:  # the simulation went back to rest: go on from there
            self._start, wanted = time - self._frames / FPS, self._frames + 1
        while self._frames < wanted:
            early = self._last if wanted - self._frames > 1 else None
            self._encoder.write(picture if early is None else early)
            self._frames += 1
        self._last = picture

    def finish(self) -> bytes:
        """The video as .mp4."""
        with self._lock:
            self._done = True
        try:
            if self._frames == 0:
                raise ValueError("Nothing was recorded, as nothing moved: go on before you record.")
            self._encoder.finish()
            return self._path.read_bytes()
        finally:
            self._encoder.abort()
            self._folder.cleanup()
