"""The public names of the package; everything else is imported from its room."""

from ._live import Live as Live
from .captures.capture import read_capture as read_capture
from .evaluation.compare import compare_run as compare_run
from .gaussians.cloud import GaussianCloud as GaussianCloud
from .gaussians.formats import export_cloud as export_cloud
from .gaussians.formats import read_gaussians as read_gaussians
from .gaussians.model import GaussianSurfaceModel as GaussianSurfaceModel
from .gaussians.ply import write_ply as write_ply
from .geometry.regions import Box as Box
from .geometry.regions import Cylinder as Cylinder
from .geometry.regions import Sphere as Sphere
from .inverse.fit import fit as fit
from .mpm.boundary import Boundary as Boundary
from .mpm.contact import Contact as Contact
from .mpm.forces import Force as Force
from .mpm.laws.law import ConstitutiveLaw as ConstitutiveLaw
from .mpm.pins import PinnedPoints as PinnedPoints
from .mpm.pins import PinnedRegion as PinnedRegion
from .mpm.solver import MPMSolver as MPMSolver
from .mpm.state import MaterialPoints as MaterialPoints
from .mpm.state import MPMState as MPMState
from .recording.recorder import Recorder as Recorder
from .recording.trajectory import load_trajectory as load_trajectory
from .rendering.cameras.camera_path import LookAtCamera as LookAtCamera
from .rendering.cameras.camera_path import OrbitCamera as OrbitCamera
from .rendering.shading import DiffuseShader as DiffuseShader
from .simulation.body import Material as Material
from .simulation.body import Scene as Scene
from .simulation.draw import Frame as Frame
from .simulation.measure import SimulationDiverged as SimulationDiverged
from .simulation.model import Copy as Copy
from .simulation.model import Edit as Edit
from .simulation.simulation import Simulation as Simulation
from .suggestion.suggest import suggest as suggest
from .training.data.datamodule import CaptureDataModule as CaptureDataModule
from .training.module import SplatTrainer as SplatTrainer
from .wind.field import GaussianGust as GaussianGust
from .wind.field import SineSway as SineSway
from .wind.field import SpatialWind as SpatialWind
from .wind.field import UniformGust as UniformGust
from .wind.field import WindField as WindField
from .wind.force import AeroForce as AeroForce
from .wind.force import WindForce as WindForce
from .wind.force import aero_force as aero_force

__version__: str
