"""The reference of the flag benchmark: what is asked of Blender, its files, cameras and resuming.

Nothing here needs Blender, apart from the last tests, which are skipped without it.
"""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.rendering.cameras.camera_path import TransformsCamera

from .conftest import beside

TOOL = "make_flag_dataset"
reference = beside("flag_reference")
flag_pictures = beside("flag_pictures")
flag_motion = beside("flag_motion")
flag_difference = beside("flag_difference")
cloth = beside("blender_cloth")


# ---- physics


def _spring_lengths(grid):
    """Lengths [m] of the springs along the sides of the faces and along one diagonal of each."""
    faces, flat = grid.faces(), grid.flat()
    sides = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    ends = flat[np.concatenate([np.unique(np.sort(sides, 1), axis=0), faces[:, [0, 2]]])]
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1)


def _vertex_areas(grid):
    """A quarter of each face [m²] for each of its vertices, shape (columns + 1, rows + 1)."""
    corners = grid.flat()[grid.faces()]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]), axis=-1)
    assert area.sum() == pytest.approx(grid.width * grid.height)
    share = np.bincount(grid.faces().reshape(-1), np.repeat(area / 4, 4))
    return share.reshape(grid.columns + 1, grid.rows + 1)


def test_every_vertex_stands_for_the_same_share_of_the_cloth(cloth):
    """The area that a vertex has by its faces is, with the vertex beside it, that of two cells of one size."""
    grid = cloth.Grid.of_cells(1.2, 0.8, 12)
    assert (grid.columns, grid.rows, grid.count) == (11, 7, 96)
    assert grid.cell**2 * grid.count == pytest.approx(1.2 * 0.8)
    share = _vertex_areas(grid) / grid.cell**2
    np.testing.assert_allclose(share[2:-2, 2:-2], 1)
    np.testing.assert_allclose(share[0, 2:-2], 0.75)
    for rim in (share[:2], share[-2:], share[:, :2].T, share[:, -2:].T):
        np.testing.assert_allclose(rim[:, 2:-2].sum(0), 2)
        np.testing.assert_allclose(rim[:, :2].sum(), 4)
    assert grid.spring == pytest.approx(_spring_lengths(grid).mean())


def test_squares_are_cut_by_turns(cloth):
    """Each vertex has the same neighbours on opposite sides: all eight, or the four beside it."""
    grid = cloth.Grid.of_cells(1.2, 0.8, 12)
    flat, triangles, faces = grid.flat(), grid.triangles(), grid.faces()
    corners = flat[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 1] < 0).all()
    assert 0.5 * np.linalg.norm(normal, axis=-1).sum() == pytest.approx(1.2 * 0.8)
    owner = [set(face) for face in faces.tolist()]
    for triangle, square in zip(triangles.tolist(), owner + owner, strict=True):
        assert set(triangle) < square
    touched = np.bincount(triangles.reshape(-1), minlength=grid.count).reshape(grid.columns + 1, grid.rows + 1)
    parity = np.indices(touched.shape).sum(0)[1:-1, 1:-1] % 2
    np.testing.assert_array_equal(touched[1:-1, 1:-1], np.where(parity == 0, 8, 4))


@pytest.mark.parametrize("held", ["left", "top"])
def test_an_edge_that_is_held_carries_half_a_cell(cloth, held):
    """Its vertices do not move, so their mass is none; the vertices beside it stand for one cell each."""
    grid = cloth.Grid.of_cells(1.2, 0.8, 12, held)
    share = _vertex_areas(grid) / grid.cell**2
    edge = share if held == "left" else share.T[::-1]
    np.testing.assert_allclose(edge[0, 2:-2], 0.5)
    np.testing.assert_allclose(edge[1:-2, 2:-2], 1)
    np.testing.assert_allclose(edge[-2:, 2:-2].sum(0), 2)
    # as heavy as the cloth, apart from the half cell that is held
    assert grid.cell**2 * (grid.count - len(edge[0])) == pytest.approx(0.96 - 0.5 * grid.cell**2 * len(edge[0]))


def test_two_sides_that_are_held_carry_half_a_cell_each(cloth):
    grid = cloth.Grid.of_cells(1.2, 0.8, 12, "sides")
    share = _vertex_areas(grid) / grid.cell**2
    np.testing.assert_allclose(share[[0, -1], 2:-2], 0.5)
    np.testing.assert_allclose(share[1:-1, 2:-2], 1)
    assert grid.cell**2 * grid.count == pytest.approx(0.96 + grid.cell**2 * len(share[0]))


def test_patterns_have_the_parameters_of_the_paper(reference):
    """Young's modulus, density and flow of the table; mass, pressure and bending follow from them."""
    expected = {1: (5e3, 50.0, (0, 0, 0)), 2: (3e3, 30.0, (2.5, 0.5, 0)), 3: (3e3, 20.0, (2, 0, 0))}
    for number, (modulus, density, flow) in expected.items():
        pattern = reference.PATTERNS[number]
        assert (pattern.youngs_modulus, pattern.density, pattern.flow) == (modulus, density, flow)
        assert (pattern.poisson_ratio, pattern.gravity, pattern.frames, pattern.fps) == (0.3, 9.8, 250, 25)
        material = pattern.material()
        assert material.areal_density == pytest.approx(density * pattern.thickness)
        assert material.membrane == pytest.approx(modulus * pattern.thickness)
        assert material.bending == pytest.approx(modulus * pattern.thickness**3 / 12 / 0.91)
        speed = math.hypot(*flow)
        assert pattern.pressure() == pytest.approx(0.5 * 1.225 * {1: 1.28, 2: 0.8, 3: 1.28}[number] * speed**2)
        assert pattern.damping == material.air_rate == (2.0 if number == 1 else 1.0)


