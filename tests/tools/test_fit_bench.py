"""``bench.py fit``: errors against the truth, and tables that say what is reached and what is missed."""

import pytest
from bench.cases import fit as case
from bench.tables import fit as tables

HEAD = {"device": "a CPU", "versions": {"torch": "2"}, "seed": 0}
ROW = {
    "speed_error": 0.004,
    "direction_error_deg": 0.5,
    "material.E_error": -0.008,
    "psnr_predicted_db": 31.26,
    "seconds": 12.4,
    "points": 1200,
    "size": [200, 120],
    "until_s": 0.75,
}


def test_errors_of_a_flow():
    found = case.errors([0.0, 2.2, 0.0], [2.0, 0.0, 0.0])
    assert found["speed_error"] == pytest.approx(0.1)
    assert found["direction_error_deg"] == pytest.approx(90.0)


def test_the_settings_of_own_data_are_a_simulation(tmp_path):
    import yaml

    from gaussian_swaying.simulation.simulation import Simulation

    (tmp_path / "base.yaml").write_text(yaml.safe_dump(case._settings(case.SIZES["cpu"])))
    simulation = Simulation.from_yaml(tmp_path / "base.yaml", device="cpu")
    assert set(simulation.painter.cameras) == {"left", "right"}
    assert simulation.wind.flows[0].tolist() == case.TRUTH["flow"]


def test_missed_goals_are_said_to_be_missed():
    rows = {"two cameras": ROW, "one camera": ROW | {"speed_error": -0.02}, "pixels alone": ROW | {"speed_error": 0.9}}
    lines = tables.own([HEAD | {"own": rows}])
    assert "| two cameras | +0.40 % | 0.50° | -0.80 % | 31.3 dB | 12 s | yes |" in lines
    assert "| one camera | -2.00 % | 0.50° | -0.80 % | 31.3 dB | 12 s | no |" in lines
    told = tables.own([HEAD | {"own": {"two cameras": ROW | {"not_settled": "The values have not settled."}}}])
    assert any(line.startswith("| two cameras (not settled) | +0.40 %") for line in told)
    assert "| pixels alone | +90.00 % | 0.50° | -0.80 % | 31.3 dB | 12 s |  |" in lines
    found = tables.blender(
        [
            HEAD
            | {
                "blender": {
                    "flag, two cameras": ROW | {"speed_error": 0.07, "known": {"solver.dx": 0.06}},
                    "flag, one camera": ROW | {"speed_error": 0.07},
                    "curtain, two cameras": {"refused": "The video cannot tell."},
                }
            }
        ]
    )
    assert [line.split(" | ")[-1] for line in found if line.startswith(("| flag", "| curtain"))] == [
        "no |",
        "yes |",
        "no |",
    ]
    assert any("| 0.75 s; `solver.dx` 0.06 | no |" in line for line in found)
    assert tables.blender([HEAD]) == ["Not measured yet."]


def test_rows_of_a_case_of_blender():
    truth = {"flow": [3.0, -4.0, 0.0], "speed": 5.0, "C_D": 1.0}
    rows = case.blender_rows({"aero.law": "linear", "solver.dx": 0.1}, truth)
    assert rows["tracks alone"] == {"stages": ["tracks"]}
    assert rows["without patches"]["known"] == {
        "aero.law": "projected",
        "solver.dx": 0.1,
        "aero.C_D": pytest.approx(0.8),
        "aero.C_F": pytest.approx(0.8),
    }


def test_predicted_frames_are_compared_with_what_the_splat_reaches_at_rest():
    rows = {
        f"flag {k}, two cameras": ROW | {"psnr_predicted_db": p, "psnr_rest_db": r, "known": {}}
        for k, (p, r) in enumerate([(28.5, 30.0), (27.0, 30.0), (26.5, 26.0)])
    }
    rows["flag 3, tracks alone"] = ROW | {"psnr_rest_db": 30.0}
    found = [line.split(" | ") for line in tables.blender([HEAD | {"blender": rows}]) if line.startswith("| flag")]
    assert [line[7] for line in found] == ["yes", "no", "yes", "yes"]
    assert found[3][-1] == " |" or found[3][-1] == "|"
