"""The grid on which the live page keeps up with real time, with made-up costs and with a flag."""

import pytest
from shared import value_error
from small_scenes import run_cost

from gaussian_swaying.player import session
from gaussian_swaying.player.session import HEADROOM, finest_within, in_real_time, sentence
from gaussian_swaying.simulation.simulation import Simulation

CONFIGURED, COARSEST = 0.032, 0.075


def machine(speed, power):
    """Seconds for 2 s of motion where the configured grid has a speed, which grows with a power of dx; those tried."""
    tried = []

    def cost(dx):
        tried.append(dx)
        return 2.0 / speed * (CONFIGURED / dx) ** power

    return cost, tried


@pytest.mark.parametrize("power", [1.0, 2.5, 3.0, 4.0])
def test_the_finest_grid_in_real_time_is_found_by_few_trials(power):
    """It grows finer with the speed of the machine, is never finer than configured, and never too coarse.

    A trial aims at a little more than is needed, so the grid is up to a tenth coarser than it could be, or a quarter if
    the time falls with dx itself.
    """
    before, wish = COARSEST, 2.0 / HEADROOM
    for speed in (0.01, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.2, 1.3, 5.0):
        cost, tried = machine(speed, power)
        dx, costs = finest_within(cost, wish, CONFIGURED, COARSEST)
        assert CONFIGURED <= dx <= 1.1 * before
        assert list(costs) == tried
        assert len(tried) <= 3
        if cost(COARSEST) > wish:
            assert dx == COARSEST
        else:
            assert costs[dx] <= wish
            assert dx == CONFIGURED or cost(dx / (1.25 if power == 1 else 1.15)) > wish
        before = dx
    assert before == CONFIGURED


def test_a_grid_that_is_fast_enough_or_the_limit_is_kept_after_one_trial():
    for speed, coarsest in ((1.3, COARSEST), (0.1, 0.02)):
        cost, tried = machine(speed, 3.0)
        assert finest_within(cost, 2.0 / HEADROOM, CONFIGURED, coarsest)[0] == CONFIGURED
        assert tried == [CONFIGURED]


@pytest.mark.parametrize(("most", "found"), [(0.033, 0.032), (0.041, 0.04), (0.06, 0.055)])
def test_a_grid_too_coarse_to_start_is_passed_over(most, found):
    """Of those that could start, the finest that is fast enough, or the fastest; the configured one must start."""
    cost, _ = machine(0.4, 2.5)

    def limited(dx):
        if dx > most:
            raise ValueError("a pin holds nothing")
        return cost(dx)

    assert finest_within(limited, 2.0 / HEADROOM, CONFIGURED, COARSEST)[0] == pytest.approx(found, abs=1e-4)
    with value_error("a pin holds nothing"):
        finest_within(limited, 2.0 / HEADROOM, 2 * most, COARSEST)


def test_the_sentence_names_grid_speed_and_how_to_get_the_configured_one():
    assert sentence(0.032, 0.05, 0.4, 1.337) == (
        "Chose a grid of 0.05 m, predicted to run at 1.3 x real time here, instead of the configured 0.032 m "
        "(0.4 x): --grid configured, or Grid on the page, takes that one."
    )
    assert "0.075 m, the fastest one found, predicted to run at 0.5 x" in sentence(0.032, 0.075, 0.1, 0.5)
    assert sentence(0.1, 0.1, 2.0, 2.0) == (
        "The configured grid of 0.1 m is kept, predicted to run at 2 x real time here."
    )
    assert sentence(0.1, 0.1, 0.5, 0.5).endswith("; no coarser one that shows the object was found.")


def test_a_scene_gets_the_chosen_grid_and_its_settings_stay(parser, settings, monkeypatch):
    """Whatever a trial takes at first does not count."""
    settings.solver.dx = 0.05
    asked = []

    def estimate(simulation, frames, budget, pictures):
        asked.append((simulation.solver.dx, frames, budget, pictures))
        seconds = 2.0 / 0.7 * (0.05 / simulation.solver.dx) ** 3
        return run_cost(simulation.solver.dx, simulation_seconds=seconds, startup_seconds=9.0)

    monkeypatch.setattr(session, "estimate_cost", estimate)
    choice = in_real_time(parser, settings, Simulation.from_settings(parser, settings))
    assert settings.solver.dx == 0.05
    assert choice.settings.solver.dx == choice.simulation.solver.dx == 0.065
    assert choice.sentence.startswith("Chose a grid of 0.065 m, predicted to run at 1.5 x")
    assert asked[0] == (0.05, 51, session.BUDGET, False)


def test_a_trial_of_a_flag_chooses_by_its_speed(parser, settings, monkeypatch):
    """With real trials: any machine is faster than the first wish, and none reaches the second.

    The flag is 1.2 m long, from the first Gaussian to the last a little less: at most 0.073 m, a sixteenth.
    """
    settings.solver.dx = 0.04
    monkeypatch.setattr(session, "BUDGET", 0.05)
    monkeypatch.setattr(session, "HEADROOM", 1e-6)
    simulation = Simulation.from_settings(parser, settings)
    kept = in_real_time(parser, settings, simulation)
    assert kept.simulation is simulation
    assert kept.settings is settings
    monkeypatch.setattr(session, "HEADROOM", 1e6)
    assert in_real_time(parser, settings, simulation).simulation.solver.dx == 0.073
