"""``scene.parts``: what is held and still stays, what is soft has its own material, and nothing tears."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import beyond, in_both, peak, up_to, value_error

from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, MaterialRegion, Scene
from gaussian_swaying.simulation.simulation import Simulation

CLOUD = FlagScene(spacing=0.04).generate()
ROLES = [Part("wall", "still"), Part("pole", "held"), Part("cloth"), Part("hem", E=4e4, density=90.0, thickness=0.02)]


def labels():
    """Along the flag of 1.2 m: wall, pole, cloth, hem."""
    return torch.bucketize(CLOUD.means[:, 0].contiguous(), torch.tensor([0.15, 0.35, 0.9]))


def flag(parts=None, formulation="total", cloud=CLOUD, faint="carry", **settings):
    parts = Parts(labels(), ROLES) if parts is None else parts
    scene = Scene(generator=GivenScene(cloud), parts=parts, faint=faint)
    settings.setdefault("material", Material(E=5e3, density=30.0, thickness=0.01))
    solver = MPMSolver(0.1, formulation, gravity=[0, 0, -9.8])
    return Simulation(scene, solver=solver, wind=[2.0, 3.0, 0.0], device="cpu", **settings)


@in_both
def test_what_is_still_and_held_stays_and_the_rest_bends_there(formulation):
    simulation = flag(formulation=formulation)
    for frame in simulation.frames(9):
        last = frame
    moved = (last.gaussians.means - CLOUD.means).norm(dim=-1)
    label = labels()
    assert float(moved[label <= 1].max()) == 0.0
    assert moved[label == 2].max() > 0.05
    assert moved[label == 3].min() > 0.05
    # neighbours of the pole bend instead of tearing off: no step from one column to the next
    column = torch.unique((CLOUD.means[:, 0] / 0.02).round(), return_inverse=True)[1]
    size = torch.stack([moved[column == k].amax() for k in range(int(column.max()) + 1)])
    assert peak(size.diff()) < 1.5 * 0.04  # columns are 0.04 apart, and the flag falls by its weight
    assert moved[(label == 2) & (CLOUD.means[:, 0] > 0.5)].min() > 0.0  # what bends is next to it


def test_parts_have_damping_ratios_of_their_own():
    """A ratio at 1 Hz, as a rate of 4 pi times it."""
    roles = [*ROLES[:3], dataclasses.replace(ROLES[3], damping_ratio=0.3)]
    material = Material(E=5e3, density=30.0, thickness=0.01, damping_ratio=0.06)
    points = flag(Parts(labels(), roles), material=material).scene.points
    rates = points.damping.unique()
    assert rates.tolist() == pytest.approx([4 * math.pi * 0.06, 4 * math.pi * 0.3])
    hem = points.position[:, 0] > 0.95
    assert (points.damping[hem] == rates[1]).all()
    assert flag().scene.points.damping is None
    with value_error(r"`material.damping_ratio` sets, needs `solver.formulation: total`"):
        flag(material=material, formulation="updated").start()
    with value_error(r"`material\.damping_ratio` to"):
        Material(damping_ratio=-0.1)


def test_a_part_has_its_own_material_and_regions_win():
    points = flag().scene.points
    place = flag().scene.frame.point_to_scene(points.position)[:, 0]
    x, label = CLOUD.means[:, 0], labels()
    hem = place > 0.5 * (float(x[label == 2].max()) + float(x[label == 3].min()))
    assert torch.equal(points.youngs_modulus, torch.where(hem, 4e4, 5e3))
    assert torch.allclose(points.mass / points.volume, torch.where(hem, 90.0, 30.0))
    assert float(points.volume[hem].mean()) == pytest.approx(2 * float(points.volume[~hem].mean()), rel=0.1)
    end = MaterialRegion(beyond(x=1.0), E=7e4)
    points = flag(material=Material(E=5e3, density=30.0, regions=[end])).scene.points
    assert set(points.youngs_modulus.tolist()) == {5e3, 4e4, 7e4}


def test_one_soft_part_is_the_object_without_parts():
    parts = Parts(torch.zeros(len(CLOUD.means)), [Part("all")])
    hold = up_to(x=0.1)
    one, other = (
        Simulation(Scene(generator=GivenScene(CLOUD), parts=p), hold=hold, wind=[2.0, 3, 0], device="cpu")
        for p in (parts, None)
    )
    assert torch.equal(list(one.frames(4))[-1].gaussians.means, list(other.frames(4))[-1].gaussians.means)


def test_faint_gaussians_of_a_held_part_and_those_that_follow_it_stay():
    cloud = FlagScene(spacing=0.04).generate()
    cloud.opacities[::5] = -6.0
    last = list(flag(cloud=cloud).frames(6))[-1]
    moved = (last.gaussians.means - cloud.means).norm(dim=-1)
    assert float(moved[labels() <= 1].max()) == 0.0
    assert moved[labels() == 3].min() > 0.0
    dropped = flag(cloud=cloud, faint="drop").scene.model.means
    assert len(dropped) == len(cloud.means) - int(((cloud.opacities < -5) & (labels() > 0)).sum())


def test_hidden_parts_are_taken_away():
    hidden = Parts(labels(), [ROLES[0], ROLES[1], Part("cloth"), Part("hem", "hidden")])
    rest = labels() < 3
    alone = CLOUD.select(rest)
    found, expected = (
        list(flag(parts, cloud=cloud).frames(3))[-1]
        for parts, cloud in ((hidden, CLOUD), (Parts(labels()[rest], ROLES[:3]), alone))
    )
    assert torch.equal(found.gaussians.means, expected.gaussians.means)
    assert torch.equal(found.render().color, expected.render().color)
    with value_error("that are still, held or hidden"):
        flag(Parts(labels(), [Part("a", "hidden"), Part("b", "still"), Part("c", "held"), Part("d", "hidden")]))


def test_parts_of_another_splat_are_refused():
    with value_error("labels of 3 Gaussians, but the splat has 600"):
        flag(Parts([0, 0, 0], [Part("all")]))


def test_a_yaml_names_the_file_and_a_changed_one_is_not_resumed(tmp_path):
    path = Parts(labels(), ROLES).save(tmp_path / "parts.npz")
    config = tmp_path / "flag.yaml"
    config.write_text(
        f"""\