def test_two_flags_leave_their_held_edge_at_an_angle(reference):
    """A curtain and a light stiff flag, hung by their top edge in a wind at 60 degrees to their plane."""
    expected = {4: ((1.0, 1.4), 1.8, 0.2, 30.0), 5: ((1.2, 0.8), 3.0, 0.15, 80.0)}  # sides, speed, kg/m², E h
    assert set(reference.PATTERNS) - set(reference.PAPER) == set(expected)
    for number, (sides, speed, areal, membrane) in expected.items():
        pattern = reference.PATTERNS[number]
        assert (pattern.width, pattern.height) == sides
        assert math.hypot(*pattern.flow) == pytest.approx(speed)
        assert pattern.normal() @ pattern.flow == pytest.approx(-speed * math.sin(math.radians(60)))
        assert pattern.material().areal_density == pytest.approx(areal)
        assert pattern.material().membrane == pytest.approx(membrane)
        assert pattern.pressure() == pytest.approx(0.5 * 1.225 * 1.28 * speed**2)
        held = pattern.grid().uv()[pattern.pins(pattern.grid().uv())]
        assert len(held) == pattern.grid().columns + 1
        np.testing.assert_array_equal(held[:, 1], 1)
        # at rest the wind would hold a flat sheet at atan(p sin 60 / weight) from the vertical
        tilt = math.atan(pattern.pressure() * math.sin(math.radians(60)) / (areal * 9.8))
        assert math.radians(45) < tilt < math.radians(80)


def test_blender_is_asked_in_its_own_units(reference, cloth):
    """The relations, turned round: whatever the mesh, the same mass, springs, damping, bending and wind in SI units."""
    for cells in (30, 60, 120):
        pattern = replace(reference.PATTERNS[2], cells=cells, quality=512, damping=0.7)
        grid, material, run = pattern.grid(), pattern.material(), pattern.run()
        asked = cloth.blender_settings(grid, material, run)
        assert asked["gravity"] == pytest.approx(-15.68)
        assert asked["mass"] * grid.count == pytest.approx(0.3 * 1.2 * 0.8)
        spring = asked["tension_stiffness"] * 625 / grid.cell
        lengths = _spring_lengths(grid)
        assert spring * grid.cell / lengths.mean() * 4 / 3 == pytest.approx(30.0)  # Blender divides by the mean length
        assert asked["tension_damping"] * 25 / (30.0 * 3 / 4) == pytest.approx(2.2e-3)
        assert asked["bending_stiffness"] * cloth.BENDING * grid.cell**2 * 625 == pytest.approx(material.bending)
        assert 0.02 * 25 * asked["strength"] == pytest.approx(pattern.pressure())
        assert asked["strength"] / asked["flow"] == pytest.approx(math.hypot(2.5, 0.5))
        assert 0.01 * 25 * asked["air_damping"] / asked["mass"] == pytest.approx(0.7)
    still = reference.PATTERNS[1]
    asked = cloth.blender_settings(still.grid(), still.material(), still.run())
    assert asked["strength"] == asked["flow"] == 0.0


def test_steps_follow_the_mesh(reference, cloth):
    """Blender's bending is explicit: its number grows with 1 / cell^4 and falls with the square of the steps."""
    for number in reference.PATTERNS:
        pattern = reference.PATTERNS[number]
        assert reference.least_quality(pattern) == pattern.quality
        finer = replace(pattern, cells=2 * pattern.cells)
        of = [cloth.bending_number(p.grid(), p.material(), p.run()) for p in (pattern, finer)]
        assert of[0] < cloth.BENDING_LIMIT
        assert of[1] / of[0] == pytest.approx(16, rel=0.05)
        assert reference.least_quality(finer) == 4 * pattern.quality
    pattern = reference.PATTERNS[3]
    grid, rough = pattern.grid(), replace(pattern, quality=8).run()
    with pytest.raises(ValueError, match="`quality` of at least 38"):
        cloth.solve_cloth(grid, grid.flat(), [], pattern.material(), rough)


def test_pins_hold_the_same_part_of_the_flag_on_every_mesh(reference):
    """An edge is a line of vertices, a corner a square of 4 cm; the lower left corner is free in pattern 2."""
    for cells, side in ((60, 2), (120, 4)):
        left, corners, top = (replace(reference.PATTERNS[n], cells=cells) for n in (1, 2, 3))
        for pattern, count in ((left, left.grid().rows + 1), (top, top.grid().columns + 1), (corners, 3 * side**2)):
            uv = pattern.grid().uv()
            pins = pattern.pins(uv)
            assert len(pins) == count
            assert len(pins) == len(set(pins.tolist()))
        held = corners.grid().uv()[corners.pins(corners.grid().uv())]
        assert not ((held[:, 0] < 0.5) & (held[:, 1] < 0.5)).any()
        for u, v in ((0, 1), (1, 1), (1, 0)):
            assert (held == [u, v]).all(1).any()
    np.testing.assert_array_equal(left.grid().uv()[left.pins(left.grid().uv())][:, 0], 0)
    np.testing.assert_array_equal(top.grid().uv()[top.pins(top.grid().uv())][:, 1], 1)


