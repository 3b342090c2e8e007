"""A frame of a simulation."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from gaussian_swaying._files import atomic, is_blank, save_png
from gaussian_swaying._fixed import fixed
from gaussian_swaying.gaussians.export import export_cloud
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.gaussians.ply import check_folder
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.diagnostics import FrameDiagnostics
from gaussian_swaying.simulation.edits import SceneEditor
from gaussian_swaying.simulation.painter import Painter
from gaussian_swaying.simulation.stepper import Launched


@fixed
@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a simulation.

    Attributes:
        painter: Draws the scene.
        editor: Has changed it.
        index: Number of the frame; 0 is the frame at rest.
        state: The state at its end.
        health: Energies, momenta, stretch and other measurements.
    """

    painter: Painter
    editor: SceneEditor
    index: int
    state: State
    health: FrameDiagnostics
    _version: int = field(repr=False, default=0)

    def __repr__(self) -> str:
        return f"Frame({self.index}, time={self.time:g})"

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.health.time

    @cached_property
    def gaussians(self) -> DeformedGaussians:
        """All Gaussians in scene units: means, covariances, normals, and colours as the camera sees them."""
        painter = self.painter
        with painter.turn:
            if self.editor.version != self._version:
                raise RuntimeError(
                    f"An edit has changed the colours since frame {self.index}: read `gaussians` or `render()` of a "
                    "frame before the next one."
                )
            return painter.shade(painter.deformed(self.state), painter.camera_at(self.index))

    def render(self, camera: str = "") -> RenderOutput:
        """Render the frame.

        Args:
            camera: Name of one of ``cameras``; empty for the main ``camera``.

        Returns:
            Colour, opacity and depth.
        """
        painter, gaussians = self.painter, self.gaussians
        if camera and camera not in painter.cameras:
            known = ", ".join(painter.cameras) or "none"
            raise ValueError(f"There is no camera {camera!r} in `cameras` ({known}): leave it out for the main one.")
        if camera:
            gaussians = painter.shade(gaussians, painter.camera_at(self.index, camera))
        assert gaussians.colors is not None
        return painter.draw(gaussians, gaussians.colors, painter.camera_at(self.index, camera))

    def save(self, path: str | os.PathLike[str], format: str | None = None) -> None:
        """Write the picture of the frame (.png), or its Gaussians as a splat.

        A splat is in scene units; USD in metres with z up, glTF with y up.

        Args:
            path: File to write, such as 0001.ply or 0001.png; an existing one is replaced.
            format: As in :func:`~gaussian_swaying.gaussians.export.export_cloud`; by default that of the ending: .ply,
                .compressed.ply, .splat, .spz, .sog, .glb, or .usdc, .usd and .usda.

        Raises:
            FileNotFoundError: If the folder does not exist.
            ValueError: If the ending or the format is unknown, no Gaussian is finite, or the simulation has copies.
            ImportError: If the format is USD and usd-core is not installed.
        """
        if format is None and Path(path).suffix.lower() == ".png":
            check_folder(Path(path))
            pixels = (self.render().color.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
            if is_blank(pixels):
                warnings.warn(f"{path} shows nothing: check the place of the camera and its `near`.", stacklevel=2)
            with atomic(Path(path)) as temporary:
                save_png(temporary, pixels)
            return
        if self.editor.stepper.copies is not None:
            raise ValueError("`copies` cannot be written as a splat yet: write the object alone, without them.")
        place, fps = self.painter.scene.frame, 1 / self.editor.stepper.frame_dt
        export_cloud(
            path, self.gaussians, format=format, fps=fps, metres_per_unit=place.metres_per_unit, rotation=place.rotation
        )


def frames_from(
    painter: Painter,
    editor: SceneEditor,
    state: State,
    first: int,
    count: int,
    drawn: torch.cuda.Stream | None = None,
) -> Iterator[Frame]:
    """The frames of a simulation from number ``first`` up to ``count``, with its edits.

    Args:
        painter: Draws the scene.
        editor: Changes it, and has its stepper.
        state: The state at rest if ``first`` is 0, otherwise the state of the frame before.
        first: Number of the first frame.
        count: Number of frames of the whole run.
        drawn: A stream on which the frames are drawn and recorded. The next frame is then simulated at the same time,
            so that the GPU does not wait for the host, and what is assigned between two frames applies from the next
            but one on.
    """
    stepper, started = editor.stepper, editor.stepper.starts

    def frames(state: State) -> Iterator[Frame]:
        launched: Launched | None = None
        for index in range(first, count):
            with stepper.turn:
                if stepper.starts != started:
                    raise RuntimeError(
                        "This simulation was started again, so the earlier loop over its frames cannot go on: finish "
                        "one loop before the next, or make a Simulation for each."
                    )
                if index == 0:
                    health = stepper.at_first(state).read()
                else:
                    if launched is None and stepper.progress is not None:
                        stepper.progress.begin(index)
                    state, health = stepper.advance(state) if launched is None else launched.finish()
                    if drawn is not None:  # the frame before may still be drawn from memory that is now free
                        torch.cuda.current_stream(stepper.device).wait_stream(drawn)
                    state = editor.edit_due(state)
                if drawn is not None and index + 1 < count:
                    drawn.wait_stream(torch.cuda.current_stream(stepper.device))
                    if stepper.progress is not None:
                        stepper.progress.begin(index + 1)
                    launched = stepper.launch(state)
                frame = Frame(painter, editor, index, state, health, editor.version)
            yield frame

    return frames(state)
