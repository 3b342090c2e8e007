import math

import pytest
import torch
from shared import ZERO, double, near, peak, rand, seeded, solid, value_error
from torch.testing import assert_close

from gaussian_swaying import MPMSolver
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.mpm.joints import Joints, PointJoint
from gaussian_swaying.mpm.timestep import stable_limit

AT = double([1.0, 0.1, 0.2])


def blocks(flat=False):
    side = torch.arange(4).double() / 4
    one = torch.cartesian_prod(side, side, 0 * side if flat else side)
    place = torch.cat([one, one + double([1.05, 0.0, 0.1])])
    number = torch.arange(2).repeat_interleave(len(one))
    density = 100 * (1 + rand(len(place), generator=seeded(0)))
    points = solid(place, 0.01, density, attached=number)
    return points, [(number == k).nonzero()[:, 0] for k in (0, 1)]


def moved(points, sets, turns, shifts):
    state = MPMSolver(0.5).init_state(points)
    position, F = state.position.clone(), state.F_total.clone()
    for own, turn, shift in zip(sets, turns, shifts, strict=True):
        R = rotation_of(double(turn))
        position[own] = (points.position[own] - AT) @ R.T + AT + double(shift)
        F[own] = R
    return state.replace(position=position, F_total=F)


@pytest.mark.parametrize("flat", [False, True])
def test_springs_act_on_what_parts_and_turns(flat):
    points, sets = blocks(flat)
    joint = PointJoint(*sets, AT.tolist(), 30.0, 7.0)
    joints = Joints(points, [joint], 1e-6)
    together = [0.4, -0.3, 0.8]
    still = joints(moved(points, sets, [together] * 2, [[1.0, 2.0, 3.0]] * 2))
    assert peak(still) < 1e-10
    turn, shift = [0.0, 0.0, 0.3], [0.01, 0.02, -0.03]
    state = moved(points, sets, [turn, [0.0] * 3], [shift, [0.0] * 3])
    force = joints(state)
    first, second = (force[own].sum(0) for own in sets)
    gap = double(shift)
    assert_close(first, -30.0 * gap, rtol=1e-6, atol=1e-9)
    near(second, -first, 1e-12)
    arm = state.position[sets[0]] - (AT + gap)
    torque = torch.linalg.cross(arm, force[sets[0]]).sum(0)
    assert_close(torque, double([0.0, 0.0, -2.1]), rtol=1e-6, atol=1e-8)
    batch = state.replace(position=state.position.expand(2, -1, -1), F_total=state.F_total.expand(2, -1, -1, -1))
    assert torch.equal(joints(batch)[1], force)


def test_a_joint_to_a_place_and_several_at_once():
    points, sets = blocks()
    one, other = PointJoint(sets[0], None, [0.0, 0.0, 0.0], 5.0), PointJoint(*sets, AT.tolist(), 30.0)
    state = moved(points, sets, [[0.1, 0.2, 0.3], [0.0] * 3], [[0.1, 0.0, 0.0], [0.0, 0.3, 0.0]])
    each = [Joints(points, [joint], 1e-3)(state) for joint in (other, one)]
    near(Joints(points, [one, other], 1e-3)(state), sum(each), 1e-12)
    anchor = AT - rotation_of(double([0.1, 0.2, 0.3])) @ AT
    anchor[0] += 0.1
    assert_close(each[1][sets[0]].sum(0), -5.0 * anchor, rtol=1e-4, atol=1e-12)
    assert float(peak(each[1][sets[1]])) == 0.0


def test_momenta_stay_and_the_energy_does_not_grow():
    points, sets = blocks()
    longest = float(stable_limit(points, 0.5).min())
    joints = Joints(points, [PointJoint(*sets, AT.tolist(), turning=math.inf)], longest)
    solver = MPMSolver(0.5, gravity=ZERO)
    spin = double([0.5, -1.0, 2.0])
    state = solver.init_state(points, torch.linalg.cross(spin.expand_as(points.position), points.position) + 1.0)
    before, energy = solver.momenta(state), float(sum(solver.energies(state).values()))
    for _ in range(4):
        state = solver.rollout(state, 0.8 * longest, 100, joints)
        assert float(sum(solver.energies(state).values())) < 1.01 * energy
    after = solver.momenta(state)
    for name, value in before.items():
        near(after[name], value, 1e-6 * float(value.norm()))
    gap = Joints(points, [PointJoint(*sets, AT.tolist(), 1.0)], 1e-9)(state)[sets[0]].sum(0)
    assert gap.norm() < 0.02  # m


def test_what_is_no_joint_is_refused():
    points, sets = blocks()
    with value_error("stiffnesses of a joint not to be negative, but got -1 N/m"):
        Joints(points, [PointJoint(*sets, AT.tolist(), -1.0)], 1e-3)
    with value_error("A joint has no points"):
        Joints(points, [PointJoint(sets[0], sets[1][:0], AT.tolist())], 1e-3)


@pytest.mark.parametrize("turn", [[0.0, 1.4, 0.0], [1.2, 0.0, 0.0], [0.9, -0.8, 0.4]])
def test_a_joint_of_lines(turn):
    """Bars along z, one turned by up to 80 degrees: what a line can feel of the torque is across it as it lies now."""
    z = torch.arange(5).double() / 4
    place = torch.cat([torch.stack([0 * z + x, 0 * z, z], -1) for x in (0.0, 1.0)])
    points = solid(place, 0.01, attached=torch.arange(2).repeat_interleave(5))
    sets = [torch.arange(5), torch.arange(5, 10)]
    joints = Joints(points, [PointJoint(*sets, AT.tolist(), 30.0, 7.0)], 1e-6)
    state = moved(points, sets, [turn, [0.0] * 3], [[0.0] * 3] * 2)
    force = joints(state)
    near(force.sum(0), torch.zeros(3).double(), 1e-9)
    for own, sign in zip(sets, (-1.0, 1.0), strict=True):
        along = torch.nn.functional.normalize(state.position[own[-1]] - state.position[own[0]], dim=0)
        torque = sign * 7.0 * double(turn)
        felt = torch.linalg.cross(state.position[own] - AT, force[own]).sum(0)
        across = torque - (torque @ along) * along
        assert_close(felt, across, rtol=1e-6, atol=1e-6)  # a share of F decides the turn about it