def test_rest_shape_has_its_true_normals_on_the_side_of_the_camera(reference):
    for number in (1, 2, 3):
        pattern = replace(reference.PATTERNS[number], ripple=0.01)
        truth = pattern.truth()
        corners = truth["vertices"][truth["faces"]]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(facing, axis=-1)
        assert area.sum() == pytest.approx(pattern.width * pattern.height, rel=0.02)
        facing /= 2 * area[:, None]
        # the normal turns by ripple (3 pi / width)^2 cell within a square
        turn = 0.01 * (3 * math.pi / pattern.width) ** 2 * pattern.grid().cell
        assert np.abs(facing - truth["normals"][truth["faces"][:, 0]]).max() < turn
        assert (facing @ pattern.normal()).min() > 0.9
    assert reference.PATTERNS[3].normal() @ [2, 0, 0] == pytest.approx(-2 * math.sin(math.radians(35)))


@pytest.mark.parametrize(
    ("field", "value"),
    [("quality", 20), ("cells", 1), ("frames", 1), ("thickness", 0.0), ("pinned", "right"), ("drag", -1.0)],
)
def test_bad_patterns_name_the_field(reference, field, value):
    with pytest.raises(ValueError, match=f"`{field}`"):
        replace(reference.PATTERNS[1], **{field: value})


def test_cells_must_be_squares(reference):
    with pytest.raises(ValueError, match="`cells`"):
        replace(reference.PATTERNS[1], height=0.05, cells=30).grid()


# ---- files


def _motion(flag_motion, pattern, shape):
    """A motion of which ``shape`` gives the points (V, 3) of a frame, as it would be read."""
    grid = pattern.grid()
    rest = pattern.rest(grid.uv())[0]
    positions = np.stack([shape(rest, frame) for frame in range(pattern.frames)]).astype(np.float32)
    settings = json.loads(json.dumps(pattern.cloth_settings()))
    return flag_motion.Cloth(positions, grid.faces(), grid.uv(), grid.columns, grid.rows, settings)


def _fake_solver(monkeypatch, flag_motion, calls):
    def solve(grid, vertices, pins, material, run, report=None):
        calls.append(run.quality)
        drift = np.linspace(0, 0.5, run.frames, dtype=np.float32)
        return vertices.astype(np.float32) + drift[:, None, None] * np.float32([0, 1, 0])

    monkeypatch.setattr(flag_motion, "solve_cloth", solve)


def test_motion_is_solved_once_and_says_what_changed(reference, flag_motion, monkeypatch, tmp_path):
    calls = []
    _fake_solver(monkeypatch, flag_motion, calls)
    pattern, path = replace(reference.PATTERNS[2], cells=30, quality=8, frames=4), tmp_path / "flag/cloth.npz"
    assert flag_motion.solve_pattern(pattern, path)
    assert not flag_motion.solve_pattern(pattern, path)
    assert calls == [8]
    assert [item.name for item in path.parent.iterdir()] == ["cloth.npz"]  # nothing half-written stays
    motion = flag_motion.read_cloth(path)
    assert motion.positions.shape == (4, 30 * 20, 3)
    with np.load(path) as data:
        assert data["areal_density"] == pytest.approx(0.3)
        assert data["membrane_stiffness"] == pytest.approx(30)
        assert data["damping"] == 1
        np.testing.assert_allclose(data["gravity"], [0, 0, -9.8])
        np.testing.assert_allclose(data["flow"], [2.5, 0.5, 0])
        assert set(json.loads(str(data["units"]))) <= set(data.files)
        assert str(data["hash"]) == flag_motion.settings_hash(motion.settings)
        np.testing.assert_array_equal(data["pins"], pattern.pins(motion.uv))
    changed = replace(pattern, quality=16, drag=1.0)
    with pytest.raises(ValueError, match=r"`drag` was 0.8 and is now 1.0; `quality` was 8 and is now 16"):
        flag_motion.solve_pattern(changed, path)
    assert calls == [8]


def test_what_is_no_motion_is_an_error(flag_motion, tmp_path):
    np.savez(tmp_path / "other.npz", x=1)
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(ValueError, match="make the motion of a flag again"):
            flag_motion.read_cloth(tmp_path / name)


def test_hash_does_not_depend_on_order(flag_motion):
    assert flag_motion.settings_hash({"a": 1, "b": 2}) == flag_motion.settings_hash({"b": 2, "a": 1})
    assert flag_motion.settings_hash({"a": 1}) != flag_motion.settings_hash({"a": 2})


# ---- comparing solutions


def test_sampling_is_exact_on_every_mesh(reference, flag_difference, flag_motion):
    """Bilinear functions of the place on the flag are reproduced, so two meshes of one surface are 0 apart."""
    pattern = replace(reference.PATTERNS[2], frames=2)

    def bent(rest, frame):
        x, _, z = rest.T
        return np.stack([x, frame * x * z, z + 0.1 * frame * x], -1)

    coarse, fine = (_motion(flag_motion, replace(pattern, cells=cells), bent) for cells in (6, 30))
    uv = flag_difference.even_uv(pattern, along=12)
    assert len(uv) == 12 * 8
    x, z = uv.T * np.array([[1.2], [0.8]])
    # a bilinear function is linear along each side of a square: exact on both, to float32
    np.testing.assert_allclose(coarse.sample(uv)[1], np.stack([x, x * z, z + 0.1 * x], -1), atol=1e-6)
    found = flag_difference.difference(pattern, coarse, fine, along=12)
    assert found["chamfer"] < 1e-6
    assert found["corresponding"] < 1e-6


