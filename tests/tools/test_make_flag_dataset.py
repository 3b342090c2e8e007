"""The reference of the flag benchmark: what is asked of Blender, its files, cameras and resuming.

Nothing here needs Blender, apart from the last tests, which are skipped without it.
"""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from shared import value_error

from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.captures.capture_camera import CaptureCamera

from .conftest import ROOT, beside

TOOL = "make_flag_dataset"
CONFIGS = ROOT / "configs"
reference = beside("flag_reference")
flag_pictures = beside("flag_pictures")
flag_motion = beside("flag_motion")
cloth = beside("blender_cloth")


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


def test_blender_is_asked_in_its_own_units(reference, cloth):
    """The relations, turned round: whatever the mesh, the same mass, springs, damping, bending and wind in SI units."""
    for cells in (30, 60, 120):
        pattern = replace(reference.PATTERNS[2], cells=cells, quality=512, damping=0.7)
        grid, material, run = pattern.grid(), pattern.material(), pattern.run()
        bending = 3e3 * pattern.thickness**3 / 12 / (1 - 0.3**2)
        asked = cloth.blender_settings(grid, material, run)
        assert asked["gravity"] == pytest.approx(-15.68)
        assert asked["mass"] * grid.count == pytest.approx(0.3 * 1.2 * 0.8)
        spring = asked["tension_stiffness"] * 625 / grid.cell
        lengths = _spring_lengths(grid)
        assert spring * grid.cell / lengths.mean() * 4 / 3 == pytest.approx(30.0)  # Blender divides by the mean length
        assert asked["tension_damping"] * 25 / (30.0 * 3 / 4) == pytest.approx(2.2e-3)
        assert asked["bending_stiffness"] * cloth.BENDING * grid.cell**2 * 625 == pytest.approx(bending)
        assert 0.02 * 25 * asked["strength"] == pytest.approx(0.5 * 1.225 * 0.8 * (2.5**2 + 0.5**2))
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
    with value_error("`quality` of at least 38"):
        cloth.solve_cloth(grid, grid.flat(), [], pattern.material(), rough)


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
    with value_error(r"`drag` was 0.8 and is now 1.0; `quality` was 8 and is now 16"):
        flag_motion.solve_pattern(changed, path)
    assert calls == [8]


def _seen(fields_path, frame, points):
    camera = CaptureCamera(fields_path, frame)(0, 0.0, torch.zeros(3).double(), torch.zeros(3), 1.0)
    local = points @ camera.world_to_camera[:3, :3].T.numpy() + camera.world_to_camera[:3, 3].numpy()
    image = local @ camera.intrinsics.numpy().T
    return image[:, :2] / image[:, 2:], local[:, 2]


def test_training_views_hold_the_whole_flag_and_are_ours_too(reference, flag_pictures, tmp_path):
    pattern = reference.PATTERNS[3]
    views = flag_pictures.sphere_views(pattern, 40, 100)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(flag_pictures.transforms_fields(views, [f"{i:02}.png" for i in range(40)])))
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
    with value_error("`samples` was 1 and is now 2"):
        tool.make_train(pattern, folder / "train", replace(pictures, samples=2), lambda line: None)


def test_without_blender_one_sentence_names_the_extra(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "bpy", None)
    assert tool.main(["--preview", "--out", str(tmp_path / "flags")]) == 1
    said = capsys.readouterr().err
    assert "gaussian-swaying[blender]" in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / "flags").exists()


FLAG = {"size": [1.0, 1.4], "E": 4e3, "density": 25, "flow": [1, 1.5, 0], "pins": "top", "yaw": 20, "drag": 1.0}


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
    assert (flag.pinned, flag.drag, flag.damping, flag.cells, flag.texture) == ("top", 1.0, 0.5, 56, "own.png")
    (tmp_path / "own.png").write_bytes(b"")
    assert tool.read_flag(path).texture == str(tmp_path / "own.png")  # beside the file
    flags = tool.flags_of(tool.parse(["--flag", str(path), "--frames", "50"]))
    assert (flags["own"].frames, flags["own"].quality) == (
        50,
        sys.modules["flag_reference"].least_quality(flags["own"]),
    )


def test_benchmarks_have_the_flags_of_their_references(tool):
    """The same size, turn and ripple at rest: one of 3 mm would be 12 % of the pressure on flag 2."""
    from gaussian_swaying.simulation.simulation import Simulation

    patterns = {str(number): flag for number, flag in tool.PATTERNS.items()}
    patterns |= {path.stem: tool.read_flag(path) for path in (CONFIGS / "flags").glob("*.yaml")}
    assert len(patterns) == 8
    for name, flag in patterns.items():
        files = [f"sim/flag{name if name in '123' else 3}", f"bench/flag{name if name in '123' else 3}"]
        files += [] if name in "123" else [f"bench/flag{name}" if name.isdigit() else f"bench/{name}"]
        words = [word for file in files for word in ("--config", str(CONFIGS / f"{file}.yaml"))]
        made = Simulation.parser().parse_args(words).scene.generator.init_args
        for field in ("width", "height", "yaw", "ripple"):
            assert made[field] == getattr(flag, field), (name, field)


@pytest.mark.parametrize(
    ("changed", "field"),
    [({"E": None}, "E"), ({"pins": "right"}, "pinned"), ({"size": 1.2}, "size"), ({"nu": 0.5}, "poisson_ratio"),
     ({"flow": [1, "x", 0]}, "flow"), ({"colour": "red"}, "colour")],
)  # fmt: skip
def test_a_bad_field_of_a_flag_is_one_sentence(tool, monkeypatch, tmp_path, capsys, changed, field):
    monkeypatch.setattr(tool, "require_bpy", lambda: None)
    path = _written(tmp_path, **changed)
    assert tool.main(["--flag", str(path), "--out", str(tmp_path / "flags")]) == 1
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert f"`{field}`" in said
    assert not (tmp_path / "flags").exists()


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
