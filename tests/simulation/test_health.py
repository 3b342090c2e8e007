"""What a run says about its own shape when it ends."""

import json

import pytest
import torch

from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.body import Material
from gaussian_swaying.simulation.measure import advice, extremes
from gaussian_swaying.simulation.record import run_health

WHERE = torch.tensor([[0.0, 0, 0], [1.0, 2, 3], [4.0, 5, 6]])


def entry(time, moved=(0.1, 0), low=(0.9, 1), high=(1.1, 2)):
    return {
        "time": time, "displacement_max": moved[0], "moved_particle": moved[1], "stretch_min": low[0],
        "compressed_particle": low[1], "stretch_max": high[0], "stretched_particle": high[1],
    }  # fmt: skip


def test_the_worst_of_all_frames_with_place_and_time():
    log = [entry(0.1), entry(0.2, moved=(0.5, 1), low=(0.3, 2)), entry(0.3, high=(1.5, 1))]
    found = extremes(log, WHERE, 2.0, None)
    assert found["moved"] == {"value": 0.5, "at": [1, 2, 3], "time": 0.2, "share": 0.25}
    assert found["compressed"] == {"value": 0.3, "at": [4, 5, 6], "time": 0.2}
    assert found["stretched"] == {"value": 1.5, "at": [1, 2, 3], "time": 0.3}
    # particles that flow are not asked for their stretch
    flowing = extremes(log, WHERE, 2.0, torch.tensor([True, True, False]))
    assert flowing["compressed"]["value"] == 0.9
    nothing = extremes([], WHERE, 2.0, None)
    assert set(nothing.values()) == {None}
    assert advice(nothing, 1e5) == []


@pytest.mark.parametrize(
    ("log", "words"),
    [
        ([entry(0.2, moved=(1.3, 1), low=(0.03, 2))], ["compressed to 0.03 of its length at [4, 5, 6]", "1.3 m, 65%"]),
        ([entry(0.2, high=(3.5, 1))], ["stretched to 3.5 times its length at [1, 2, 3]", "after 0.2 s"]),
        ([entry(0.2, low=(0.4, 0), high=(2.5, 1))], ["compressed to 0.4", "and stretched to 2.5"]),
    ],
)  # fmt: skip
def test_sentences_name_place_amount_and_remedy(log, words):
    said = advice(extremes(log, WHERE, 2.0, None), 5e4)
    assert len(said) == 3
    for word in (*words, "`material.E` to about", "`material.thickness`", "`wind.flow`", "`solver.boundaries`"):
        assert word in " ".join(said), (word, said)
    assert "pins" in said[-1]
    assert "pins" not in " ".join(advice(extremes(log, WHERE, 2.0, None), 5e4, pins=False))
    assert "thickness" not in " ".join(advice(extremes(log, WHERE, 2.0, None), 5e4, thickness_matters=False))


def test_nothing_is_said_when_all_is_well():
    assert advice(extremes([entry(0.1), entry(0.2, low=(0.5, 0), high=(2.0, 1))], WHERE, 2.0, None), 5e4) == []


def test_remedy_grows_with_the_trouble():
    mild, bad = (advice(extremes([entry(0.1, low=(low, 0))], WHERE, 1.0, None), 1e5)[-1] for low in (0.49, 0.01))
    assert "3e+05 Pa" in mild
    assert "4e+05 Pa" in bad


def test_a_run_that_folds_says_so_and_keeps_it(make_simulation, tmp_path, capsys):
    simulation = make_simulation(material=Material(E=20.0, density=10.0))
    summary = simulation.run(tmp_path / "bad", 12, recorder=Recorder(renders=()))
    assert summary["stretch_max"] > 2
    said = capsys.readouterr().err
    for sentence in summary["warnings"]:
        assert f"warning: {sentence}" in said
    worst = max(summary["per_frame"], key=lambda frame: frame["displacement_max"])
    place = simulation.scene.model.means[simulation.scene.simulated[worst["moved_particle"]]]
    assert summary["extremes"]["moved"]["at"] == pytest.approx(place.tolist(), abs=1e-3)
    assert summary["extremes"]["moved"]["value"] == worst["displacement_max"]
    assert json.loads((tmp_path / "bad/summary.json").read_text())["warnings"] == summary["warnings"]
    still = make_simulation(material=Material(E=1e5, density=30.0))
    good = still.run(tmp_path / "good", 3, recorder=Recorder(renders=()))
    (coarse,) = good["warnings"]  # of a scene of five cells
    assert "5.5 cells of `solver.dx`" in coarse
    assert capsys.readouterr().err.count("warning") == 1


def test_what_flows_is_not_reproached_with_its_stretch(make_simulation, make_cloud):
    simulation = make_simulation(
        make_cloud(count=300), material=Material(E=1e4, law=Sand()), pinned=False, formulation="updated"
    )
    with torch.inference_mode():
        simulation.start()
    log = [entry(0.1, low=(0.01, 0), high=(9.0, 1))]
    found, said = run_health(simulation.stepper, log)
    assert not any("length" in sentence for sentence in said)
    assert found["stretched"] is None
    assert found["moved"]["value"] == 0.1
