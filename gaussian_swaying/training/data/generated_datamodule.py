"""A capture made in code as training data, so that training works without downloads."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.training.data.datamodule import CaptureDataModule


class GeneratedDataModule(CaptureDataModule):
    """Images of a :class:`~gaussian_swaying.captures.generated_capture.GeneratedCapture`, drawn at the first run.

    They are stored in a folder, which later runs with the same settings reuse.
    :class:`~gaussian_swaying.training.data.datamodule.CaptureDataModule` reads it like any other capture.

    Args:
        path: Folder of the images; created if it does not exist.
        capture: The capture to draw.
        points: Initial points of the Gaussians: ``random`` in the space that the cameras see, or a file.
        options: Further arguments of :class:`~gaussian_swaying.training.data.datamodule.CaptureDataModule`.

    Raises:
        ValueError: In ``setup``, if the folder contains something else, or images of another flag.
    """

    def __init__(
        self, path: str | os.PathLike[str], capture: GeneratedCapture, points: str = "random", **options: Any
    ) -> None:
        super().__init__(path, points=points, **options)
        self.generated = capture

    def setup(self, stage: str | None = None) -> None:
        """Draw the images if they do not exist yet, then read them."""
        self._make()
        super().setup(stage)

    def _make(self) -> None:
        folder = Path(self.path)
        settings = {name: value for name, value in vars(self.generated).items() if not name.startswith("_")}
        marker = folder / "generated.json"
        if marker.is_file():
            held = json.loads(marker.read_text("utf-8"))
            if held == settings:
                return
            other = ", ".join(name for name in settings if held.get(name) != settings[name])
            raise ValueError(f"{folder} contains images that were made with another {other}: remove it or set `path`.")
        if folder.exists():
            raise ValueError(f"{folder} exists and is not a generated capture: set another `path`.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
            made = Path(temporary) / "capture"
            self.generated.write(made, max(self.workers, 1))
            (made / marker.name).write_text(json.dumps(settings), "utf-8")
            try:
                made.rename(folder)
            except OSError:  # another run was faster
                if not marker.is_file() or json.loads(marker.read_text("utf-8")) != settings:
                    raise
