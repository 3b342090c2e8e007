"""Splats made in code, among them stand-ins for the captures of the paper."""

from gaussian_swaying.scenes.demo import DemoScene
from gaussian_swaying.scenes.procedural import FlagScene, GivenScene, ProceduralScene
from gaussian_swaying.scenes.solid import SolidScene

__all__ = ["DemoScene", "FlagScene", "GivenScene", "ProceduralScene", "SolidScene"]