frames: 4
scene: {{generator: {{class_path: FlagScene, init_args: {{spacing: 0.04}}}}, parts: {path}}}
solver: {{dx: 0.1}}
wind: {{flow: [2.0, 3.0, 0.0]}}
device: cpu
recorder: {{renders: []}}
"""
    )
    run = tmp_path / "run"
    simulation = Simulation.from_yaml(config)
    assert simulation.scene.parts.parts == tuple(ROLES)
    simulation.run(run, frames=2, progress=False)
    Parts(labels().flip(0), ROLES).save(path)
    with value_error(r"parts of the scene .* have changed"):
        Simulation.from_yaml(config).run(run, frames=4, resume=True, progress=False)


def test_the_examples_of_the_page_run(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/parts.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    joints, first = {}, {}
    for names, block in zip((joints, first), page.split("```python\n")[1:], strict=True):
        exec(compile(block.split("```")[0], "parts.md", "exec"), names)
    assert all(joints[name].has_joint for name in ("leaf", "vane", "lamp"))
    assert len(list(first["simulation"].frames(2))) == 2
    described = page.split("## The file")[1].split("```")[0]
    rows = re.findall(r"^\| (`.*?) \|", described, re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == set(np.load(tmp_path / "parts.npz"))


def test_a_number_that_parts_give_is_not_changed_for_all():
    simulation = flag()
    with value_error(r"`material\.regions`, `scene\.parts` or `scene\.materials` gives it too"):
        simulation.change("material.E", 1e5)
    simulation.change("material.nu", 0.2)
    assert simulation.material.nu == 0.2
