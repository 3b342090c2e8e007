"""Wind on captured 3D Gaussian scenes: aerodynamics on the normals and areas of Gaussians, in PyTorch.

Public names are imported when they are first used, so importing the package needs torch and numpy only.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from gaussian_swaying.aero.carried import CarriedField, Turbulence
    from gaussian_swaying.aero.effects import LogProfile, PowerProfile, WindEffect
    from gaussian_swaying.aero.force import AeroForce, aero_force
    from gaussian_swaying.aero.obstacles import CylinderObstacle, EllipsoidObstacle, SphereObstacle
    from gaussian_swaying.aero.recorded import FrozenWind, RecordedWind
    from gaussian_swaying.aero.shelter import Shelter
    from gaussian_swaying.aero.wind import FlowKey, GaussianGust, SineSway, SpatialWind, UniformGust, WindField
    from gaussian_swaying.aero.wind_force import WindForce
    from gaussian_swaying.captures.capture import Capture, View, read_capture
    from gaussian_swaying.captures.capture_camera import CaptureCamera
    from gaussian_swaying.captures.generated_capture import GeneratedCapture
    from gaussian_swaying.captures.initial_points import initial_points
    from gaussian_swaying.captures.point_cloud import PointCloud
    from gaussian_swaying.evaluation.compare import compare_run
    from gaussian_swaying.fitting.fit import fit
    from gaussian_swaying.gaussians.cloud import GaussianCloud
    from gaussian_swaying.gaussians.compact import read_gaussians
    from gaussian_swaying.gaussians.export import export_cloud, write_usd
    from gaussian_swaying.gaussians.filling import InteriorFilling
    from gaussian_swaying.gaussians.model import GaussianSurfaceModel
    from gaussian_swaying.gaussians.ply import read_ply, write_ply
    from gaussian_swaying.geometry.frame import SimFrame
    from gaussian_swaying.geometry.keyed_path import KeyedPath
    from gaussian_swaying.geometry.regions import Box, Cylinder, Sphere
    from gaussian_swaying.interop.physgaussian.camera import PhysGaussianCamera
    from gaussian_swaying.metrics.chamfer import ChamferDistance, chamfer_distance
    from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance, frechet_distance
    from gaussian_swaying.mpm.boundaries.ball import BallObstacle
    from gaussian_swaying.mpm.boundaries.block import BoxObstacle
    from gaussian_swaying.mpm.boundaries.boundary import Boundary
    from gaussian_swaying.mpm.boundaries.capsule import CapsuleObstacle
    from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
    from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
    from gaussian_swaying.mpm.boundaries.handle import Handle
    from gaussian_swaying.mpm.boundaries.impulse import Impulse
    from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle
    from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
    from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
    from gaussian_swaying.mpm.boundaries.plane import Plane
    from gaussian_swaying.mpm.boundaries.sequential_release import SequentialRelease
    from gaussian_swaying.mpm.boundaries.still_gaussians import StillGaussians
    from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
    from gaussian_swaying.mpm.contact.surface import Contact, Surface
    from gaussian_swaying.mpm.forces import Force
    from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
    from gaussian_swaying.mpm.laws.fluid import Fluid
    from gaussian_swaying.mpm.laws.foam import Foam
    from gaussian_swaying.mpm.laws.hencky import StVKHencky
    from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
    from gaussian_swaying.mpm.laws.metal import Metal
    from gaussian_swaying.mpm.laws.neo_hookean import NeoHookean
    from gaussian_swaying.mpm.laws.plasticine import Plasticine
    from gaussian_swaying.mpm.laws.sand import Sand
    from gaussian_swaying.mpm.laws.snow import Snow
    from gaussian_swaying.mpm.laws.spring_network import SpringNetwork
    from gaussian_swaying.mpm.solver import MPMSolver
    from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState, support_force
    from gaussian_swaying.recording.recorder import Recorder
    from gaussian_swaying.recording.trajectory import load_trajectory
    from gaussian_swaying.rendering.cameras.camera import Camera
    from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera, TransformsCamera
    from gaussian_swaying.rendering.cameras.keyframes import CameraKey, KeyframedCamera
    from gaussian_swaying.rendering.gsplat_renderer import GsplatRenderer
    from gaussian_swaying.rendering.shading import DiffuseShader, PhongShader
    from gaussian_swaying.rendering.torch_renderer import TorchRenderer
    from gaussian_swaying.simulation.diagnostics import SimulationDiverged, TearingGauge
    from gaussian_swaying.simulation.edits import Edit
    from gaussian_swaying.simulation.frame import Frame
    from gaussian_swaying.simulation.normalisation import Normalisation
    from gaussian_swaying.simulation.scene import Material, Scene, SimulatedScene
    from gaussian_swaying.simulation.simulation import Simulation
    from gaussian_swaying.training.data.datamodule import CaptureDataModule
    from gaussian_swaying.training.densification import DefaultDensification, MCMCDensification
    from gaussian_swaying.training.losses import LossInputs, LossTerm, TotalLoss
    from gaussian_swaying.training.module import SplatTrainer

_HOMES = {
    "aero.shelter": ("Shelter",),
    "aero.obstacles": (
        "CylinderObstacle",
        "EllipsoidObstacle",
        "SphereObstacle",
    ),
    "aero.recorded": (
        "FrozenWind",
        "RecordedWind",
    ),
    "aero.carried": (
        "CarriedField",
        "Turbulence",
    ),
    "aero.effects": (
        "LogProfile",
        "PowerProfile",
        "WindEffect",
    ),
    "aero.force": (
        "AeroForce",
        "aero_force",
    ),
    "aero.wind": (
        "FlowKey",
        "GaussianGust",
        "SineSway",
        "SpatialWind",
        "UniformGust",
        "WindField",
    ),
    "aero.wind_force": ("WindForce",),
    "captures.capture": (
        "Capture",
        "View",
        "read_capture",
    ),
    "captures.capture_camera": ("CaptureCamera",),
    "captures.generated_capture": ("GeneratedCapture",),
    "captures.initial_points": ("initial_points",),
    "captures.point_cloud": ("PointCloud",),
    "evaluation.compare": ("compare_run",),
    "fitting.fit": ("fit",),
    "gaussians.cloud": ("GaussianCloud",),
    "gaussians.compact": ("read_gaussians",),
    "gaussians.export": (
        "export_cloud",
        "write_usd",
    ),
    "gaussians.filling": ("InteriorFilling",),
    "gaussians.model": ("GaussianSurfaceModel",),
    "gaussians.ply": (
        "read_ply",
        "write_ply",
    ),
    "geometry.frame": ("SimFrame",),
    "geometry.keyed_path": ("KeyedPath",),
    "geometry.regions": (
        "Box",
        "Cylinder",
        "Sphere",
    ),
    "metrics.chamfer": (
        "ChamferDistance",
        "chamfer_distance",
    ),
    "metrics.frechet_video": (
        "FrechetVideoDistance",
        "frechet_distance",
    ),
    "mpm.boundaries.ball": ("BallObstacle",),
    "mpm.boundaries.block": ("BoxObstacle",),
    "mpm.boundaries.boundary": ("Boundary",),
    "mpm.boundaries.capsule": ("CapsuleObstacle",),
    "mpm.boundaries.enclosing_box": ("EnclosingBox",),
    "mpm.boundaries.half_space": ("HalfSpaceObstacle",),
    "mpm.boundaries.handle": ("Handle",),
    "mpm.boundaries.impulse": ("Impulse",),
    "mpm.boundaries.mesh": ("MeshObstacle",),
    "mpm.boundaries.pinned_points": ("PinnedPoints",),
    "mpm.boundaries.pinned_region": ("PinnedRegion",),
    "mpm.boundaries.plane": ("Plane",),
    "mpm.boundaries.sequential_release": ("SequentialRelease",),
    "mpm.boundaries.still_gaussians": ("StillGaussians",),
    "mpm.boundaries.velocity_box": ("VelocityBox",),
    "mpm.contact.surface": (
        "Contact",
        "Surface",
    ),
    "mpm.forces": ("Force",),
    "mpm.laws.fixed_corotated": ("FixedCorotated",),
    "mpm.laws.fluid": ("Fluid",),
    "mpm.laws.foam": ("Foam",),
    "mpm.laws.hencky": ("StVKHencky",),
    "mpm.laws.law": ("ConstitutiveLaw",),
    "mpm.laws.metal": ("Metal",),
    "mpm.laws.neo_hookean": ("NeoHookean",),
    "mpm.laws.plasticine": ("Plasticine",),
    "mpm.laws.sand": ("Sand",),
    "mpm.laws.snow": ("Snow",),
    "mpm.laws.spring_network": ("SpringNetwork",),
    "mpm.solver": ("MPMSolver",),
    "mpm.state": (
        "GridSpec",
        "MPMState",
        "MaterialPoints",
        "support_force",
    ),
    "rendering.cameras.camera": ("Camera",),
    "rendering.cameras.camera_path": (
        "LookAtCamera",
        "OrbitCamera",
        "TransformsCamera",
    ),
    "rendering.cameras.keyframes": (
        "CameraKey",
        "KeyframedCamera",
    ),
    "rendering.gsplat_renderer": ("GsplatRenderer",),
    "rendering.shading": (
        "DiffuseShader",
        "PhongShader",
    ),
    "rendering.torch_renderer": ("TorchRenderer",),
    "simulation.diagnostics": (
        "SimulationDiverged",
        "TearingGauge",
    ),
    "simulation.edits": ("Edit",),
    "interop.physgaussian.camera": ("PhysGaussianCamera",),
    "simulation.normalisation": ("Normalisation",),
    "simulation.frame": ("Frame",),
    "simulation.simulation": ("Simulation",),
    "recording.recorder": ("Recorder",),
    "recording.trajectory": ("load_trajectory",),
    "simulation.scene": (
        "Material",
        "Scene",
        "SimulatedScene",
    ),
    "training.data.datamodule": ("CaptureDataModule",),
    "training.densification": (
        "DefaultDensification",
        "MCMCDensification",
    ),
    "training.losses": (
        "LossInputs",
        "LossTerm",
        "TotalLoss",
    ),
    "training.module": ("SplatTrainer",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "AeroForce",
    "BallObstacle",
    "Boundary",
    "Box",
    "BoxObstacle",
    "Camera",
    "CameraKey",
    "CapsuleObstacle",
    "Capture",
    "CaptureCamera",
    "CaptureDataModule",
    "CarriedField",
    "ChamferDistance",
    "ConstitutiveLaw",
    "Contact",
    "Cylinder",
    "CylinderObstacle",
    "DefaultDensification",
    "DiffuseShader",
    "Edit",
    "EllipsoidObstacle",
    "EnclosingBox",
    "FixedCorotated",
    "FlowKey",
    "Fluid",
    "Foam",
    "Force",
    "Frame",
    "FrechetVideoDistance",
    "FrozenWind",
    "GaussianCloud",
    "GaussianGust",
    "GaussianSurfaceModel",
    "GeneratedCapture",
    "GridSpec",
    "GsplatRenderer",
    "HalfSpaceObstacle",
    "Handle",
    "Impulse",
    "InteriorFilling",
    "KeyedPath",
    "KeyframedCamera",
    "LogProfile",
    "LookAtCamera",
    "LossInputs",
    "LossTerm",
    "MCMCDensification",
    "MPMSolver",
    "MPMState",
    "Material",
    "MaterialPoints",
    "MeshObstacle",
    "Metal",
    "NeoHookean",
    "Normalisation",
    "OrbitCamera",
    "PhongShader",
    "PhysGaussianCamera",
    "PinnedPoints",
    "PinnedRegion",
    "Plane",
    "Plasticine",
    "PointCloud",
    "PowerProfile",
    "RecordedWind",
    "Recorder",
    "Sand",
    "Scene",
    "SequentialRelease",
    "Shelter",
    "SimFrame",
    "SimulatedScene",
    "Simulation",
    "SimulationDiverged",
    "SineSway",
    "Snow",
    "SpatialWind",
    "Sphere",
    "SphereObstacle",
    "SplatTrainer",
    "SpringNetwork",
    "StVKHencky",
    "StillGaussians",
    "Surface",
    "TearingGauge",
    "TorchRenderer",
    "TotalLoss",
    "TransformsCamera",
    "Turbulence",
    "UniformGust",
    "VelocityBox",
    "View",
    "WindEffect",
    "WindField",
    "WindForce",
    "aero_force",
    "chamfer_distance",
    "compare_run",
    "export_cloud",
    "fit",
    "frechet_distance",
    "initial_points",
    "load_trajectory",
    "read_capture",
    "read_gaussians",
    "read_ply",
    "support_force",
    "write_ply",
    "write_usd",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
