"""Mean winds that grow with the height and plumes, against their formulas and measurements."""

import math
import re
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch
from shared import double

from gaussian_swaying import SimFrame, WindField, wind
from gaussian_swaying.wind.effects import LogProfile, Moment, Plume, PowerProfile, WindEffect

NOW = Moment(torch.zeros((), dtype=torch.float64), torch.zeros(3).double(), torch.zeros(3).double())


def speeds(profile, heights):
    """Speed at some heights above the origin, in a wind of 8 m/s."""
    place = torch.zeros(len(heights), 3, dtype=torch.float64)
    place[:, 2] = torch.tensor(heights)
    wind = profile(double([8.0, 0.0, 0.0]), place, NOW)
    assert wind[:, 1:].abs().max() == 0
    return wind[:, 0].tolist()


def test_the_logarithmic_profile():
    profile = LogProfile(ground=(0.0, 0.0, -2.0), height=10.0, roughness=0.1)
    found = speeds(profile, [8.0, -1.0, -1.95, -5.0])  # 10 m, 1 m, below the roughness, and below the ground
    assert found == pytest.approx([8.0, 8.0 * math.log(10) / math.log(100), 0.0, 0.0])


def test_the_power_law():
    found = speeds(PowerProfile(ground=(0.0, 0.0, 1.0), height=10.0, exponent=0.2), [11.0, 1.3125, 0.5])
    assert found == pytest.approx([8.0, 8.0 * 0.03125**0.2, 0.0])  # 0.03125 is half to the fifth


def test_a_roughness_above_the_height_is_refused():
    with pytest.raises(ValueError, match=r"Expected `roughness` .* to be below `height`"):
        LogProfile(height=1.0, roughness=2.0)


class Flat(WindEffect):
    """Forgets that places have three coordinates, or returns no tensor."""

    def __init__(self, kind):
        super().__init__()
        self.kind = kind

    def forward(self, velocity, position, moment):
        return {"speed": velocity[0] * position[:, 2], "swapped": position.T[:, :3], "number": 1.0}[self.kind]


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("speed", ValueError, r"`velocity of Flat` of shape \(3,\), but got \(5,\)"),
        ("swapped", ValueError, r"`velocity of Flat` of shape \(5, 3\), but got \(3, 3\)"),
        ("number", TypeError, "`velocity of Flat` to be a torch.Tensor, but got float"),
    ],
)
def test_an_effect_that_returns_another_shape_is_named(kind, error, message):
    wind = WindField([1.0, 0.0, 0.0], effects=[Flat(kind)])
    with pytest.raises(error, match=message):
        wind.at(torch.zeros((), dtype=torch.float64), torch.zeros(5, 3))


def test_the_documented_effects_are_those_that_there_are():
    """All that a YAML can name; a ``CarriedField`` takes a tensor."""
    names = set()
    for found in iter_modules(wind.__path__):
        for kind in vars(import_module(f"{wind.__name__}.{found.name}")).values():
            known = isinstance(kind, type) and issubclass(kind, WindEffect) and kind.twin is not WindEffect.twin
            names |= {kind.__name__} - {"CarriedField", "Tabulated"} if known else set()
    docs = Path(__file__).parents[2] / "docs"
    (row,) = (line for line in (docs / "configuration.md").read_text().splitlines() if "`wind.effects`" in line)
    assert set(re.findall("`([A-Z][A-Za-z]+)`", row)) == names, "docs/configuration.md lists others at `wind.effects`"
    page = (docs / "wind.md").read_text()
    missing = sorted(name for name in names if not re.search(rf"\b{name}\b", page))
    assert missing == [], "docs/wind.md says nothing of these"


def plume_at(plume, place):
    return plume(torch.zeros(3, dtype=torch.float64), double(place), NOW)


def test_a_plume_rises_as_fast_as_over_a_fire():
    """Heskestad's 1.03 Q^(1/3) z^(-1/3) with Q in kW, and NFPA 92's mass flow 0.071 Q^(1/3) z^(5/3) kg/s."""
    plume = Plume(source=(0.3, 0.2, -1.0), radius=1e-6, heat=2e4)
    radius = torch.linspace(0, 1.5, 3001, dtype=torch.float64)
    place = torch.stack([0.3 + radius, 0.2 + 0 * radius, 0 * radius + 1.0], dim=-1)
    up = plume(torch.zeros(3, dtype=torch.float64), place, NOW)[:, 2]
    assert float(up[0]) == pytest.approx(1.03 * (20 / 2) ** (1 / 3), rel=0.01)
    flow = 1.2 * torch.trapezoid(2 * math.pi * radius * up, radius)
    assert float(flow) == pytest.approx(0.071 * 20 ** (1 / 3) * 2 ** (5 / 3), rel=0.1)


def test_a_plume_has_no_divergence_and_draws_air_in():
    plume = Plume(source=(0.0, 0.0, -1.0), radius=0.05)
    place = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    place[0] = torch.tensor([0.0, 0.0, 0.3])  # on the axis
    change = torch.vmap(torch.func.jacrev(lambda x: plume(torch.zeros(3).double(), x, NOW)))(place)
    assert change.diagonal(dim1=1, dim2=2).sum(-1).abs().max() < 1e-10 * change.abs().max()
    assert plume_at(plume, [0.6, 0.0, 0.0])[0] < -0.01
    assert plume_at(plume, [0.0, 0.0, -1.001]).abs().max() == 0


def test_a_plume_is_as_wide_as_its_source_there():
    plume = Plume(radius=0.2)
    middle, edge = plume_at(plume, [[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])[:, 2]
    assert float(edge / middle) == pytest.approx(math.exp(-1))


def test_a_plume_in_scene_units():
    frame = SimFrame(double([1.0, 0.0, 0.0]), torch.eye(3).double(), 2.0)
    moved = Plume(source=(1.5, 0.0, 0.0), radius=0.1, heat=500.0).in_frame(frame)
    place = [[1.1, 0.2, 0.7]]
    torch.testing.assert_close(plume_at(moved, place), plume_at(Plume((1.0, 0.0, 0.0), 0.2, 500.0), place))


@pytest.mark.parametrize("name", ["radius", "heat"])
def test_a_plume_without_heat_or_width_is_refused(name):
    with pytest.raises(ValueError, match=f"Expected `{name}` to be positive"):
        Plume(**{name: 0.0})
