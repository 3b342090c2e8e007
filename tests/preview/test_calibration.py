"""Calibration against laws that are known, and on small scenes."""

import math

import pytest
import torch
from small_scenes import plain_cloud

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.preview.calibration import (
    CLOSE,
    MOST_RUNS,
    SOFTEST,
    STIFFEST,
    THICKEST,
    THINNEST,
    Motion,
    Setting,
    calibrate,
    measure_motion,
)
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.material import Material

START = Setting(5e5, 0.01)


def beam(strength, bend=0.3, power=1.0):
    """Moves by (strength wind² / (E t))^power, 1.2 at most; ``bend`` is its strain at a displacement of 1."""

    def measure(setting):
        share = min(1.2, (strength * setting.wind**2 / (setting.E * setting.thickness)) ** power)
        stretch = max(0.01, 1 - bend * share)
        return Motion(min(share, 0.4), stretch, 1 + bend * share, complete=share < 0.4)

    return measure


@pytest.mark.parametrize("strength", [30.0, 300.0, 3000.0, 30000.0])
@pytest.mark.parametrize("power", [0.7, 1.0, 1.3])
@pytest.mark.parametrize("sway", [0.05, 0.1])
def test_a_share_is_reached_in_few_runs(strength, power, sway):
    found = calibrate(beam(strength, power=power), START, 1.0, sway)
    assert sway / CLOSE <= found.motion.share <= sway * CLOSE
    assert found.runs <= MOST_RUNS
    assert SOFTEST <= found.setting.E <= STIFFEST
    assert found.motion == beam(strength, power=power)(found.setting)  # what is said is what was run


def test_stiffness_goes_first_then_thickness_then_wind():
    soft = calibrate(beam(750.0), START, 1.0).setting
    assert (soft.thickness, soft.wind) == (0.01, 1.0)
    assert 5e5 < soft.E < STIFFEST
    thick = calibrate(beam(2500.0), START, 1.0, 0.1).setting
    assert (thick.E, thick.wind) == (STIFFEST, 1.0)
    assert THICKEST >= thick.thickness > 0.01
    blown = calibrate(beam(1e5), START, 1.0)
    assert (blown.setting.E, blown.setting.thickness) == (STIFFEST, THICKEST)
    assert 0.1 < blown.setting.wind < 0.3
    assert "wind was reduced to" in blown.reason


def test_what_can_hardly_move_says_so():
    stout = calibrate(beam(0.1), START, 1.0)
    assert (stout.setting.E, stout.setting.thickness, stout.setting.wind) == (SOFTEST, THINNEST, 1.0)
    assert "hardly moves" in stout.reason


def test_a_thin_neck_limits_the_motion():
    """Stretched by 0.5 where the whole moves by 0.1: it moves less instead."""
    found = calibrate(beam(1000.0, bend=5.0), START, 1.0)
    assert found.motion.strain <= 1
    assert found.motion.share == pytest.approx(0.25 / 5, rel=0.2)
    assert "stretch" in found.reason


def test_a_sheet_moves_as_far_as_it_likes():
    def cloth(setting):
        return Motion(0.6, 0.9, 1 + 4e3 / setting.E)

    found = calibrate(cloth, Setting(6e3, 0.01), 1.0, None)
    assert found.motion.strain <= 1
    assert 6e3 < found.setting.E < 2e4
    assert (found.setting.thickness, found.setting.wind) == (0.01, 1.0)
    strong = calibrate(cloth, Setting(2e4, 0.01), 1.0, None)
    assert (strong.setting.E, strong.runs) == (2e4, 1)


@pytest.mark.parametrize("sway", [0.0, 0.7, math.nan])
def test_a_share_that_cannot_be_meant_is_refused(sway):
    with pytest.raises(ValueError, match=r"`--sway`"):
        calibrate(beam(1.0), START, 1.0, sway)


