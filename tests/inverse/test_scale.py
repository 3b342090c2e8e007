"""The length of a scene unit as an unknown: the same motion as that of a scene of that length."""

import pytest
import torch
import yaml
from shared import merged, peak, value_error
from small_films import changed

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.inverse.plan import SCALE, Unknown
from gaussian_swaying.inverse.report import scene_text
from gaussian_swaying.inverse.variants import check_variants, states_of
from gaussian_swaying.scenes.patches import box, to_cloud
from gaussian_swaying.simulation.simulation import Simulation

TIMES = [0.0, 0.1, 0.2, 0.3]


def made(folder, metres_per_unit, **changes):
    """The flag, of another size, on the same cells."""
    grid = {"solver": {"dx": 0.1 * metres_per_unit}, "scene": {"metres_per_unit": metres_per_unit}}
    return changed(folder, **merged(grid, changes))


def moved(simulation, values):
    """Motion of the particles after 0.3 s [scene units]."""
    *_, (state,) = states_of(simulation, [values], TIMES)
    return simulation.scene.frame.displacement_to_scene(state.position - simulation.model.points.position)


@pytest.mark.parametrize("values", [{}, {"wind.speed": 4.0, "material.E": 2e4}])
def test_the_motion_is_that_of_the_scene_in_its_own_length(tmp_path, values):
    small, large = made(tmp_path, 1.0), made(tmp_path, 1.7)
    real = moved(large, values)
    assert peak(real) > 0.01
    torch.testing.assert_close(moved(small, values | {SCALE: 1.7}), real, rtol=1e-3, atol=1e-5)
    assert peak(moved(small, values) - real) > 0.01


def test_the_breadth_of_the_air_that_is_carried_is_in_metres(tmp_path):
    aero = {"added_mass": 0.4}
    small, large = made(tmp_path, 1.0, aero=aero), made(tmp_path, 1.7, aero=aero)
    real = moved(large, {})
    torch.testing.assert_close(moved(small, {SCALE: 1.7}), real, rtol=1e-3, atol=1e-5)
    assert peak(moved(small, {SCALE: 1.7, "aero.added_mass": 0.0}) - real) > 0.01


def test_a_filled_body_keeps_its_density(tmp_path):
    """A post of foam, bent by the wind and its weight."""
    write_ply(tmp_path / "post.ply", to_cloud(box([-0.06, -0.06, 0.0], [0.06, 0.06, 0.42], 0.01), overlap=0.5))
    foot = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [None, None, 0.04]}}
    pin = {"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": foot}}
    found = []
    for scale in (1.0, 1.7):
        scene = {"ply": str(tmp_path / "post.ply"), "metres_per_unit": scale, "filling": {"spacing": 0.03 * scale}}
        settings = {
            "frame_dt": 1 / 30,
            "scene": scene,
            "material": {"E": 4e3, "nu": 0.3, "density": 60.0, "law": "NeoHookean"},
            "solver": {"dx": 0.048 * scale, "boundaries": [pin]},
            "wind": {"flow": [4.0, 0.0, 0.0]},
            "aero": {"C_D": 1.0, "C_F": 0.0, "C_L": 0.0, "law": "projected"},
        }
        (tmp_path / "post.yaml").write_text(yaml.safe_dump(settings))
        found.append(Simulation.from_yaml(tmp_path / "post.yaml", device="cpu"))
    small, large = found
    real = moved(large, {})
    assert peak(real) > 0.01
    same, other = (moved(small, values).sort(0).values for values in ({SCALE: 1.7}, {}))  # as points are in any order
    torch.testing.assert_close(same, real.sort(0).values, rtol=1e-3, atol=1e-5)
    assert peak(other - real.sort(0).values) > 0.01


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {
            "wind": {
                "flow": None,
                "schedule": [{"time": 0.0, "flow": [4.0, 3.0, 0.0]}, {"time": 0.3, "flow": [1.0, 0.0, 0.0]}],
            }
        },
        {"material": {"bending": 0.02}},
    ],
)
def test_the_configuration_that_is_written_moves_as_the_fit(tmp_path, changes):
    small = made(tmp_path, 1.0, **changes)
    parser, values = Simulation.parser(), {"wind.speed": 4.0, "wind.azimuth": 20.0, "material.E": 2e4, SCALE: 1.7}
    if "wind" in changes:
        values = {"material.E": 2e4, SCALE: 1.7}
    settings = parser.parse_args(["--config", str(tmp_path / "made.yaml")])
    (tmp_path / "scene.yaml").write_text(scene_text(values, parser, settings, small))
    torch.testing.assert_close(
        moved(Simulation.from_yaml(tmp_path / "scene.yaml", device="cpu"), {}),
        moved(small, values),
        rtol=1e-3,
        atol=1e-5,
    )


def test_what_has_a_length_of_its_own_is_refused(tmp_path):
    unknown = Unknown(SCALE, 0.5, 2.0, "log")
    assert unknown.unit == "m"
    check_variants(made(tmp_path, 1.0), [unknown])
    gust = [{"class_path": "SineSway"}]
    for changes in (
        {"wind": {"modulations": gust}},
        {"solver": {"gravity": [0.0, 0.0, 0.0]}},
        {"scene": {"layers": 3}},
        {"material": {"bending": "plate"}},
    ):
        with value_error("only under `solver.gravity`, in a plain wind .* `scene.layers: 1` and"):
            check_variants(made(tmp_path, 1.0, **changes), [unknown])
