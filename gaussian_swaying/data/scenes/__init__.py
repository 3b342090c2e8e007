"""The scenes of the paper as splats made in code, which stand in for its captures."""

from gaussian_swaying.data.scenes.alocasia import AlocasiaScene
from gaussian_swaying.data.scenes.ficus import FicusScene
from gaussian_swaying.data.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.data.scenes.leaves import LeavesScene
from gaussian_swaying.data.scenes.sand import SandScene
from gaussian_swaying.data.scenes.telephone import TelephoneScene
from gaussian_swaying.data.scenes.vase import VaseScene

__all__ = ["AlocasiaScene", "FicusScene", "FlagOnStandScene", "LeavesScene", "SandScene", "TelephoneScene", "VaseScene"]
