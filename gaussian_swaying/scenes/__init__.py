"""Splats made in code, among them stand-ins for the captures of the paper."""

from gaussian_swaying.scenes.alocasia import AlocasiaScene
from gaussian_swaying.scenes.cloths import ClothScene
from gaussian_swaying.scenes.ficus import FicusScene
from gaussian_swaying.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.scenes.leaves import LeavesScene
from gaussian_swaying.scenes.procedural import FlagScene, GivenScene, ProceduralScene
from gaussian_swaying.scenes.sand import SandScene
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.scenes.telephone import TelephoneScene
from gaussian_swaying.scenes.vase import VaseScene
from gaussian_swaying.scenes.windbreaks import FicusBehindWallScene, PlantRowScene

__all__ = [
    "AlocasiaScene",
    "ClothScene",
    "FicusBehindWallScene",
    "FicusScene",
    "FlagOnStandScene",
    "FlagScene",
    "GivenScene",
    "LeavesScene",
    "PlantRowScene",
    "ProceduralScene",
    "SandScene",
    "SolidScene",
    "TelephoneScene",
    "VaseScene",
]
