"""Short forms that the constructor of a simulation accepts in Python, and defaults for missing components."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch

from gaussian_swaying._arguments import shown
from gaussian_swaying._checks import VectorLike, check_choice, check_vector
from gaussian_swaying._fixed import FixedList, changed
from gaussian_swaying.captures.capture_camera import CaptureCamera, photo_azimuth, read_views
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.contact import Contact
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera import azimuth_beside
from gaussian_swaying.rendering.cameras.camera_path import CameraPath, OrbitCamera
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.scenes.procedural import GivenScene, ProceduralScene
from gaussian_swaying.simulation.copies import Copy
from gaussian_swaying.simulation.edits import Edit
from gaussian_swaying.simulation.extent import suggest_spacing
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.normalisation import Normalisation
from gaussian_swaying.simulation.scene import Scene
from gaussian_swaying.simulation.simulated_scene import SimulatedScene
from gaussian_swaying.wind.field import SpatialWind, WindField, flow_rows
from gaussian_swaying.wind.force import AeroForce
from gaussian_swaying.wind.turbulence import LOOKS, look

if TYPE_CHECKING:
    SceneLike = Scene | ProceduralScene | GaussianCloud | str | os.PathLike[str]
    WindLike = WindField | SpatialWind | VectorLike | str
    DeviceLike = torch.device | str
    SolverLike = Solver
    MaterialLike = Material | str
else:  # what a YAML file can contain: the annotations of the constructor are its schema
    SceneLike, WindLike, DeviceLike = Scene, WindField, Literal["auto", "cpu", "cuda"]
    SolverLike, MaterialLike = MPMSolver, Material

HoldLike = Region | PinnedRegion | PinnedPoints | list[Region | PinnedRegion | PinnedPoints]
CELLS = 32
"""Largest number of grid cells along the longest side if no solver is given."""


def resolve_device(device: DeviceLike) -> torch.device:
    """The device of a name: ``auto`` (a CUDA GPU if there is one, else the CPU), ``cpu`` or ``cuda``."""
    if isinstance(device, torch.device):
        return device
    if device != "auto" and not device.startswith("cuda"):
        return torch.device(device)
    if torch.cuda.is_available():
        return torch.device("cuda" if device == "auto" else device)
    if device != "auto":
        raise ValueError(
            "`--device cuda` needs a CUDA GPU and a CUDA build of torch, but found none: use --device auto or cpu."
        )
    return torch.device("cpu")


def as_scene(source: SceneLike, up: Sequence[float] | None = None) -> Scene:
    """Make a scene from settings, a file, Gaussians or a scene made in code.

    Args:
        source: The object to simulate.
        up: Direction that points up in it; z if None.

    Returns:
        A :class:`Scene` as it is. Anything else is simulated as a whole.
    """
    if isinstance(source, Scene):
        if up is not None:
            raise ValueError("`up` belongs to the scene: write Scene(..., up=...), and leave out the separate `up`.")
        return source
    direction = [0.0, 0.0, 1.0] if up is None else list(check_vector("up", up))
    if isinstance(source, ProceduralScene | GaussianCloud):
        generator = GivenScene(source) if isinstance(source, GaussianCloud) else source
        return Scene(generator=generator, up=direction)
    return Scene(ply=source, up=direction)


def as_material(material: MaterialLike | None) -> Material:
    """Return the given material, that of a name, or the default."""
    return Material.named(material) if isinstance(material, str) else material or Material()


def as_solver(
    solver: Solver | None, hold: HoldLike | None, scene: Scene, cloud: GaussianCloud, damping: float = 0.0
) -> Solver:
    """Return a copy of the given solver, which may be another simulation's, or make one that suits the scene.

    An object that ``hold`` or a part of the scene holds then has no gravity, as in the starters of the preview: its
    captured shape is already in balance with its weight. ``damping`` [1/s] is that of a solver that is made.
    """
    if solver is None:
        given = list(hold) if isinstance(hold, list | tuple) else [] if hold is None else [hold]
        pins = [PinnedRegion(part) if isinstance(part, Region) else part for part in given]
        means = cloud.means[scene.select(cloud)]
        frame = SimFrame.fit(means, scene.up, scene.longest_side, scene.metres_per_unit)
        side = float((means.amax(0) - means.amin(0)).amax()) * frame.metres_per_unit
        spacing = particle_spacing(means) * frame.metres_per_unit
        held = bool(pins) or (scene.parts is not None and bool(scene.parts.mask(role="held").any()))
        gravity = (0.0, 0.0, 0.0 if held else -9.8)
        return MPMSolver(dx=suggest_spacing(side, spacing, CELLS), gravity=gravity, boundaries=pins, damping=damping)
    if hold is not None:
        raise ValueError(
            "`hold` only works without a solver: add the pin to the `boundaries` of the solver, and leave out `hold`."
        )
    return changed(solver, boundaries=FixedList(map(changed, solver.boundaries)))


def as_wind(wind: WindLike | None, frame: SimFrame) -> WindField | SpatialWind:
    """Return the given wind, a look by its name, a steady wind from three numbers [m/s], or still air for None.

    Places of its effects are converted from scene units to metres.
    """
    if isinstance(wind, WindField):
        return wind.in_frame(frame)
    if isinstance(wind, SpatialWind):
        return wind
    if isinstance(wind, str):
        check_choice("wind", wind, tuple(LOOKS))
        return look(wind).in_frame(frame)
    return WindField() if wind is None else WindField(flow_rows("wind", [wind])[0])


def as_camera(
    camera: CameraPath | None,
    cameras: Mapping[str, CameraPath] | None,
    wind: WindField | SpatialWind,
    scene: SimulatedScene,
) -> CameraPath:
    """Return the given camera, or an orbit camera that looks at the front of the object or from beside the wind.

    The front is the side from which photos were taken; they are known if one of ``cameras`` is that of a capture.
    Beside a wind, its strongest flow goes to the right of the picture. If photos are from all around, and the wind is
    not horizontal or differs from place to place, the azimuth is that of an :class:`OrbitCamera` by default.
    """
    if camera is not None:
        return camera
    captured = next((path for path in (cameras or {}).values() if isinstance(path, CaptureCamera)), None)
    azimuth = None
    if captured is not None:
        eyes = torch.stack([seen.position for _, seen in read_views(captured.path, origin=scene.model.origin)])
        azimuth = photo_azimuth(eyes, scene.center.cpu(), scene.frame.rotation)
    if azimuth is None and isinstance(wind, WindField):
        azimuth = azimuth_beside(wind.flows[int(wind.flows.norm(dim=-1).argmax())].tolist())
    return OrbitCamera() if azimuth is None else OrbitCamera(azimuth=azimuth)


def check_types(given: Mapping[str, Any]) -> None:
    """Raise TypeError if an argument is not of its kind; None is accepted.

    Args:
        given: Arguments of a simulation by their names.
    """
    for name, value in given.items():
        if name in _KINDS and value is not None and not isinstance(value, _KINDS[name]):
            words = " or ".join(kind.__name__ for kind in _KINDS[name])
            raise TypeError(f"Expected `{name}` to be a {words}, but got {shown(value)}.")
        for part in value if name in _LISTS and isinstance(value, list | tuple) else ():
            if not isinstance(part, _LISTS[name]) and not (name == "forces" and callable(part)):
                words = " or ".join(kind.__name__ for kind in _LISTS[name])
                raise TypeError(f"Expected `{name}` to be a list of {words}, but it has {shown(part)}.")


_KINDS: dict[str, tuple[type, ...]] = {
    "scene": (Scene, ProceduralScene, GaussianCloud, str, os.PathLike),
    "material": (Material, str),
    "solver": (Solver,),
    "cloud": (GaussianCloud,),
    "contact": (Contact,),
    "aero": (AeroForce,),
    "forces": (list, tuple),
    "shader": (Shader,),
    "camera": (CameraPath,),
    "cameras": (Mapping,),
    "edits": (list, tuple),
    "copies": (list, tuple),
    "recorder": (Recorder,),
    "normalisation": (Normalisation,),
    "hold": (Region, PinnedRegion, PinnedPoints, list, tuple),
}
_LISTS = {"forces": (Force,), "edits": (Edit,), "copies": (Copy,), "hold": (Region, PinnedRegion, PinnedPoints)}
