import dataclasses

import numpy as np
import pytest
import torch
from shared import beyond, in_both, near, peak, up_to, value_error

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.laws.elastic import FixedCorotated, NeoHookean
from gaussian_swaying.mpm.laws.plastic import Foam, Plasticine, Sand
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.body import Material, MaterialRegion
from gaussian_swaying.simulation.model import Edit, edited_points, recolored
from gaussian_swaying.wind.field import WindField

FREE_HALF = [0.55, None, None], [None, None, None]
WHITE = [0.95, 0.95, 0.95]


def _free_half():
    return Box(*FREE_HALF)


def _with(simulation, *edits):
    simulation.editor.__init__(simulation.stepper, edits)
    return simulation


def _white(simulation):
    return (simulation.scene.model.sh0[:, 0] * SH_DC + 0.5 - 0.95).abs().amax(-1) < 1e-6


def _frames(simulation, frames):
    return [frame.state for frame in simulation.frames(frames + 1)]


# ---- functions


def test_points_change_within_the_region_only():
    points = MaterialPoints.create(
        torch.rand(6, 3), volume=2e-3, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3, law=FixedCorotated(),
        normal=torch.tensor([0.0, 0.0, 1.0]).expand(6, 3), bending=2.0,
    )  # fmt: skip
    inside = torch.tensor([True, False, True, False, False, True])
    found = edited_points(points, inside, Edit(E=5e3, nu=0.1, density=50.0, law=NeoHookean()))
    assert torch.equal(found.youngs_modulus, torch.where(inside, 5e3, 1e4))
    torch.testing.assert_close(found.poisson_ratio, torch.where(inside, 0.1, 0.3))
    torch.testing.assert_close(found.mass, torch.where(inside, 0.1, 0.2))
    torch.testing.assert_close(found.bending, torch.where(inside, 1.0, 2.0))
    assert [type(law) for law in found.laws] == [FixedCorotated, NeoHookean]
    assert torch.equal(found.law_index, inside.long())
    assert torch.equal(points.youngs_modulus, torch.full((6,), 1e4))
    whole = edited_points(found, ~inside, Edit(law=NeoHookean()))
    assert [type(law) for law in whole.laws] == [NeoHookean, NeoHookean]
    gone = edited_points(found, torch.ones(6, dtype=torch.bool), Edit(law=Plasticine(10.0, 0.0, 1.0)))
    assert [type(law) for law in gone.laws] == [Plasticine]
    assert gone.law_index is None


def test_colours_of_a_region():
    sh = torch.rand(5, 4, 3) - 0.5
    inside = torch.tensor([True, True, False, True, False])
    found = recolored(sh, inside, [0.9, 0.8, 0.7])
    torch.testing.assert_close(found[inside][:, 0] * SH_DC + 0.5, torch.tensor([0.9, 0.8, 0.7]).expand(3, 3))
    assert not found[inside][:, 1:].any()
    assert torch.equal(found[~inside], sh[~inside])
    kept = recolored(sh, inside, [0.9, 0.8, 0.7], detail=1.0)[inside][:, 0] * SH_DC + 0.5
    weights = torch.tensor([0.2126, 0.7152, 0.0722])
    before, after = ((sh[inside][:, 0] * SH_DC + 0.5) @ weights, kept @ weights)
    torch.testing.assert_close(after / after.mean(), before / before.mean())
    torch.testing.assert_close(kept / kept[:, :1], torch.tensor([1.0, 8 / 9, 7 / 9]).expand(3, 3))


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({}, "changes nothing"),
        ({"E": -1.0}, "`edits.E`"),
        ({"nu": 0.5}, "`edits.nu`"),
        ({"density": 0.0}, "`edits.density`"),
        ({"time": -1.0, "E": 1.0}, "`edits.time`"),
        ({"color": [1.0, 2.0, 0.0]}, "`edits.color` to lie in"),
        ({"color": [1.0, 0.0]}, "`edits.color` to have 3 numbers"),
        ({"color": WHITE, "detail": 2.0}, "`edits.detail`"),
    ],
)
def test_bad_edits(fields, word):
    with value_error(word):
        Edit(**fields)


# ---- at load


@in_both
def test_an_edit_at_load_is_a_region_of_the_material(formulation, make_simulation):
    law = NeoHookean()
    base = Material(E=3e3, density=30.0)
    region = MaterialRegion(_free_half(), E=9e3, nu=0.1, density=60.0, law=law)
    expected = make_simulation(material=dataclasses.replace(base, regions=[region]), formulation=formulation)
    edit = Edit(_free_half(), E=9e3, nu=0.1, density=60.0, law=law)
    found = _with(make_simulation(material=base, formulation=formulation), edit)
    assert torch.equal(_frames(found, 2)[-1].position, _frames(expected, 2)[-1].position)
    assert found.editor.applied == 1


def test_a_colour_at_load_is_that_of_the_first_picture(make_simulation, tmp_path):
    simulation = _with(make_simulation(), Edit(color=[1.0, 0.0, 1.0]))
    summary = simulation.run(tmp_path / "run", 1, progress=False)
    assert summary["edits"] == 1
    color = simulation.painter.render(simulation.start(), 0)
    solid = color.alpha[..., 0] > 0.9
    assert solid.any()
    torch.testing.assert_close(
        (color.color / color.alpha.clamp_min(0.1))[solid], torch.tensor([1.0, 0.0, 1.0]).expand(int(solid.sum()), 3)
    )


