"""Wind on captured 3D Gaussian scenes: aerodynamics on the normals and areas of Gaussians, in PyTorch.

Public names are imported when they are first used, so importing the package needs torch and numpy only.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from gaussian_swaying.aero.force import AeroForce, aero_force
    from gaussian_swaying.aero.wind import FlowKey, GaussianGust, SineSway, SpatialWind, UniformGust, WindField
    from gaussian_swaying.aero.wind_force import WindForce
    from gaussian_swaying.data.capture import Capture, View, read_capture
    from gaussian_swaying.data.capture_camera import CaptureCamera
    from gaussian_swaying.data.datamodule import CaptureDataModule
    from gaussian_swaying.data.generated_capture import GeneratedCapture
    from gaussian_swaying.data.initial_points import initial_points
    from gaussian_swaying.data.point_cloud import PointCloud
    from gaussian_swaying.gaussians.compact import read_gaussians
    from gaussian_swaying.gaussians.export import export_cloud, write_usd
    from gaussian_swaying.gaussians.filling import InteriorFilling
    from gaussian_swaying.gaussians.ply import GaussianCloud, read_ply, write_ply
    from gaussian_swaying.gaussians.selection import Box, Cylinder, Sphere
    from gaussian_swaying.gaussians.surface import GaussianSurfaceModel
    from gaussian_swaying.metrics.chamfer import ChamferDistance, chamfer_distance
    from gaussian_swaying.metrics.compare import compare_run
    from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance, frechet_distance
    from gaussian_swaying.mpm.boundary import (
        Boundary,
        EnclosingBox,
        Handle,
        Impulse,
        PinnedRegion,
        Plane,
        SequentialRelease,
        VelocityBox,
    )
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
    from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
    from gaussian_swaying.rendering.camera import Camera
    from gaussian_swaying.rendering.camera_path import LookAtCamera, OrbitCamera, TransformsCamera
    from gaussian_swaying.rendering.gsplat_renderer import GsplatRenderer
    from gaussian_swaying.rendering.keyframes import CameraKey, KeyframedCamera
    from gaussian_swaying.rendering.shading import DiffuseShader, PhongShader
    from gaussian_swaying.rendering.torch_renderer import TorchRenderer
    from gaussian_swaying.simulation.diagnostics import SimulationDiverged, TearingGauge
    from gaussian_swaying.simulation.edits import Edit
    from gaussian_swaying.simulation.frame import SimFrame
    from gaussian_swaying.simulation.physgaussian_camera import PhysGaussianCamera
    from gaussian_swaying.simulation.physgaussian_space import Normalisation
    from gaussian_swaying.simulation.pipeline import SimulationPipeline
    from gaussian_swaying.simulation.recorder import Recorder
    from gaussian_swaying.simulation.scene import Material, Scene, SimulatedScene
    from gaussian_swaying.simulation.trajectory import load_trajectory
    from gaussian_swaying.training.densification import DefaultDensification, MCMCDensification
    from gaussian_swaying.training.losses import LossInputs, LossTerm, TotalLoss
    from gaussian_swaying.training.module import SplatTrainer

_HOMES = {
    "aero.force": ("AeroForce", "aero_force"),
    "aero.wind": ("FlowKey", "GaussianGust", "SineSway", "SpatialWind", "UniformGust", "WindField"),
    "aero.wind_force": ("WindForce",),
    "data.capture": ("Capture", "View", "read_capture"),
    "data.capture_camera": ("CaptureCamera",),
    "data.datamodule": ("CaptureDataModule",),
    "data.generated_capture": ("GeneratedCapture",),
    "data.initial_points": ("initial_points",),
    "data.point_cloud": ("PointCloud",),
    "gaussians.compact": ("read_gaussians",),
    "gaussians.export": ("export_cloud", "write_usd"),
    "gaussians.filling": ("InteriorFilling",),
    "gaussians.ply": ("GaussianCloud", "read_ply", "write_ply"),
    "gaussians.selection": ("Box", "Cylinder", "Sphere"),
    "gaussians.surface": ("GaussianSurfaceModel",),
    "metrics.chamfer": ("ChamferDistance", "chamfer_distance"),
    "metrics.compare": ("compare_run",),
    "metrics.frechet_video": ("FrechetVideoDistance", "frechet_distance"),
    "mpm.boundary": (
        "Boundary",
        "EnclosingBox",
        "Handle",
        "Impulse",
        "PinnedRegion",
        "Plane",
        "SequentialRelease",
        "VelocityBox",
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
    "mpm.state": ("GridSpec", "MPMState", "MaterialPoints"),
    "rendering.camera": ("Camera",),
    "rendering.camera_path": ("LookAtCamera", "OrbitCamera", "TransformsCamera"),
    "rendering.gsplat_renderer": ("GsplatRenderer",),
    "rendering.keyframes": ("CameraKey", "KeyframedCamera"),
    "rendering.shading": ("DiffuseShader", "PhongShader"),
    "rendering.torch_renderer": ("TorchRenderer",),
    "simulation.diagnostics": ("SimulationDiverged", "TearingGauge"),
    "simulation.edits": ("Edit",),
    "simulation.frame": ("SimFrame",),
    "simulation.physgaussian_camera": ("PhysGaussianCamera",),
    "simulation.physgaussian_space": ("Normalisation",),
    "simulation.pipeline": ("SimulationPipeline",),
    "simulation.recorder": ("Recorder",),
    "simulation.scene": ("Material", "Scene", "SimulatedScene"),
    "simulation.trajectory": ("load_trajectory",),
    "training.densification": ("DefaultDensification", "MCMCDensification"),
    "training.losses": ("LossInputs", "LossTerm", "TotalLoss"),
    "training.module": ("SplatTrainer",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "AeroForce",
    "Boundary",
    "Box",
    "Camera",
    "CameraKey",
    "Capture",
    "CaptureCamera",
    "CaptureDataModule",
    "ChamferDistance",
    "ConstitutiveLaw",
    "Cylinder",
    "DefaultDensification",
    "DiffuseShader",
    "Edit",
    "EnclosingBox",
    "FixedCorotated",
    "FlowKey",
    "Fluid",
    "Foam",
    "Force",
    "FrechetVideoDistance",
    "GaussianCloud",
    "GaussianGust",
    "GaussianSurfaceModel",
    "GeneratedCapture",
    "GridSpec",
    "GsplatRenderer",
    "Handle",
    "Impulse",
    "InteriorFilling",
    "KeyframedCamera",
    "LookAtCamera",
    "LossInputs",
    "LossTerm",
    "MCMCDensification",
    "MPMSolver",
    "MPMState",
    "Material",
    "MaterialPoints",
    "Metal",
    "NeoHookean",
    "Normalisation",
    "OrbitCamera",
    "PhongShader",
    "PhysGaussianCamera",
    "PinnedRegion",
    "Plane",
    "Plasticine",
    "PointCloud",
    "Recorder",
    "Sand",
    "Scene",
    "SequentialRelease",
    "SimFrame",
    "SimulatedScene",
    "SimulationDiverged",
    "SimulationPipeline",
    "SineSway",
    "Snow",
    "SpatialWind",
    "Sphere",
    "SplatTrainer",
    "SpringNetwork",
    "StVKHencky",
    "TearingGauge",
    "TorchRenderer",
    "TotalLoss",
    "TransformsCamera",
    "UniformGust",
    "VelocityBox",
    "View",
    "WindField",
    "WindForce",
    "aero_force",
    "chamfer_distance",
    "compare_run",
    "export_cloud",
    "frechet_distance",
    "initial_points",
    "load_trajectory",
    "read_capture",
    "read_gaussians",
    "read_ply",
    "write_ply",
    "write_usd",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