def test_a_run_leaves_the_scene_as_it_was_and_feels_the_setting(make_simulation):
    simulation = make_simulation(
        gravity=(0.0, 0.0, 0.0), material=Material(E=3e3, density=1000.0)
    )  # slower than the wind
    points, flows = simulation.scene.points, simulation.wind.flows
    base = Setting(3e3, 0.01)
    shares = {}
    for name, setting in (("base", base), ("weak", Setting(3e3, 0.01, 0.5)), ("thick", Setting(3e3, 0.03))):
        motion = measure_motion(simulation, setting, base, seconds=0.12)
        shares[name] = motion.share
        assert 0.9 < motion.growth < 1.5  # of three frames
        assert simulation.scene.points is points
        assert simulation.wind.flows is flows
    assert shares["weak"] == pytest.approx(shares["base"] / 4, rel=0.1)  # too short to be held back: by force
    assert shares["thick"] == pytest.approx(shares["base"] / 3, rel=0.15)  # by mass
    assert not measure_motion(simulation, base, base, sway=shares["base"] / 20, seconds=0.12).complete


# ---- real ones


def _patches(means, outward, size):
    """Flat Gaussians with a normal each."""
    normal = torch.nn.functional.normalize(outward, dim=-1)
    angle = normal[:, 2].clamp(-1, 1).acos() / 2
    axis = torch.nn.functional.normalize(torch.stack([-normal[:, 1], normal[:, 0], 0 * angle], -1) + 1e-9, dim=-1)
    quats = torch.cat([angle.cos()[:, None], angle.sin()[:, None] * axis], -1)
    return plain_cloud(means, torch.tensor([size, size, 0.1 * size]).log(), quats)


def post(upside_down=False):
    """A post of 6 cm radius and 0.6 m, a ball of 20 cm radius on top of it: 1 m."""
    draw = torch.Generator().manual_seed(0)
    angle, height = 2 * math.pi * torch.rand(700, generator=draw), 0.62 * torch.rand(700, generator=draw)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    ball = torch.nn.functional.normalize(torch.randn(1500, 3, generator=draw), dim=-1)
    means = torch.cat(
        [0.06 * out + height[:, None] * torch.tensor([0, 0, 1.0]), 0.2 * ball + torch.tensor([0, 0, 0.8])]
    )
    outward = torch.cat([out, ball])
    if upside_down:
        means, outward = means * torch.tensor([1, 1, -1.0]), outward * torch.tensor([1, 1, -1.0])
    return _patches(means + 3.0, outward, 0.012)


def curtain():
    cloud = FlagScene(spacing=0.03).generate()
    return cloud


@pytest.mark.slow(twin="test_a_run_leaves_the_scene_as_it_was_and_feels_the_setting")
@pytest.mark.parametrize("what", ["standing", "hanging", "sheet"])
def test_draft_and_starter_move_as_wanted(what, tmp_path):
    """From the splat to the two configurations, which are run for 2 and 4 s."""
    from gaussian_swaying.cli import preview as preview_cli
    from gaussian_swaying.simulation.simulation import Simulation

    cloud = {"standing": post, "hanging": lambda: post(upside_down=True), "sheet": curtain}[what]()
    write_ply(tmp_path / "it.ply", cloud)
    hold = ["--hold", {"standing": "bottom", "hanging": "top", "sheet": "top"}[what]]
    out = tmp_path / "out"
    assert (
        preview_cli.main([str(tmp_path / "it.ply"), "--up", "+z", *hold, "--output", str(out), "--device", "cpu"]) == 0
    )
    share = {}
    for name, frames in (("draft", 51), ("starter", 101)):
        parser = Simulation.parser()
        simulation = Simulation.from_settings(parser, parser.parse_args(["--config", str(out / f"{name}.yaml")]))
        base = Setting(1.0, 1.0)
        motion = measure_motion(simulation, base, base, seconds=0.04 * (frames - 1))
        assert motion.complete
        assert motion.stretch_min > 0.7
        assert motion.stretch_max < 1.4
        share[name] = motion.share
    if what == "sheet":
        assert share["draft"] > 0.1
    else:
        assert 0.06 < share["draft"] < 0.14
        assert 0.05 < share["starter"] < 0.2
