"""The scenes of the shipped configurations, by their kind."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from gaussian_swaying._checks import check_positive
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.alocasia import alocasia
from gaussian_swaying.scenes.cloths import cloths
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.scenes.leaves import WOOD, leafy_branch
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.scenes.sand import sand_bear
from gaussian_swaying.scenes.telephone import telephone
from gaussian_swaying.scenes.vase import vase
from gaussian_swaying.scenes.windbreaks import ficus_behind_wall, plant_row

MADE: dict[str, Callable[..., GaussianCloud]] = {
    "alocasia": alocasia,
    "ball_on_cloth": partial(cloths, "drop"),
    "cloth_over_ball": partial(cloths, "ball"),
    "cloth_over_table": partial(cloths, "table"),
    "ficus": ficus,
    "ficus_behind_wall": ficus_behind_wall,
    "leaves": leafy_branch,
    "plant_row": plant_row,
    "sand": sand_bear,
    "telephone": telephone,
    "two_flags": partial(cloths, "flags"),
    "vase": vase,
}


@dataclass(eq=False)
class DemoScene(ProceduralScene):
    """A plant or another thing made in code; the functions of :data:`MADE` say how it looks.

    Args:
        kind: Which.
        spacing: Distance between Gaussians [m]; None for that of its kind, as in the following.
        count: Number of leaves, of flowers, or of turns of the cord.
        size: Sides of a cloth [m], or the radius of the floor round an alocasia on which copies can stand.
    """

    kind: Literal[
        "alocasia", "ball_on_cloth", "cloth_over_ball", "cloth_over_table", "ficus", "ficus_behind_wall", "leaves",
        "plant_row", "sand", "telephone", "two_flags", "vase",
    ]  # fmt: skip
    spacing: float | None = None
    count: int | None = None
    size: float | None = None

    def __post_init__(self) -> None:
        given = self._given()
        for name, value in given.items():
            if name not in inspect.signature(MADE[self.kind]).parameters:
                raise ValueError(f"`generator.{name}` means nothing for the kind `{self.kind}`: leave it out.")
            check_positive(f"generator.{name}", value, allow_zero=name == "size")
        if given.get("spacing", 0) > 0.2:
            raise ValueError(f"Expected `generator.spacing` of at most 0.2 m, but got {self.spacing} m.")
        if self.kind == "leaves" and given.get("count", 150) < len(WOOD):
            raise ValueError(f"Expected `generator.count` of at least {len(WOOD)}, one a twig, but got {self.count}.")

    def _given(self) -> dict[str, Any]:
        given = {name: getattr(self, name) for name in ("spacing", "count", "size")}
        return {name: value for name, value in given.items() if value is not None}

    def generate(self) -> GaussianCloud:
        return MADE[self.kind](**self._given())
