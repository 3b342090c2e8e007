import dataclasses

import pytest
import torch
from shared import advanced, double, longest, up_to, value_error
from small_scenes import together

from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene, homes, pieces_in_cells
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.suggest import why_apart

DX, GAP = 0.2, 0.13


def two_flags(gap=GAP):
    flag = FlagScene(spacing=0.03, width=0.9, height=0.6).generate()
    far = dataclasses.replace(flag, means=flag.means + torch.tensor([0.0, gap, 0.0]))
    return together(flag, far), torch.arange(2).repeat_interleave(len(flag.means))


def simulation(cloud, connected="surface", dx=DX, formulation="total", **scene):
    edge = up_to(x=0.05)
    solver = MPMSolver(dx, formulation, boundaries=[PinnedRegion(edge)])
    return Simulation(
        Scene(generator=GivenScene(cloud), connected=connected, metres_per_unit=1.0, **scene),
        Material(E=2e3, density=20.0, thickness=0.01),
        solver=solver,
        wind=[1.0, 2.0, 0.0],
        device="cpu",
    )


def ends(run, frames=4):
    state, _ = advanced(run, frames)
    return run.scene.deformed(state).means, state


@pytest.mark.parametrize("points", ["grid", "gaussian"])
@pytest.mark.parametrize("layers", [1, 3])
def test_flags_closer_than_a_cell_move_as_alone(points, layers):
    cloud, number = two_flags()
    how = {"points": points, "layers": layers, "area": "coverage"}
    both, state = ends(simulation(cloud, **how))
    assert state.grid.virtual > 0
    glued, _ = ends(simulation(cloud, "grid", **how))
    alone, _ = ends(simulation(cloud.select(number == 0), "grid", **how))
    rest = cloud.means[number == 0]
    far = longest(alone - rest)
    assert far > 0.02
    assert longest(both[number == 0] - alone) < 0.02 * far
    assert longest(glued[number == 0] - alone) > 0.05 * far


@pytest.mark.parametrize("points", ["grid", "gaussian"])
def test_one_flag_is_the_same_bit_for_bit(points):
    cloud, number = two_flags()
    flag = cloud.select(number == 0)
    (one, state), (other, same) = (ends(simulation(flag, how, points=points), 2) for how in ("grid", "surface"))
    assert torch.equal(one, other)
    assert state.grid == same.grid
    assert torch.equal(state.node_displacement, same.node_displacement)


def test_parts_correct_what_was_found():
    cloud, number = two_flags(gap=0.02)
    flags = [Part("pole", "held"), Part("near", attached="pole"), Part("far", attached="pole")]
    labels = torch.where(cloud.means[:, 0] < 0.1, 0, number + 1)
    apart = simulation(cloud, parts=Parts(labels, flags))
    glued = simulation(cloud, parts=Parts(labels, [Part(p.name, p.role) for p in flags]))
    assert apart.start().grid.virtual > 2 * glued.start().grid.virtual


def test_a_few_samples_beyond_a_border_are_grouped_across_it():
    """Cells end at halves: of 24 samples in a row along x, two lie beyond 1.5, and one on another piece."""
    row = torch.stack([torch.linspace(0.6, 1.54, 24), torch.ones(24), torch.ones(24)], 1).double()
    place = torch.cat([row, double([[1.6, 1.2, 1.0]])])
    pairs = torch.stack([torch.arange(23), torch.arange(1, 24)], 1)
    home, piece = homes(place, 1.0, pairs, pieces_in_cells(place, 1.0, pairs))
    beyond = (row[:, 0] > 1.5).nonzero()[:, 0].tolist()
    assert beyond
    assert piece[beyond[0]] == piece[0]
    assert home[beyond[0], 0] < 1.5
    assert torch.equal(home[: beyond[0]], place[: beyond[0]])
    assert torch.equal(home[24], place[24])


def test_it_needs_the_total_formulation():
    cloud, _ = two_flags()
    with value_error(r"`scene.connected: surface` needs `solver.formulation: total`"):
        simulation(cloud, formulation="updated")


def test_nodes_of_their_own_help_what_lies_close_and_is_held():
    cloud, number = two_flags()
    both = simulation(cloud).scene
    edge = cloud.means[:, 0] < 0.1
    assert why_apart(both, DX, edge) == "83 % lie within reach of a node beside what they are not attached to"
    assert why_apart(both, 0.01, edge) is None
    assert why_apart(both, DX, edge & (number == 0)) is None  # the other one would be blown away