def test_motions_on_two_meshes_lead_to_what_they_converge_to(reference, flag_motion, tmp_path):
    """Errors that fall as the square of a cell are gone; all else is that of the finer motion."""
    pattern = replace(reference.PATTERNS[2], frames=2)
    for cells in (15, 20):
        motion = _motion(
            flag_motion, replace(pattern, cells=cells), lambda rest, frame, n=cells: rest * (1 + 3 * frame / n**2)
        )
        arrays = vars(motion) | {"settings": json.dumps(motion.settings | {"cells": cells}), "hash": str(cells)}
        np.savez(tmp_path / f"{cells}.npz", **arrays)
    flag_motion.extrapolate(tmp_path / "20.npz", tmp_path / "15.npz", tmp_path / "found.npz")
    fine, found = (flag_motion.read_cloth(tmp_path / name) for name in ("20.npz", "found.npz"))
    assert np.abs(fine.positions[1] - fine.positions[0]).max() > 0.005
    np.testing.assert_allclose(found.positions[1], found.positions[0], atol=1e-6)
    assert found.settings == fine.settings


def test_chamfer_distance_of_shifted_lattices(flag_difference):
    """Across the sheet by d it is d; along it by less than half the spacing too; order does not matter."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0), [0.0], indexing="ij"), -1).reshape(-1, 3)
    for shift in ([0, 0, 0.7], [0.3, 0, 0]):
        moved = (grid + shift)[::-1]
        assert flag_difference.chamfer_distance(grid, moved) == pytest.approx(np.linalg.norm(shift))
    # one point against two: mean of 1 and (1 + 3) / 2
    one, two = np.zeros((1, 3)), np.array([[1.0, 0, 0], [0, 3.0, 0]])
    assert flag_difference.chamfer_distance(one, two) == pytest.approx(1.5)


def test_difference_is_a_share_of_the_longer_side(reference, flag_difference, flag_motion):
    pattern = replace(reference.PATTERNS[3], cells=20, frames=3)
    still = _motion(flag_motion, pattern, lambda rest, frame: rest)
    moving = _motion(flag_motion, pattern, lambda rest, frame: rest + frame * 0.01 * pattern.normal())
    found = flag_difference.difference(pattern, still, moving, along=20)
    np.testing.assert_allclose(found["chamfer_per_frame"], [0, 0.005, 0.01], atol=1e-6)  # over 2 m
    assert found["chamfer"] == pytest.approx(0.005, abs=1e-6)
    assert found["corresponding"] == pytest.approx(0.005, abs=1e-6)
    with pytest.raises(ValueError, match="as many frames"):
        flag_difference.difference(pattern, still, replace(moving, positions=moving.positions[:2]))


def test_uncertainty_is_written_for_each_variant(tool, reference, flag_difference, flag_motion, monkeypatch, tmp_path):
    calls = []
    _fake_solver(monkeypatch, flag_motion, calls)
    pattern = replace(reference.PATTERNS[1], cells=30, quality=8, frames=3)
    lines = []
    tool.make_uncertainty(pattern, tmp_path, list(flag_difference.VARIANTS), lines.append, every=1, along=20)
    written = json.loads((tmp_path / "uncertainty.json").read_text())
    assert {name: (row["cells"], row["quality"]) for name, row in written["variants"].items()} == {
        "steps doubled": (30, 16),
        "coarser": (22, 8),
        "finer": (37, 8),
        "half the cells": (15, 8),
        "hardly bending": (15, 8),
        "self-contact": (15, 8),
    }
    # the fake moves them alike; what is left is the ripple between the vertices of a coarser mesh, a (k face)^2 / 8
    bound = 0.003 * (1.5 * 3 * math.pi / 15) ** 2 / 8 / 1.2
    assert all(row["chamfer"] <= 1.5 * bound for row in written["variants"].values())
    assert written["variants"]["steps doubled"]["chamfer"] == 0
    assert calls == [8, 16, 8, 8, 8, 8, 8]
    tool.make_uncertainty(pattern, tmp_path, ["coarser"], lines.append, along=20)
    assert len(calls) == 7


def test_bending_is_that_of_a_plate_unless_given(reference, flag_difference):
    pattern = reference.PATTERNS[3]
    assert pattern.material().bending == pytest.approx(3e3 * 0.01**3 / 12 / (1 - 0.3**2))
    slack = flag_difference.variants(pattern, ["hardly bending"])["hardly bending"]
    assert slack.material().bending == pytest.approx(0.02 * pattern.material().bending)
    apart = flag_difference.variants(pattern, ["self-contact"])["self-contact"]
    assert apart.run().self_collision
    assert not pattern.run().self_collision
    assert pattern.cloth_settings()["bending"] == 1.0
    assert slack.cloth_settings()["bending"] == 0.02


def test_self_contact_keeps_the_distance_that_is_asked_for(reference, cloth):
    """Blender's own setting is less by what it adds; a mesh so coarse that flat cloth touches itself is refused."""
    pattern = replace(reference.PATTERNS[1], cells=80, self_collision=True, self_distance=0.005)
    found = cloth.blender_settings(pattern.grid(), pattern.material(), pattern.run())
    assert found["self_distance_min"] == pytest.approx(0.005 / cloth.SELF_DISTANCE)
    assert found["self_friction"] == 0.0
    half = replace(pattern, self_distance=None)
    assert half.cloth_settings()["blender.self_distance_min"] == pytest.approx(0.5 * half.grid().cell * 9 / 16)
    apart = replace(pattern, self_collision=False, self_distance=None)
    assert not any("self" in name for name in cloth.blender_settings(apart.grid(), apart.material(), apart.run()))
    with pytest.raises(ValueError, match=r"`self_distance` of at most 0\.00[0-9]+ m on cells of 0\.0[0-9]+ m"):
        replace(pattern, self_distance=0.01).cloth_settings()
    with pytest.raises(ValueError, match="`self_distance` to be positive"):
        replace(pattern, self_distance=0.0)


