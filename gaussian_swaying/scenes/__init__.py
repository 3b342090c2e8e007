"""The scenes of the paper as splats made in code, in place of its captures."""

from gaussian_swaying.scenes.alocasia import AlocasiaScene
from gaussian_swaying.scenes.ficus import FicusScene
from gaussian_swaying.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.scenes.leaves import LeavesScene
from gaussian_swaying.scenes.sand import SandScene
from gaussian_swaying.scenes.telephone import TelephoneScene
from gaussian_swaying.scenes.vase import VaseScene

__all__ = ["AlocasiaScene", "FicusScene", "FlagOnStandScene", "LeavesScene", "SandScene", "TelephoneScene", "VaseScene"]
