"""PhysGaussian's normalised space: the scene is rotated, and its simulated part scaled and centred at (1, 1, 1).

Boxes and planes of a PhysGaussian configuration are in this space; :class:`Normalisation` converts them to scene units.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import FixedList, changed, fixed
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import RegionInFrame
from gaussian_swaying.interop.physgaussian.camera import PhysGaussianCamera
from gaussian_swaying.interop.physgaussian.space import CENTER, rotation_matrix
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.rendering.cameras.camera_path import CameraPath
from gaussian_swaying.simulation.edits import Edit
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.scene import Scene


@fixed
@dataclass
class Normalisation:
    """PhysGaussian's normalised space. With it, boundaries and regions of the material are given in this space.

    The scene is rotated, and the simulated part scaled and centred at (1, 1, 1). The region of the scene is given in
    turned axes, but in scene units. The unit of the normalised space is a metre.

    Args:
        rotation_degree: Angles of successive rotations of the scene [degrees].
        rotation_axis: Axis of each: 0, 1 or 2 for x, y or z.
        scale: Longest side of the simulated part along the turned axes [m].
    """

    rotation_degree: list[float] = field(default_factory=list)
    rotation_axis: list[int] = field(default_factory=list)
    scale: float = 1.0

    def __post_init__(self) -> None:
        check_positive("normalisation.scale", self.scale)
        rotation_matrix(self.rotation_degree, self.rotation_axis)

    @property
    def rotation(self) -> Tensor:
        """Scene axes to turned axes, shape (3, 3), float64."""
        return rotation_matrix(self.rotation_degree, self.rotation_axis)

    def fit(self, points: Tensor) -> SimFrame:
        """The map from the normalised space to a scene.

        Args:
            points: Points of the simulated part in scene units, shape (N, 3).

        Returns:
            A frame whose ``point_to_sim`` takes points of the normalised space to scene units, and whose
            ``point_to_scene`` takes them back.

        Raises:
            ValueError: If the points have no extent.
        """
        rotation = self.rotation
        turned = points.detach().cpu().double() @ rotation.T
        low, high = turned.amin(0), turned.amax(0)
        extent = float((high - low).amax())
        if extent <= 0:
            raise ValueError("The simulated part has no extent for `normalisation` to scale.")
        scale = self.scale / extent
        origin = torch.tensor(CENTER, dtype=torch.float64) - scale * 0.5 * (low + high)
        return SimFrame(origin, rotation.T.contiguous(), 1 / scale)

    def place(
        self,
        scene: Scene,
        material: Material,
        solver: Solver,
        camera: CameraPath | None = None,
        cameras: Mapping[str, CameraPath] | None = None,
        edits: Sequence[Edit] = (),
        cloud: GaussianCloud | None = None,
    ) -> tuple[Scene, Material, Solver, CameraPath | None, dict[str, CameraPath], list[Edit]]:
        """Components in scene units, from those in the normalised space, which stay as they are.

        Args:
            scene: Its region is in turned axes.
            material: Its regions are in the normalised space.
            solver: Its boundaries are in the normalised space.
            camera: A :class:`PhysGaussianCamera` is in the normalised space; other cameras are in scene units.
            cameras: Further cameras, likewise.
            edits: Their regions are in the normalised space.
            cloud: The Gaussians of the scene, if they have been read already.

        Returns:
            Copies of the first six arguments, the scene with ``metres_per_unit`` set.
        """
        if scene.longest_side is not None or scene.metres_per_unit is not None:
            raise ValueError(
                "`normalisation` sets the scale of the scene: remove `scene.longest_side` and "
                "`scene.metres_per_unit`, or `normalisation`."
            )
        turned = SimFrame(torch.zeros(3, dtype=torch.float64), self.rotation.T.contiguous(), 1.0)
        scene = changed(scene, region=RegionInFrame(scene.region, turned))
        cloud = scene.cloud() if cloud is None else cloud
        frame = self.fit(cloud.means[scene.select(cloud)])
        scene = changed(scene, metres_per_unit=1 / frame.metres_per_unit)
        regions = [dataclasses.replace(e, region=RegionInFrame(e.region, frame)) for e in material.regions]
        conditions = [b.in_frame(frame) for b in solver.boundaries if isinstance(b, Boundary)]
        solver = changed(solver, boundaries=FixedList(conditions))
        material, first = dataclasses.replace(material, regions=regions), camera and _seen(camera, frame)
        further = {name: _seen(path, frame) for name, path in (cameras or {}).items()}
        changes = [dataclasses.replace(e, region=e.region and RegionInFrame(e.region, frame)) for e in edits]
        return scene, material, solver, first, further, changes


def _seen(camera: CameraPath, frame: SimFrame) -> CameraPath:
    """A camera path in scene units."""
    return changed(camera, frame=frame) if isinstance(camera, PhysGaussianCamera) else camera
