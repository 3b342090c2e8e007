"""Things made in code, some as captured, the options of their previews, and the numbers that are suggested for them.

``python tests/golden/suggestions.py [CASE ...]`` writes the record that test_suggestions.py compares.
"""

import dataclasses
import json
import sys
import tempfile
import warnings
from pathlib import Path

import torch
import yaml

sys.path.append(str(Path(__file__).parents[1]))
import things
from places import place
from small_scenes import GREEN, previewed, shrub, young_tree

from gaussian_swaying.scenes import FlagScene, LeavesScene, TelephoneScene, VaseScene

FILE = Path(__file__).parent / "files" / "suggestions.json"
UP = ("--up=+z",)

PLAIN = (
    "longest_side_m", "metres_per_unit", "size_m", "dx_m", "sheet", "azimuth", "flow", "material",
    "youngs_modulus_Pa", "thickness_m", "density_kg_m3", "formulation",
)  # fmt: skip


def captured(*parts, color=things.GREY):
    return things.as_captured(things.painted(torch.cat(parts), color, (-3.7, -3.7, -5.5)))


# name: what makes the splat, and options
CASES = {
    "flag": (lambda: FlagScene(spacing=0.05).generate(), ()),
    "flag_on_a_pole": (things.flag_on_a_pole, ()),
    "plant": (lambda: things.potted_plant(0.02), ()),
    "tree": (things.small_tree, ()),
    "leaves": (lambda: LeavesScene(spacing=0.02).generate(), ()),
    "telephone": (lambda: TelephoneScene(spacing=0.02).generate(), ()),
    "vase": (lambda: VaseScene(spacing=0.02).generate(), ()),
    "garden": (lambda: place(20_000, sh_degree=0)[0], ()),
    "washing_line": (lambda: things.plain_cloud(things.washing_line()[1], -4.0, logit=2.0), UP),
    "sign": (things.sign, UP),
    "conifer": (lambda: dataclasses.replace(things.cone(), means=things.cone().means + 5), ("--look", "storm")),
    "grass": (things.tuft, (*UP, "--wind", "0")),
    "figure": (lambda: things.figure(things.SKIN), UP),
    "captured_guitar": (lambda: captured(*things.guitar_on_a_stand()), ()),
    "captured_biker": (lambda: captured(*things.biker()), ()),
    "captured_man": (lambda: captured(*things.man()), ("--quality", "normal")),
    "captured_lamp": (lambda: captured(*things.lamp()), ()),
    "captured_pot": (lambda: captured(*things.plant_in_a_pot(), color=GREEN), ()),
    "captured_plant": (lambda: things.as_captured(things.potted_plant(0.015)), ("--look", "gusts")),
    "captured_flag": (lambda: things.as_captured(things.flag_on_a_pole()), ()),
    "captured_shrub": (lambda: things.as_captured(shrub()), ("--longest-side", "1.5")),
    "captured_tree": (lambda: things.as_captured(young_tree()), ()),
    "captured_silk": (lambda: things.as_captured(FlagScene(spacing=0.04).generate()), ("--hold=-x", "--material=silk")),
}


def numbers_of(name, folder):
    """The numbers of a suggestion, without times."""
    make, options = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        preview, _ = previewed(make(), folder, *options, up="")
    guess, run, cost = (preview.data[key] for key in ("suggestion", "run", "cost"))
    starter = yaml.safe_load(preview.starter)
    found = {
        key: guess[key] for key in ("longest_side_m", "metres_per_unit", "size_m", "dx_m", "sheet", "azimuth", "flow")
    }
    found |= {
        key: guess[key] for key in ("material", "youngs_modulus_Pa", "thickness_m", "density_kg_m3", "formulation")
    }
    return found | {
        "up": [guess["up"][key] for key in ("direction", "confidence", "floor_gaussians")],
        "region": [guess["region"][key] for key in ("simulated", "opacity_threshold", "specks")],
        "hold": [guess["hold"][key] for key in ("end", "direction", "confidence", "scores")],
        "parts": None if guess["parts"] is None else guess["parts"]["parts"],
        "kind": guess["kind"]["name"],
        "natural": guess["natural"],
        "things": [thing["gaussians"] for thing in preview.data.get("place", {"things": []})["things"]],
        "start": starter["wind"]["effects"][0]["init_args"]["start"],
        "drag": starter["aero"]["C_D"],
        "connected": starter["scene"].get("connected", "grid"),
        "camera": [starter["camera"]["init_args"][key] for key in ("radius", "target_offset")],
        "held": run["held"],
        "points": run["points"],
        "substeps": cost["substeps"],
        "grid": cost["grid"],
    }


if __name__ == "__main__":
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    for case in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder:
            kept[case] = numbers_of(case, Path(folder))
    lines = [f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in CASES]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
