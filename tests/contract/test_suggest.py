"""``suggest`` as users meet it: a file or Gaussians in, reasons, a picture, a simulation and a configuration out."""

import inspect

import numpy as np
import pytest
import torch
from things import as_captured, flag_on_a_pole, guitar_on_a_stand, painted

import gaussian_swaying as gs

OPTIONS = [
    "up",
    "hold",
    "region",
    "move",
    "longest_side",
    "look",
    "wind",
    "kind",
    "material",
    "quality",
    "capture",
    "device",
]


@pytest.fixture(scope="module")
def flag(tmp_path_factory):
    file = tmp_path_factory.mktemp("flag") / "flag.ply"
    gs.write_ply(file, flag_on_a_pole(spacing=0.04))
    return gs.suggest(file, quality="draft", wind=6.0, device="cpu")


def test_the_options_are_those_of_the_command():
    from gaussian_swaying.cli.preview import build_options

    named = list(inspect.signature(gs.suggest).parameters)
    assert named == ["splat", *OPTIONS, "tune"]
    assert set(OPTIONS) <= set(vars(build_options().parse_args([])))


def test_what_it_says(flag):
    assert (flag.kind, flag.hold.name, flag.up.direction) == ("flag", "side", (0, 0, 1))
    assert repr(flag) == "Suggestion(flag: 600 Gaussians, held at the side)"
    assert "a flag on its pole" in flag.reasons["held"]
    assert flag.reasons["parts"].startswith("cloth soft (600 Gaussians), pole still")
    assert list(flag.reasons) == [
        "up",
        "region",
        "opacity",
        "held",
        "pin",
        "parts",
        "size",
        "grid",
        "kind",
        "material",
        "wind",
    ]


def test_its_simulation_moves_the_cloth_in_its_wind(flag):
    simulation = flag.to_simulation("cpu")
    assert float(simulation.wind.flows[0].norm()) == pytest.approx(6.0, abs=0.02)
    *_, last = simulation.frames(4)
    moved = (last.gaussians.means - simulation.scene.rest().means).norm(dim=-1)
    assert float(moved[flag.parts.mask("pole")].max()) == 0.0
    assert moved[flag.parts.mask("cloth")].max() > 1e-3


def test_its_picture_and_its_configuration(flag, tmp_path):
    assert flag.things() is None
    picture = flag.picture(height=96)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (192, 3)
    assert picture.std() > 10
    text = flag.to_yaml(tmp_path / "flag.yaml", frames=3)
    assert (tmp_path / "flag.yaml").read_text() == text
    same = gs.Simulation.from_yaml(tmp_path / "flag.yaml", device="cpu")
    assert same.frames_wanted == 3
    assert torch.equal(same.scene.points.position, flag.to_simulation("cpu").scene.points.position)


def test_gaussians_need_no_file():
    cloud = as_captured(painted(torch.cat(guitar_on_a_stand()), (0.5, 0.5, 0.5), (-3.7, -3.7, -5.5)))
    found = gs.suggest(cloud, quality="draft", device="cpu", longest_side=1.2)
    assert (found.kind, found.longest_side) == ("rigid", pytest.approx(1.2))
    assert found.natural.frequency == 40.0  # nothing of it is seen to sway
    assert len(found.to_simulation("cpu").scene.simulated) == found.moving.simulated.sum()