def test_another_solver_is_named_in_the_settings(tool, reference, flag_motion, monkeypatch, tmp_path):
    pattern = replace(reference.PATTERNS[1], cells=12, quality=8, frames=2)
    fake = lambda grid, vertices, pins, material, run, report: np.stack([vertices, vertices]).astype(np.float32)  # noqa: E731
    monkeypatch.setattr(sys.modules["newton_cloth"], "solve_cloth", fake)
    path = tmp_path / "cloth.npz"
    assert flag_motion.solve_pattern(pattern, path, None, "newton")
    assert flag_motion.read_cloth(path).settings["solver"] == "newton"
    assert not flag_motion.solve_pattern(pattern, path, None, "newton")
    with pytest.raises(ValueError, match="`solver` was 'newton' and is now None"):
        flag_motion.solve_pattern(pattern, path)


def test_newton_has_no_wind(tool, reference):
    pattern = replace(reference.PATTERNS[2], cells=30)
    grid = pattern.grid()
    with pytest.raises(ValueError, match="no wind that could be matched"):
        sys.modules["newton_cloth"].solve_cloth(grid, grid.flat(), [], pattern.material(), pattern.run())


@pytest.mark.slow(twin="test_another_solver_is_named_in_the_settings")
def test_newtons_cloth_falls_as_it_should(tool, cloth):
    """A free panel falls with the damping that is asked for; without gravity it stays, also with self-contact."""
    pytest.importorskip("newton")
    newton = sys.modules["newton_cloth"]
    grid = cloth.Grid.of_cells(0.2, 0.2, 8)
    material = cloth.ClothMaterial(0.3, 30.0, 2.75e-4, air_rate=2.0)
    run = cloth.ClothRun(frames=6, quality=8)
    height = newton.solve_cloth(grid, grid.flat(), [], material, run)[..., 2].astype(np.float64).mean(1)
    times = np.arange(6) / 25
    fallen = 9.8 / 2 * (times - (1 - np.exp(-2 * times)) / 2)
    np.testing.assert_allclose(height[0] - height[1:], fallen[1:], rtol=0.04)
    still = newton.solve_cloth(grid, grid.flat(), [], material, replace(run, gravity=0.0, self_collision=True))
    np.testing.assert_allclose(still[-1], still[0], atol=1e-6)


# ---- cameras


def _seen(fields_path, frame, points):
    """Pixels at which a camera of this package sees points."""
    camera = TransformsCamera(fields_path, frame)(0, 0.0, torch.zeros(3, dtype=torch.float64), torch.zeros(3), 1.0)
    local = points @ camera.world_to_camera[:3, :3].T.numpy() + camera.world_to_camera[:3, 3].numpy()
    image = local @ camera.intrinsics.numpy().T
    return image[:, :2] / image[:, 2:], local[:, 2]


def test_training_views_hold_the_whole_flag_and_are_ours_too(reference, flag_pictures, tmp_path):
    """All corners are in every image, at the pixels that the camera in transforms.json gives."""
    pattern = reference.PATTERNS[3]
    views = flag_pictures.sphere_views(pattern, 40, 100)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(flag_pictures.transforms_fields(views, [f"{i}.png" for i in range(40)])))
    corners = pattern.rest(np.array([[0.0, 0], [0, 1], [1, 0], [1, 1]]))[0]
    rays = []
    for index, view in enumerate(views):
        pixels, depth = _seen(path, index, corners)
        np.testing.assert_allclose(pixels, view.project(corners), atol=1e-3)  # the package reads in float32
        assert (depth > 0).all()
        assert pixels.min() > 0
        assert pixels.max() < 100
        rays.append(view.pose[:3, 3] - pattern.center())
        np.testing.assert_allclose(view.pose[:3, :3] @ view.pose[:3, :3].T, np.eye(3), atol=1e-12)
    rays = np.array(rays) / np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.abs(rays.mean(0)).max() < 0.02  # even over the sphere
    assert np.linalg.eigvalsh(rays.T @ rays / 40) == pytest.approx([1 / 3] * 3, abs=0.03)


def test_reference_camera_looks_along_the_normal_and_holds_the_motion(reference, flag_pictures, flag_motion, tmp_path):
    pattern = replace(reference.PATTERNS[3], cells=20, frames=5)
    motion = _motion(flag_motion, pattern, lambda rest, t: rest + t * np.array([0.3, -0.2, -0.4]))
    view = flag_pictures.reference_view(pattern, motion.positions, 320, 180)
    np.testing.assert_allclose(view.pose[:3, 2], pattern.normal(), atol=1e-12)
    (tmp_path / "camera.json").write_text(json.dumps(flag_pictures.transforms_fields([view], ["x.png"])))
    pixels, depth = _seen(tmp_path / "camera.json", 0, motion.positions.reshape(-1, 3).astype(np.float64))
    assert (depth > 0).all()
    margin = np.minimum(pixels.min(0), [320, 180] - pixels.max(0))
    assert margin.min() > 0
    assert margin.min() < 0.1 * 180  # and no further away than it needs to be


def test_frames_come_every_tenth_first(flag_pictures):
    order = flag_pictures.frame_order(25)
    assert order[:5] == [0, 10, 20, 1, 2]
    assert sorted(order) == list(range(25))


