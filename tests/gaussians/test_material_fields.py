"""Materials that differ from Gaussian to Gaussian: their files, and what a simulation makes of them."""

import numpy as np
import pytest
import torch
from shared import user_warning, value_error
from torch.testing import assert_close

from gaussian_swaying import Box, Material, Scene, Simulation
from gaussian_swaying.gaussians.material_fields import MaterialFile
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.scenes.procedural import FlagScene

FLAG = FlagScene(spacing=0.04, ripple=0.0)
CLOUD = FLAG.generate()
COUNT = len(CLOUD.means)


def simulation(materials, *, parts=None, **given):
    scene = Scene(generator=FLAG, materials=materials, parts=parts, **given)
    pole = Box([None] * 3, [0.03, None, None])
    return Simulation(scene, hold=pole, wind=[4, 0, 1], material=Material(E=2e4, density=30.0), device="cpu")


@pytest.fixture
def file(tmp_path):
    """Writes materials, and returns their path."""

    def write(**arrays):
        np.savez(tmp_path / "materials.npz", **arrays)
        return str(tmp_path / "materials.npz")

    return write


def right(scene):
    return scene.frame.point_to_scene(scene.points.position.double())[:, 0] > 0.6


def after(made, frames=3):
    state = made.start()
    for _ in range(frames):
        state, _ = made.advance(state)
    return state


def test_the_same_everywhere_is_the_same_as_one_material(file):
    """To the bit: NaN keeps what the object has."""
    varied = simulation(file(E=np.full(COUNT, 3e4), nu=np.full(COUNT, np.nan), density=np.full(COUNT, 25.0)))
    plain = Simulation(
        Scene(generator=FLAG), hold=Box([None] * 3, [0.03, None, None]), wind=[4, 0, 1],
        material=Material(E=3e4, density=25.0), device="cpu",
    )  # fmt: skip
    assert torch.equal(after(varied).position, after(plain).position)


@pytest.mark.parametrize("points", ["gaussian", "grid"])
def test_each_point_has_the_mass_of_its_gaussians_and_their_mean_stiffness(file, points):
    E, density = (torch.logspace(*ends, COUNT, dtype=torch.float64) for ends in ((3, 7), (1, 2)))
    with user_warning("E up to .* make a frame take .* times the substeps that the median"):
        made = simulation(file(E=E.numpy(), density=density.numpy()), points=points).scene
    volume = made.model.areas().double() * 0.01
    assert_close(made.points.mass.double().sum(), (density * volume).sum(), rtol=1e-5, atol=0)
    owner = torch.empty_like(made.owner).index_copy(0, made.moving, made.owner)
    for name, value in (("youngs_modulus", E), ("mass", density)):
        wanted = torch.zeros(made.points.count, dtype=torch.float64).index_add(0, owner, volume * value)
        found = getattr(made.points, name).double()
        found = found if name == "mass" else found * made.points.volume
        if points == "gaussian":
            assert_close(found, wanted, rtol=1e-5, atol=0)
        else:  # the points of a group share its material
            assert_close(found.sum(), wanted.sum(), rtol=1e-5, atol=0)
            assert found.min() > 0.5 * (volume * value)[:10].mean()