def test_no_region_is_all_that_moves(make_cloud, make_simulation):
    cloud = make_cloud()
    cloud.opacities[5] = -6.0
    settings = {"pinned": False, "scene": {"region": up_to(x=0.5)}}
    simulation = make_simulation(cloud, **settings)
    moves = cloud.means[:, 0] <= 0.5
    for region, expected in ((None, moves), (beyond(x=0.3), cloud.means[:, 0] >= 0.3)):
        _with(simulation, Edit(region, color=WHITE)).start()
        assert torch.equal(_white(simulation), expected)
        simulation.editor.reset()
    particles, gaussians = simulation.editor.reach(Edit(E=1.0))
    assert particles.all()
    assert not gaussians.any()


# ---- during a run


@in_both
def test_nothing_but_the_stress_changes_at_once(formulation, make_simulation):
    """A part ten times stiffer from 0.08 s: the same until then, other afterwards; positions do not jump."""
    edited = _with(make_simulation(formulation=formulation), Edit(_free_half(), time=0.08, E=3e4, color=WHITE))
    before = edited.scene.model.sh0.detach().clone()
    found, plain = _frames(edited, 4), _frames(make_simulation(formulation=formulation), 4)
    for k in range(3):
        assert torch.equal(found[k].position, plain[k].position)
        assert torch.equal(found[k].velocity, plain[k].velocity)
    assert peak(found[4].position - plain[4].position) > 1e-4
    assert torch.equal(_white(edited), edited.scene.model.means[:, 0] >= 0.55)
    # a second run of the same simulation begins anew, with all as it was
    again = _frames(edited, 4)
    assert all(torch.equal(a.position, b.position) for a, b in zip(again, found, strict=True))
    edited.start()
    assert torch.equal(edited.scene.model.sh0, before)
    assert float(edited.scene.points.youngs_modulus.max()) == 3e3


def test_sand_becomes_foam(make_cloud, make_simulation):
    """The paper's edit: the internal variable of sand is gone, deformations and positions are not."""
    block = make_cloud(60, degree=0)
    material = Material(E=1e5, nu=0.3, density=1600.0, thickness=0.2, law=Sand(friction_angle=30.0))
    settings = {"material": material, "pinned": False, "formulation": "updated", "wind": WindField()}
    foam = Edit(time=0.04, E=2e3, density=100.0, law=Foam(50.0, 1.0), color=WHITE)
    simulation = _with(make_simulation(block, **settings), foam)
    states = _frames(simulation, 2)
    assert [type(law) for law in simulation.solver.points.laws] == [Foam]
    assert states[1].internal is None or not states[1].internal.any()
    assert torch.isfinite(states[2].position).all()
    plain = _frames(make_simulation(block, **settings), 1)
    assert torch.equal(states[1].F_total, plain[1].F_total)
    assert torch.equal(states[1].F_elastic, plain[1].F_elastic)


def test_what_has_flowed_and_turns_elastic_keeps_its_shape(make_cloud, make_simulation):
    material = Material(E=1e5, density=1000.0, thickness=0.2, law=Plasticine(1.0, 0.0, 1.0))
    simulation = make_simulation(make_cloud(60, degree=0), material=material, pinned=False, formulation="updated")
    state = simulation.start()
    shear = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # 1/s, so 0.16 within a frame
    state = state.replace(velocity=state.position @ shear.T, affine=shear.expand_as(state.affine))
    state, _ = simulation.advance(state)
    flowed = simulation.edit(state, Edit(law=NeoHookean()))
    gap = float(peak(flowed.F_total - flowed.F_elastic))
    assert gap > 0.05
    end, _ = simulation.advance(flowed)
    assert peak(end.F_total - end.F_elastic) > 0.5 * gap
    # the factor of flow that is kept: F_total = F_elastic F_plastic
    kept = torch.linalg.solve(end.F_elastic, end.F_total)
    near(kept, torch.linalg.solve(flowed.F_elastic, flowed.F_total), 1e-4)


def test_what_cannot_be_is_refused_before_anything_is_written(make_simulation, tmp_path):
    folder = tmp_path / "run"
    flows = _with(make_simulation(), Edit(time=0.08, law=Sand(friction_angle=30.0)))
    with value_error(r"Sand flows.*`solver.formulation` to updated"):
        flows.run(folder, 2, progress=False, recorder=Recorder())
    stiff = _with(make_simulation(substep=0.004), Edit(time=0.08, E=3e7))
    with value_error(r"fixed `substep` of 0\.004 s is longer than the stable one"):
        stiff.run(folder, 2, progress=False, recorder=Recorder())
    with value_error(r"of `edits` at 0\.08 s holds no simulated Gaussian"):
        _with(make_simulation(), Edit(Box([9, 9, 9], [10, 10, 10]), time=0.08, E=1.0))
    with value_error("of `edits` at 0 s holds no Gaussian"):
        _with(make_simulation(), Edit(Box([9, 9, 9], [10, 10, 10]), color=WHITE))
    assert not folder.exists()


@pytest.mark.gpu
def test_a_gpu_goes_on_with_new_graphs(make_simulation):
    ends = []
    for device in ("cpu", "cuda"):
        simulation = make_simulation().to(device)
        _with(simulation, Edit(_free_half(), time=0.08, E=3e4))
        ends.append(_frames(simulation, 4)[-1].position.cpu().numpy())
    plain = _frames(make_simulation(), 4)[-1].position.numpy()
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-4)
    assert np.abs(ends[0] - plain).max() > 1e-3