def test_textures_are_the_same_every_time_and_the_right_way_up(reference, flag_pictures, tmp_path):
    flag = reference.PATTERNS[2]
    drawn = flag_pictures.draw_texture(flag, width=60)
    assert drawn.shape == (40, 60, 3)
    np.testing.assert_allclose(drawn[0, 0], [0.83, 0.30, 0.18], atol=1e-6)  # the upper band
    np.testing.assert_allclose(drawn[20, 30], [0.93, 0.68, 0.20], atol=1e-6)  # the disc
    np.testing.assert_array_equal(drawn, flag_pictures.draw_texture(flag, width=60))
    assert np.ptp(flag_pictures.draw_texture(reference.PATTERNS[1])) == 0
    from imageio.v3 import imwrite

    imwrite(tmp_path / "own.png", np.full((3, 5, 3), 51, dtype=np.uint8))
    own = flag_pictures.draw_texture(replace(flag, texture=str(tmp_path / "own.png")))
    np.testing.assert_allclose(own, 0.2, atol=1e-6)
    with pytest.raises(ValueError, match="Cannot read the texture"):
        flag_pictures.draw_texture(replace(flag, texture=str(tmp_path / "none.png")))


# ---- pictures and resuming


class _FakeStudio:
    """Writes a small picture for each photograph, and can be cut off."""

    left = 1000

    def __init__(self, *given, **named):
        pass

    def move(self, vertices):
        pass

    def photograph(self, view, path):
        from imageio.v3 import imwrite

        if _FakeStudio.left == 0:
            raise KeyboardInterrupt
        _FakeStudio.left -= 1
        imwrite(path, np.zeros((view.height, view.width, 4), dtype=np.uint8))


@pytest.fixture
def small(tool, reference, flag_motion, monkeypatch, tmp_path):
    """Everything at its smallest, without Blender: pattern, folder and pictures."""
    _fake_solver(monkeypatch, flag_motion, [])
    monkeypatch.setattr(tool, "Studio", _FakeStudio)
    monkeypatch.setattr(_FakeStudio, "left", 1000)
    pattern = replace(reference.PATTERNS[2], cells=12, quality=8, frames=12)
    flag_motion.solve_pattern(pattern, tmp_path / "cloth.npz")
    return pattern, tmp_path, tool.Pictures(size=(32, 18), samples=1, views=9, view_size=16)


def test_training_views_are_a_capture_and_are_continued(tool, small, monkeypatch):
    pattern, folder, pictures = small
    monkeypatch.setattr(_FakeStudio, "left", 4)
    with pytest.raises(KeyboardInterrupt):
        tool.make_train(pattern, folder / "train", pictures, lambda line: None)
    assert not (folder / "train/transforms.json").exists()
    monkeypatch.setattr(_FakeStudio, "left", 1000)
    assert tool.make_train(pattern, folder / "train", pictures, lambda line: None) == 5
    assert tool.make_train(pattern, folder / "train", pictures, lambda line: None) == 0
    capture = read_capture(folder / "train")
    assert len(capture.views) == 9
    assert tuple(capture.views[0].load().shape) == (16, 16, 4)
    with pytest.raises(ValueError, match="`samples` was 1 and is now 2"):
        tool.make_train(pattern, folder / "train", replace(pictures, samples=2), lambda line: None)


def test_video_is_continued_and_joined_at_its_end(tool, small):
    pattern, folder, pictures = small
    cloth, video = folder / "cloth.npz", folder / "video"
    assert tool.make_video(pattern, cloth, video, replace(pictures, every=10), lambda line: None) == 2
    assert sorted(item.name for item in (video / "frames").iterdir()) == ["0000.png", "0010.png"]
    assert not (video / "reference.mp4").exists()
    assert tool.make_video(pattern, cloth, video, pictures, lambda line: None) == 10
    from imageio.v2 import get_reader

    with get_reader(video / "reference.mp4") as film:
        assert film.get_meta_data()["fps"] == 25
        assert film.count_frames() == 12
    camera = json.loads((video / "camera.json").read_text())
    assert (camera["w"], camera["h"], camera["fps"]) == (32, 18, 25)
    np.testing.assert_allclose(camera["light"]["direction"], pattern.normal())
    with pytest.raises(ValueError, match="`size` was"):
        tool.make_video(pattern, cloth, video, replace(pictures, size=(64, 36)), lambda line: None)


def test_truth_is_written_as_mesh_and_arrays(tool, small):
    from plyfile import PlyData

    pattern, folder, _ = small
    tool.make_truth(pattern, folder)
    with np.load(folder / "truth.npz") as data:
        assert data["area"] == pytest.approx(0.96)
        truth = {name: data[name] for name in data.files}
    mesh = PlyData.read(folder / "mesh.ply")
    normals = np.stack([mesh["vertex"][name] for name in ("nx", "ny", "nz")], -1)
    np.testing.assert_allclose(normals, truth["normals"], atol=1e-6)
    assert len(mesh["face"].data) == 2 * 11 * 7 == len(truth["faces"])


# ---- command line


def test_without_blender_one_sentence_names_the_extra(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "bpy", None)
    assert tool.main(["--preview", "--out", str(tmp_path / "flags")]) == 1
    said = capsys.readouterr().err
    assert "gaussian-swaying[blender]" in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / "flags").exists()


