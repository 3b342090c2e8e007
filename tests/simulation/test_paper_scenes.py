from pathlib import Path

import pytest
import torch
import yaml
from shared import double

from gaussian_swaying.cli.simulate import output_folder
from gaussian_swaying.simulation.simulation import Simulation

CONFIGS = Path(__file__).parents[2] / "configs/sim"
# E, nu, density, C_D, C_F, C_L, flow, from the paper's table of parameters
PAPER = {
    "ficus": (2e6, 0.4, 300, 0.5, 0.4, 0.01, [1.7, 0, 0]),
    "leaves": (1e4, 0.4, 15, 0.5, 0.4, 0.01, [1.7, 0, 0]),
    "sand": (5e5, 0.3, 200, 0.4, 0.3, 0.01, [10, 0, 0]),
    "telephone": (5e5, 0.4, 200, 0.5, 0.4, 0.01, [-1, 0, 1]),
    "alocasia": (2e6, 0.4, 300, 0.5, 0.4, 0.01, [0, -0.2, 0]),
    "vase": (1e4, 0.3, 20, 0.4, 0.3, 0.005, [0, 0, -1.5]),
    "flag1": (5e3, 0.3, 50, 0, 0, 0, [0, 0, 0]),
    "flag2": (3e3, 0.3, 30, 0.1, 0.3, 0.005, [2.5, 0.5, 0]),
    "flag3": (3e3, 0.3, 20, 0.1, 0.3, 0.005, [2, 0, 0]),
}


SHAPED = ("plant_row", "ficus_behind_wall")
"""Scenes of docs/wind.md, which are not the paper's."""


def files(name):
    return ["--config", str(CONFIGS / f"{name}.yaml"), "--config", str(CONFIGS / f"preview/{name}.yaml")]


TOUCHING = {"ball_on_cloth", "cloth_over_ball", "cloth_over_table", "two_flags"}
"""Scenes that are not the paper's: those of docs/contact.md."""


def test_every_scene_has_its_preset():
    assert {path.stem for path in (CONFIGS / "preview").glob("*.yaml")} == {*PAPER, *SHAPED, *TOUCHING}


@pytest.mark.parametrize("name", PAPER)
def test_the_numbers_are_the_papers(name):
    settings = Simulation.parser().parse_args(["--config", str(CONFIGS / f"{name}.yaml")])
    material, aero, wind = settings.material, settings.aero, settings.wind
    flow = wind.schedule[0].flow if wind.schedule else wind.flow
    assert (material.E, material.nu, material.density) == PAPER[name][:3]
    assert not any(getattr(entry, field) for entry in material.regions for field in ("E", "nu", "density", "law"))
    assert PAPER[name][3:6] == (aero.C_D, aero.C_F, aero.C_L)
    given = PAPER[name][6]  # in axes that the paper does not give: those of the vase are turned here
    assert list(flow) == ([given[2], given[1], given[0]] if name == "vase" else given)
    assert material.law.class_path.endswith("Sand" if name == "sand" else "FixedCorotated")
    assert settings.solver.formulation == ("updated" if name == "sand" else "total")
    assert settings.scene.opacity_threshold == (0.02 if name == "sand" else 0.1)
    assert (settings.frames, settings.frame_dt) == (250, 0.04)
    assert (settings.camera.init_args.width, settings.camera.init_args.height) == (1920, 1080)


def test_the_wind_of_the_vase_turns():
    parser = Simulation.parser()
    wind = parser.instantiate(parser.parse_args(files("vase"))).wind
    assert [wind.mean_flow(double(t)).tolist() for t in (0.0, 9.0)] == [
        [-1.5, 0, 0],
        [1.5, 0, 0],
    ]


@pytest.mark.parametrize("name", PAPER)
def test_the_preset_is_a_small_version(name):
    """Fewer Gaussians on a coarser grid in a smaller picture; pins and regions still hold some.

    A coarse grid is stiffer, so thicknesses, which the paper leaves open, may be smaller. Some are half as long.
    Nothing else differs.
    """
    parser = Simulation.parser()
    full, small = (parser.parse_args(arguments) for arguments in (files(name)[:2], files(name)))
    changed = yaml.safe_load((CONFIGS / f"preview/{name}.yaml").read_text())
    if "frames" in changed:  # half as long, for scenes with many substeps
        assert changed.pop("frames") == 125
    if name == "sand":  # of a larger bear, as sand takes the most substeps
        assert changed["scene"].pop("metres_per_unit") == 0.5
        sway = small.wind.modulations[0].init_args
        assert changed.pop("wind")["modulations"][0]["init_args"]["period"] == sway.period == 10.0
        assert (sway.amplitude, small.wind.modulations[1].init_args.std) == (0.5, 0.3)
    assert set(changed) - {"material"} == {"scene", "solver", "camera"}
    assert set(changed.get("material", {})) <= {"thickness", "regions"}
    assert small.material.thickness <= full.material.thickness
    assert len(small.material.regions) == len(full.material.regions)
    for one, other in zip(small.material.regions, full.material.regions, strict=True):
        assert one.region == other.region
        assert one.thickness <= other.thickness
    if "points_per_cell" in changed["scene"]:
        assert changed["scene"].pop("points_per_cell") < full.scene.points_per_cell
    assert set(changed["scene"]) == {"generator"}
    assert small.scene.generator.init_args.spacing > 2 * full.scene.generator.init_args.spacing
    assert small.solver.dx > full.solver.dx
    assert (small.camera.init_args.width, small.camera.init_args.height) == (480, 270)
    assert output_folder(small) == Path("outputs") / name
    simulation = Simulation.from_settings(parser, small)
    assert 500 < simulation.scene.points.count < 5000
    with torch.inference_mode():
        simulation.start()
