"""Things made in code, some as captured, the options of their previews, and the numbers that are suggested for them.

``python tests/golden/suggestions.py [CASE ...]`` writes the record that test_suggestions.py compares.
"""

import dataclasses
import json
import sys
from pathlib import Path

import torch

sys.path.append(str(Path(__file__).parents[1]))
import things
from places import place
from small_scenes import GREEN, shrub, young_tree

from gaussian_swaying import suggest
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.scenes.leaves import leafy_branch
from gaussian_swaying.scenes.telephone import telephone
from gaussian_swaying.scenes.vase import vase
from gaussian_swaying.simulation.simulation import classify

FILE = Path(__file__).parent / "files" / "suggestions.json"
UP = {"up": "+z"}


def captured(*parts, color=things.GREY):
    return things.as_captured(things.painted(torch.cat(parts), color, (-3.7, -3.7, -5.5)))


PLAIN = (
    "longest_side", "metres_per_unit", "size", "dx", "sheet", "azimuth", "flow", "kind", "material", "youngs_modulus",
    "thickness", "density", "connected",
)  # fmt: skip
# name: what makes the splat, and options
CASES = {
    "flag": (lambda: FlagScene(spacing=0.05).generate(), {}),
    "flag_on_a_pole": (things.flag_on_a_pole, {}),
    "plant": (lambda: things.potted_plant(0.02), {}),
    "tree": (things.small_tree, {}),
    "leaves": (lambda: leafy_branch(spacing=0.02), {}),
    "telephone": (lambda: telephone(spacing=0.02), {}),
    "vase": (lambda: vase(spacing=0.02), {}),
    "garden": (lambda: place(20_000, sh_degree=0)[0], {}),
    "washing_line": (lambda: things.plain_cloud(things.washing_line()[1], -4.0, logit=2.0), UP),
    "sign": (things.sign, UP),
    "conifer": (lambda: dataclasses.replace(things.cone(), means=things.cone().means + 5), {"look": "storm"}),
    "grass": (things.tuft, UP | {"wind": 0.0}),
    "figure": (lambda: things.figure(things.SKIN), UP),
    "captured_guitar": (lambda: captured(*things.guitar_on_a_stand()), {}),
    "captured_biker": (lambda: captured(*things.biker()), {}),
    "captured_man": (lambda: captured(*things.man()), {"quality": "normal"}),
    "captured_lamp": (lambda: captured(*things.lamp()), {}),
    "captured_pot": (lambda: captured(*things.plant_in_a_pot(), color=GREEN), {}),
    "captured_plant": (lambda: things.as_captured(things.potted_plant(0.015)), {"look": "gusts"}),
    "captured_flag": (lambda: things.as_captured(things.flag_on_a_pole()), {}),
    "captured_shrub": (lambda: things.as_captured(shrub()), {"longest_side": 1.5}),
    "captured_tree": (lambda: things.as_captured(young_tree()), {}),
    "captured_silk": (
        lambda: things.as_captured(FlagScene(spacing=0.04).generate()),
        {"hold": "-x", "material": "silk"},
    ),
}


def numbers_of(name):
    make, options = CASES[name]
    found = suggest(make(), **{"quality": "draft", "device": "cpu", **options})
    simulation, natural, parts = found.simulation, found.natural, found.parts
    state, counts = simulation.start(), [] if parts is None else parts.parts.labels.bincount().tolist()
    named = zip([] if parts is None else parts.parts.parts, counts, strict=True)
    names = ("frequency", "height", "mass", "frontal", "lean")
    return {key: getattr(found, key) for key in PLAIN} | {
        "up": [found.up.direction, found.up.confidence, int(found.ground.sum())],
        "region": [int(found.moving.simulated.sum()), found.moving.opacity_threshold, found.moving.specks],
        "hold": [found.hold.name, found.hold.direction, found.hold.confidence, found.hold.scores or {}],
        "parts": {part.name: [part.role, count] for part, count in named} or None,
        "natural": None if natural is None else {key: getattr(natural, key) for key in names},
        "formulation": simulation.solver.formulation,
        "things": [] if found.place is None else [len(thing.members) for thing in found.place.things],
        "start": [found.start * speed for speed in found.flow],
        "camera": found.camera,
        "drag": float(simulation.aero.C_D),
        "held": int(classify(simulation).pinned.sum()),
        "points": simulation.scene.points.count,
        "substeps": simulation.solver.substeps(state, simulation.frame_dt),
        "grid": simulation.solver.describe(state).get("grid", {}).get("resolution", []),
    }


if __name__ == "__main__":
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    for case in sys.argv[1:] or CASES:
        kept[case] = numbers_of(case)
    lines = [f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in CASES]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