def test_options_reach_the_flag_and_the_pictures(tool, reference):
    shape = ["--cells", "60", "--frames", "50", "--flag-size", "0.6", "0.4", "--texture", "white", "--drag", "0.5"]
    options = tool.parse([*shape, "--damping", "0.3", "--size", "640x360", "--samples", "4"])
    flag, pictures = tool.flag_of(reference.PATTERNS[2], options), tool.pictures_of(options)
    assert (flag.cells, flag.frames, flag.width, flag.height) == (60, 50, 0.6, 0.4)
    assert (flag.texture, flag.drag, flag.damping) == ("white", 0.5, 0.3)
    assert flag.quality == reference.least_quality(flag) == 64  # cells of 1 cm
    assert (pictures.size, pictures.samples, pictures.views) == ((640, 360), 4, 200)
    default = tool.parse([])
    for pattern in reference.PATTERNS.values():
        assert tool.flag_of(pattern, default) == pattern
    assert tool.pictures_of(default) == tool.Pictures()
    preview = tool.parse(["--preview", "--views", "3"])
    assert tool.pictures_of(preview) == replace(tool.PREVIEW, views=3)
    assert tool.flag_of(reference.PATTERNS[1], preview).cells == 30
    with pytest.raises(ValueError, match="`samples`"):
        tool.pictures_of(tool.parse(["--samples", "0"]))


def test_bad_options_are_one_sentence(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    assert tool.main(["--pattern", "1", "--quality", "20", "--out", str(tmp_path / "flags")]) == 1
    assert "`quality`" in capsys.readouterr().err
    assert not (tmp_path / "flags").exists()


# ---- flags of one's own

FLAG = {"size": [1.0, 1.4], "E": 4e3, "density": 25, "flow": [1, 1.5, 0], "pins": "top", "yaw": 20, "drag": 1.0}
CONFIGS = Path(__file__).parents[2] / "configs" / "flags"


def _written(folder, name="own.yaml", **changed):
    """A file of FLAG with changes; a field that is None is left out."""
    fields = {key: value for key, value in (FLAG | changed).items() if value is not None}
    (folder / name).write_text(json.dumps(fields))  # JSON is YAML
    return folder / name


def test_any_flag_is_read_from_a_file(tool, tmp_path):
    path = _written(tmp_path, damping=0.5, cells=56, texture="own.png", thickness="5e-3")
    flag = tool.read_flag(path)
    assert (flag.width, flag.height, flag.youngs_modulus, flag.poisson_ratio) == (1.0, 1.4, 4000.0, 0.3)
    assert (flag.density, flag.thickness, flag.flow, flag.yaw) == (25.0, 0.005, (1.0, 1.5, 0.0), 20.0)
    assert (flag.pinned, flag.drag, flag.damping, flag.cells) == ("top", 1.0, 0.5, 56)
    assert (flag.frames, flag.fps, flag.gravity, flag.texture) == (250, 25, 9.8, "own.png")
    (tmp_path / "own.png").write_bytes(b"")
    assert tool.read_flag(path).texture == str(tmp_path / "own.png")  # beside the file
    flags = tool.flags_of(tool.parse(["--flag", str(path), "--frames", "50"]))
    assert list(flags) == ["own"]
    assert flags["own"].frames == 50
    assert flags["own"].quality == sys.modules["flag_reference"].least_quality(flags["own"])
    assert list(tool.flags_of(tool.parse([]))) == ["pattern1", "pattern2", "pattern3"]
    both = tool.parse(["--pattern", "2", "--flag", str(path)])
    assert list(tool.flags_of(both)) == ["pattern2", "own"]
    (tmp_path / "more").mkdir()
    twice = tool.parse(["--flag", str(path), str(_written(tmp_path / "more"))])
    with pytest.raises(ValueError, match=r"the folder `own`: rename .*more"):
        tool.flags_of(twice)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"E": None}, "has no `E`: add it, in Pa"),
        ({"pins": None}, "has no `pins`: add it, one of left, corners, top"),
        ({"pins": "right"}, "Expected `pins` to be one of left, corners, top, sides, but got 'right'"),
        ({"pins": ["top"]}, "Expected `pins` in .* to be one of left, corners, top"),
        ({"size": 1.2}, "Expected `size` in .* to be a list of 2 numbers, width and height in m, but got 1.2"),
        ({"size": [1.2, 0]}, "Expected `size` to be positive and finite, but got 0"),
        ({"E": "soft"}, "Expected `E` in .* to be a number in Pa, but got 'soft'"),
        ({"E": True}, "Expected `E` in .* to be a number in Pa"),
        ({"E": -1}, "Expected `E` to be positive and finite, but got -1"),
        ({"nu": 0.5}, "Expected `nu` to be at least 0 and below 0.5"),
        ({"flow": [1, "x", 0]}, "Expected `flow` in .* to be a list of 3 numbers, the velocity of the air in m/s"),
        ({"yaw": float("inf")}, "Expected `yaw` in .* to be a number in degrees"),
        ({"damping": -1}, "Expected `damping` not to be negative"),
        ({"cells": 10.5}, "Expected `cells` in .* to be a whole number"),
        ({"self_collision": 1}, "Expected `self_collision` in .* to be true or false"),
        ({"texture": 1}, "Expected `texture` in .* to be white, stripes, or the path of an image"),
        ({"colour": "red"}, "has an unknown field `colour`: use size, E, density, pins, flow"),
    ],
)
def test_a_bad_field_of_a_flag_is_one_sentence(tool, monkeypatch, tmp_path, capsys, changed, message):
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    path = _written(tmp_path, **changed)
    with pytest.raises(ValueError, match=message) as error:
        tool.read_flag(path)
    assert str(path) in str(error.value)
    assert tool.main(["--flag", str(path), "--out", str(tmp_path / "flags")]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "flags").exists()


