"""A frame of a simulation."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

from gaussian_swaying._turns import Turn
from gaussian_swaying.gaussians.export import export_cloud
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.diagnostics import FrameDiagnostics
from gaussian_swaying.simulation.edits import SceneEditor
from gaussian_swaying.simulation.painter import Painter


class Moving(Protocol):
    """The attributes of a simulation that its frames use."""

    frame_dt: float
    painter: Painter
    editor: SceneEditor

    @property
    def turn(self) -> Turn:
        """The lock of the thread that steps or draws."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a simulation.

    Attributes:
        simulation: The simulation that made it.
        index: Its number; 0 is the frame at rest.
        state: The state at its end.
        health: Energies, momenta, stretch and other measurements.
    """

    simulation: Moving
    index: int
    state: MPMState
    health: FrameDiagnostics
    _version: int = field(repr=False, default=0)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.health.time

    @cached_property
    def gaussians(self) -> DeformedGaussians:
        """All Gaussians in scene units: means, covariances, normals, and colours as the camera sees them."""
        painter = self.simulation.painter
        with self.simulation.turn:
            if self.simulation.editor.version != self._version:
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
        painter, gaussians = self.simulation.painter, self.gaussians
        if camera and camera not in painter.cameras:
            known = ", ".join(painter.cameras) or "none"
            raise ValueError(f"There is no camera {camera!r} in `cameras` ({known}): leave it out for the main one.")
        if camera:
            gaussians = painter.shade(gaussians, painter.camera_at(self.index, camera))
        assert gaussians.colors is not None
        return painter.draw(gaussians, gaussians.colors, painter.camera_at(self.index, camera))

    def save(self, path: str | os.PathLike[str], format: str | None = None) -> None:
        """Write the Gaussians of the frame as a splat, in scene units; USD in metres with z up.

        Args:
            path: File to write, such as 0001.ply; an existing one is replaced.
            format: As in :func:`~gaussian_swaying.gaussians.export.export_cloud`; by default that of the ending: .ply,
                .compressed.ply, .splat, or .usdc, .usd and .usda.

        Raises:
            FileNotFoundError: If the folder does not exist.
            ValueError: If the ending or the format is unknown, or no Gaussian is finite.
            ImportError: If the format is USD and usd-core is not installed.
        """
        place, fps = self.simulation.painter.scene.frame, 1 / self.simulation.frame_dt
        export_cloud(path, self.gaussians, format, fps, place.metres_per_unit, place.rotation)
