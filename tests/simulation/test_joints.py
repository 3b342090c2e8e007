import dataclasses

import torch
from shared import ZERO, advanced, longest, value_error
from small_scenes import together

from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.model import Edit
from gaussian_swaying.simulation.simulation import Simulation

DX = 0.1


def flags():
    flag = FlagScene(spacing=0.04, width=0.6, height=0.2).generate()
    other = dataclasses.replace(flag, means=flag.means + torch.tensor([0.6, 0.0, 0.0]))
    return together(flag, other), torch.arange(2).repeat_interleave(len(flag.means))


def simulation(connected="surface", formulation="total", **joint):
    cloud, number = flags()
    parts = Parts(number, [Part("pole", "held"), Part("vane", attached="pole", **joint)])
    run = Simulation(
        Scene(generator=GivenScene(cloud), parts=parts, connected=connected, metres_per_unit=1.0, layers=3),
        Material(E=1e6, density=100.0, thickness=0.05),
        solver=MPMSolver(DX, gravity=ZERO, formulation=formulation),
        wind=[0.0, 6.0, 0.0],
        device="cpu",
    )
    return run, number


def end(run, frames=8):
    state, _ = advanced(run, frames)
    return run.scene.deformed(state).means - run.scene.rest().means


def test_modes_have_no_joints():
    with value_error(r"`solver\.formulation`"):
        simulation(formulation="modes", joint_turning=0.0)[0].start()
    run, _ = simulation(formulation="auto", joint_turning=0.0)
    run.start()
    assert (run.solver.formulation, run.solver.why) == ("total", "parts are joined")


def test_a_vane_turns_about_its_hinge_and_a_spring_holds_it():
    loose, number = simulation(joint_turning=0.0)
    moved = end(loose)
    rest = loose.scene.rest().means
    near = (rest[:, 0] - 0.62).abs() + (rest[:, 2] - 0.1).abs() < 0.05
    tip = rest[:, 0] > 1.15
    assert float(longest(moved[number == 0])) == 0.0
    assert longest(moved[near & (number == 1)]) < 0.15 * moved[tip, 1].mean()
    assert moved[tip, 1].mean() > 0.1
    stiff, _ = simulation(joint_turning=30.0)
    assert end(stiff)[tip, 1].mean() < 0.5 * moved[tip, 1].mean()
    joints = loose.stepper.joints[0]
    assert loose.stepper.joints[0] is joints
    loose.edit(loose.start(), Edit(E=1e5))
    assert float(loose.stepper.joints[0].stiffness) < 0.5 * float(joints.stiffness)  # substeps are longer


def test_a_batch_has_joints_as_soft_as_its_lightest_scene_needs():
    heavy, _ = simulation(joint_turning=1e9)
    light = heavy.variant({"material.density": 5.0})
    alone = light.stepper.joints[0]
    for members in ([heavy, light], [light, heavy]):
        joints = members[0].batch([member.model for member in members]).joints[0]
        for name in ("stiffness", "turning"):
            torch.testing.assert_close(getattr(joints, name), getattr(alone, name))


def test_a_joint_needs_parts_that_are_apart():
    with value_error(r"no effect with `scene.connected: grid`"):
        simulation(connected="grid", joint_turning=0.0)
    with value_error(r"part 'leaf' has a joint to nothing: name the other part as `attached`"):
        Part("leaf", joint_stiffness=3.0)
    with value_error(r"joint_turning of the part 'leaf'.* negative"):
        Part("leaf", attached="stem", joint_turning=-1.0)
    cloud, number = flags()
    parts = Parts(number, [Part("pole", "still"), Part("vane", attached="pole", joint_turning=0.0)])
    with value_error("The part 'pole' has no Gaussian that is simulated"):
        Simulation(Scene(generator=GivenScene(cloud), parts=parts, connected="surface"), device="cpu")