def test_a_file_that_is_no_flag_is_one_sentence(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    for name, text in (("list.yaml", "[1, 2]"), ("broken.yaml", "E: ["), ("bytes.yaml", "\udcff")):
        (tmp_path / name).write_text(text, errors="surrogateescape")
        with pytest.raises(ValueError, match=name):
            tool.read_flag(tmp_path / name)
    assert tool.main(["--flag", str(tmp_path / "none.yaml")]) == 1
    assert "none.yaml does not exist" in capsys.readouterr().err


def test_a_flag_of_a_file_has_its_own_truth(tool, flag_motion, monkeypatch, tmp_path):
    """The folder has the name of the file; the rest shape and the motion are those of the fields."""
    _fake_solver(monkeypatch, flag_motion, [])
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    path = _written(tmp_path, cells=14, frames=3)
    assert tool.main(["--flag", str(path), "--only", "cloth", "--out", str(tmp_path / "flags")]) == 0
    folder = tmp_path / "flags" / "own"
    with np.load(folder / "cloth.npz") as data:
        assert data["areal_density"] == pytest.approx(0.25)
        assert data["membrane_stiffness"] == pytest.approx(40)
        np.testing.assert_allclose(data["flow"], [1, 1.5, 0])
        np.testing.assert_array_equal(data["pin_uv"], [[0, 1, 1, 1]])
        assert data["positions"].shape == (3, 14 * 10, 3)
    with np.load(folder / "truth.npz") as data:
        assert data["area"] == pytest.approx(1.4)
        turned = np.array([math.sin(math.radians(20)), -math.cos(math.radians(20)), 0])
        np.testing.assert_allclose(data["normals"], np.broadcast_to(turned, data["normals"].shape), atol=1e-12)
    assert tool.main(["--flag", str(path), "--only", "cloth", "--damping", "3", "--out", str(tmp_path / "flags")]) == 1


def test_three_flags_that_nothing_was_tuned_for(tool):
    """A curtain and a pennant in an oblique wind, and a light stiff flag in 3 m/s at 60 degrees to its plane."""
    expected = {"curtain": ((1.0, 1.4), 4e3, 25.0, 56.31), "light": ((1.2, 1.0), 8e3, 15.0, 60.0)}
    expected["pennant"] = ((0.6, 1.6), 6e3, 20.0, 68.20)
    assert {path.stem for path in CONFIGS.glob("*.yaml")} == set(expected)
    for name, (sides, modulus, density, angle) in expected.items():
        flag = tool.read_flag(CONFIGS / f"{name}.yaml")
        assert ((flag.width, flag.height), flag.youngs_modulus, flag.density) == (sides, modulus, density)
        assert (flag.thickness, flag.poisson_ratio, flag.pinned, flag.damping) == (0.01, 0.3, "top", 1.0)
        speed = math.hypot(*flag.flow)
        assert speed == pytest.approx({"curtain": 1.803, "light": 3.0, "pennant": 3.231}[name], abs=1e-3)
        assert math.degrees(math.asin(-flag.normal() @ flag.flow / speed)) == pytest.approx(angle, abs=0.01)


# ---- with Blender


def test_blender_gives_the_same_motion_twice_and_falls_as_it_should(reference, cloth):
    pytest.importorskip("bpy", reason="needs the extra [blender]")
    pattern = replace(reference.PATTERNS[2], cells=12, quality=8, frames=6)
    grid = pattern.grid()
    rest, pins = pattern.rest(grid.uv())[0], pattern.pins(grid.uv())
    one, other = (cloth.solve_cloth(grid, rest, pins, pattern.material(), pattern.run()) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one[0], rest, atol=1e-6)
    np.testing.assert_allclose(one[:, pins], np.broadcast_to(rest[pins], one[:, pins].shape), atol=1e-6)
    assert np.abs(one[-1] - rest).max() > 0.01


def test_relations_hold_on_panels(tool):
    """One mesh. Discretisation: a first-order step in the wind, a finite strain of about 1 % in the panel."""
    pytest.importorskip("bpy", reason="needs the extra [blender]")
    found = tool.check_relations(fine=None)
    ratios = {row["name"]: row["ratio"] for row in found["checks"]}
    for name, ratio in ratios.items():
        assert ratio == pytest.approx(1.0, abs=1e-3 if name.startswith("gravity") else 0.08), name


def test_photograph_shows_the_flag_where_the_camera_says(tool, reference, flag_pictures, tmp_path):
    """White cloth across the light has its own value; alpha ends where the corners are projected to."""
    pytest.importorskip("bpy", reason="needs the extra [blender]")
    from imageio.v3 import imread

    images = sys.modules["blender_images"]
    pattern = replace(reference.PATTERNS[1], cells=12, quality=8, frames=2)
    pictures = tool.Pictures(samples=4, views=1, view_size=120)
    lamps = np.stack([flag_pictures.lamp_position(pattern, side) for side in (1, -1)])
    studio = tool._studio(pattern, flag_pictures.draw_texture(pattern), lamps, pictures, True)
    studio.move(pattern.rest(pattern.grid().uv())[0])
    for side in (1, -1):
        eye = pattern.center() + side * 2.3 * pattern.normal() + [0.2, 0, 0.3]
        view = images.View(images.look_at(eye, pattern.center()), 0.7, 120, 90)
        studio.photograph(view, tmp_path / "view.png")
        image = imread(tmp_path / "view.png")
        assert image.shape == (90, 120, 4)
        assert np.median(image[40:50, 50:70, :3]) == pytest.approx(0.9 * 255, abs=5)
        corners = view.project(pattern.rest(np.array([[0.0, 0], [0, 1], [1, 0], [1, 1]]))[0])
        rows, columns = np.nonzero(image[..., 3] > 127)
        found = [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]
        expected = [corners[:, 0].min(), corners[:, 0].max(), corners[:, 1].min(), corners[:, 1].max()]
        np.testing.assert_allclose(found, expected, atol=1.0)