def test_places_of_their_own_give_the_nearest(file):
    """The form of VoMP's file, here with 20,480 voxels, of which those on the right are stiffer."""
    line = torch.linspace(0, 1.2, 32), torch.linspace(-0.1, 0.1, 20), torch.linspace(0, 0.8, 32)
    places = torch.cartesian_prod(*line).numpy()
    kinds = [(name, "<f4") for name in ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density")]
    voxels = np.zeros(len(places), dtype=[*kinds, ("segment_id", "<U32")])
    for name, values in zip("xyz", places.T, strict=True):
        voxels[name] = values
    voxels["youngs_modulus"], voxels["poissons_ratio"] = np.where(places[:, 0] < 0.6, 1e4, 5e4), 0.2
    voxels["density"] = 40.0
    made = simulation(file(voxel_data=voxels)).scene
    points = made.points
    assert_close(points.youngs_modulus, torch.where(right(made), 5e4, 1e4))
    assert_close(points.poisson_ratio, torch.full_like(points.mass, 0.2))
    plain = simulation(file(places=places, E=voxels["youngs_modulus"], thickness=np.full(len(places), 0.02)))
    assert_close(plain.scene.points.youngs_modulus, points.youngs_modulus)
    assert_close(plain.scene.points.volume.sum(), 2 * points.volume.sum())


def test_what_is_too_stiff_becomes_softer_or_rigid(file):
    E = np.full(COUNT, 1e4)
    x, z = CLOUD.means[:, 0].numpy(), CLOUD.means[:, 2].numpy()
    blocks = [(abs(x - 0.4) < 0.1) & (abs(z - 0.4) < 0.1), (abs(x - 0.9) < 0.1) & (abs(z - 0.4) < 0.1)]
    E[blocks[0] | blocks[1]] = 5e9
    path = file(E=E)
    count = int((blocks[0] | blocks[1]).sum())
    with user_warning(f"E of {count} of {COUNT} materials .* is above `max_E` and becomes 20000 Pa: up to 2.5e\\+05"):
        soft = simulation(MaterialFile(path, max_E=2e4))
    assert float(soft.scene.points.youngs_modulus.amax()) == 2e4
    stiff = simulation(MaterialFile(path, rigid_E=1e9))
    assert len(stiff.solver.boundaries) == 3  # the pole, and two bodies
    assert float(stiff.scene.points.youngs_modulus.amax()) == 2e4
    rest, moved = CLOUD.means.double(), stiff.scene.deformed(after(stiff, 8)).means.double()
    assert (moved - rest).norm(dim=-1)[torch.from_numpy(blocks[1])].min() > 0.005
    centres = [(abs(x - at) < 0.06) & (abs(z - 0.4) < 0.06) for at in (0.4, 0.9)]  # all their nodes are of the body
    for mask in map(torch.from_numpy, centres):
        assert_close(torch.cdist(moved[mask], moved[mask]), torch.cdist(rest[mask], rest[mask]), rtol=0, atol=2e-4)
    between = [torch.from_numpy(mask).nonzero()[0, 0] for mask in centres]
    change = (moved[between[0]] - moved[between[1]]).norm() - (rest[between[0]] - rest[between[1]]).norm()
    assert abs(change) > 1e-3  # the flag between them stretches


def test_parts_win_over_it(file):
    parts = Parts([int(x > 0.6) for x in CLOUD.means[:, 0]], [Part("left"), Part("right", E=7e4)])
    made = simulation(file(E=np.full(COUNT, 1e4)), parts=parts).scene
    assert_close(made.points.youngs_modulus, torch.where(right(made), 7e4, 1e4))


GRADED = """
from gaussian_swaying.gaussians.material_fields import MaterialField, MaterialSource

class Graded(MaterialSource):
    def __init__(self, E: float) -> None:
        self.E = E

    def __call__(self, cloud):
        return MaterialField(cloud.means.double(), E=self.E * (1 + cloud.means[:, 0].double()))
"""


def test_a_source_of_ones_own_and_a_path_from_yaml(file, tmp_path, monkeypatch):
    (tmp_path / "own_materials.py").write_text(GRADED)
    monkeypatch.syspath_prepend(tmp_path)
    text = "scene:\n  generator: {{class_path: FlagScene, init_args: {{spacing: 0.04}}}}\n  materials: {}\ndevice: cpu"
    for given, wanted in (
        ("{class_path: own_materials.Graded, init_args: {E: 1.0e+4}}", 1e4 * 1.6),
        (file(E=np.full(COUNT, 3e4)), 3e4),
        (f"{{class_path: MaterialFile, init_args: {{path: {file(E=np.full(COUNT, 3e4))}, max_E: 9.0e+4}}}}", 3e4),
    ):
        (tmp_path / "scene.yaml").write_text(text.format(given))
        made = Simulation.from_yaml(tmp_path / "scene.yaml")
        assert float(made.scene.points.youngs_modulus.mean()) == pytest.approx(wanted, rel=0.01)
    (tmp_path / "scene.yaml").write_text(text.format("{class_path: own_materials.Typo}"))
    with value_error("an .npz file, or `class_path` and `init_args`"):
        Simulation.from_yaml(tmp_path / "scene.yaml")


@pytest.mark.parametrize("seed", range(6))
def test_any_field_over_eight_decades_runs(file, seed):
    rng = np.random.default_rng(seed)
    E = 10 ** rng.uniform(2, 10, COUNT)
    nu, density = rng.uniform(0.0, 0.45, COUNT), 10 ** rng.uniform(1, 4, COUNT)
    with user_warning("becomes 100000 Pa"):
        made = simulation(MaterialFile(file(E=E, nu=nu, density=density), max_E=1e5))
    state = after(made)
    assert torch.isfinite(state.position).all()
    assert (state.position - made.scene.points.position).norm(dim=-1).max() < 1


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"E": np.full(20_480, 1e4)}, "20,480 materials, but the splat has 600 Gaussians"),
        ({"E": np.full(COUNT, -1.0)}, "`E` of `scene.materials` to lie between 0 and inf, but 600 of 600"),
        ({"nu": np.full(COUNT, 0.5)}, "`nu` of `scene.materials` to lie between -1 and 0.5"),
        ({"E": np.ones(COUNT), "nu": np.ones(3) / 4}, "`nu` of `scene.materials` to have a number for each of 600"),
        ({"stiffness": np.ones(COUNT)}, "has none of the arrays E, nu, density"),
        ({"E": np.full(COUNT, "hard")}, "holds what is not numbers"),
        ({"voxel_data": np.ones(4)}, "has `voxel_data` without `density`"),
        ({"places": np.full((4, 3), np.nan), "E": np.ones(4)}, "one finite place"),
    ],
)
def test_a_bad_file_is_refused(file, arrays, message):
    with value_error(message):
        simulation(file(**arrays))


def test_a_number_that_a_field_gives_cannot_change_as_a_whole(file):
    made = simulation(file(E=np.full(COUNT, 3e4)))
    with value_error("`scene.materials` gives it"):
        made.change("material.E", 1e4)
    made.change("material.density", 20.0)
