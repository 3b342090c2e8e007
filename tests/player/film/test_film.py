"""What a film holds, against the Gaussians of the run; what is recorded for it; what cannot become a film."""

import base64
import hashlib
import json
import re
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import longest, peak, refused, seeded, value_error
from small_scenes import together

from gaussian_swaying.cli.export import main
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.player.film import page as film_page
from gaussian_swaying.player.film.page import PAGE, in_steps, pack, page, read_bundle, unpack, write_film
from gaussian_swaying.player.film.recorded import growth, read_film, spread
from gaussian_swaying.recording.nodes import join_far, load_nodes, split_far
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.simulation import Simulation

FRAMES = 6
FIELDS = ("position", "place", "stencil", "scale", "growth", "turn", "facing", "color", "stencils")


def check(simulation, film, frame, state):
    """The film against the Gaussians of the state, within what float16 of the run, or steps of a file, allow."""
    scene = simulation.scene
    size = scene.size * scene.frame.metres_per_unit
    drawn = scene.deformed(state)
    drawn = replace(drawn, means=drawn.means[film.order], covariances=drawn.covariances[film.order])
    position, shape = film.moved(frame)
    expected = scene.frame.point_to_sim(drawn.means.double()) / size
    most = float(peak(state.node_displacement)) / size
    rounding = most * 2**-11 + film.head["error"] / size  # of each node; the weights are positive and add up to 1
    in_gradient = 2 * rounding / film.head["cell"]  # slopes of a quadratic spline add up to at most 2
    arms = 0.0 if scene.follow.arm is None else float(longest(scene.follow.arm)) / size
    assert peak(position - expected) <= rounding + 3 * in_gradient * arms + 1e-6
    assert longest(position - expected) < 1e-3
    wanted = scene.frame.covariance_to_sim(drawn.covariances.double()) / size**2
    scale = wanted.diagonal(dim1=-2, dim2=-1).sum(-1)
    stored = 2 * 2**-9 + 1e-4  # float16 of a logarithm between 4 and 8 in size, twice; quaternions
    assert ((shape - wanted).abs().amax((-1, -2)) / scale).max() <= stored + 6 * in_gradient
    return most


@pytest.mark.parametrize("points", ["grid", "gaussian"])
def test_centres_and_covariances_are_those_of_the_run(make_flag, run, tmp_path, points):
    if points == "gaussian":
        run = tmp_path / "run"
        make_flag(scene={"points": "gaussian"}).run(run, FRAMES, progress=False)
    simulation = make_flag(scene={"points": points})
    film = read_film(run)
    assert film.head["count"] == len(simulation.scene.model.means) == len(film.position)
    for frame in simulation.frames(FRAMES):
        most = check(simulation, film, frame.index, frame.state)
    assert most > 0.02  # it moved


@pytest.mark.parametrize("points", ["grid", "gaussian"])
def test_parts_with_nodes_of_their_own(make_flag, flags, tmp_path, points):
    make = lambda: make_flag(scene=flags | {"points": points}, recorder={"renders": []})  # noqa: E731
    make().run(tmp_path / "run", 4, progress=False)
    simulation, film = make(), read_film(tmp_path / "run")
    cells = np.unique(np.floor(film.place - 0.5), axis=0)
    assert film.head["stencils"] > 1.8 * len(cells)
    for frame in simulation.frames(4):
        most = check(simulation, film, frame.index, frame.state)
    assert most > 0.02


def test_carried_static_and_plated_gaussians(make_flag, tmp_path):
    region = {"class_path": "Box", "init_args": {"min": [None, None, 0.2], "max": [None, None, None]}}
    make = lambda: make_flag(scene={"region": region, "layers": 3, "up": [0.0, 0.6, 0.8], "longest_side": 0.5})  # noqa: E731
    make().run(tmp_path / "run", 4, progress=False)
    simulation, film = make(), read_film(tmp_path / "run")
    assert 0 < len(film.place) == len(film.facing) == len(simulation.scene.moving) < len(film.position)
    assert sorted(film.order[: len(film.place)]) == sorted(simulation.scene.moving.tolist())
    assert sorted(film.order) == list(range(len(film.position)))
    for frame in simulation.frames(4):
        check(simulation, film, frame.index, frame.state)


def _same(film, other):
    for name in FIELDS:
        assert getattr(film, name).dtype == getattr(other, name).dtype
        assert np.array_equal(getattr(film, name), getattr(other, name)), name
    assert film.displacement.dtype == other.displacement.dtype
    assert np.abs(film.displacement - other.displacement).max() <= 1.001 * film.head["error"]


def test_a_bundle_holds_the_run(make_flag, run, tmp_path):
    """Places and shapes of every Gaussian, also of nodes that swing farther than 16 bits say."""
    write_film(run, tmp_path / "flag.sway")
    film, simulation = read_bundle(tmp_path / "flag.sway"), make_flag()
    film = replace(film, order=read_film(run).order)
    for frame in simulation.frames(FRAMES):
        check(simulation, film, frame.index, frame.state)
    film.displacement[2, 5] = [-4.0, 0.001, 1.0]
    assert np.array_equal(unpack(pack(film)).displacement[2, 5], np.float32([-4.0, 0.001, 1.0]))


def test_another_program_reads_a_bundle(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_film(run, tmp_path / "flag.sway")
    content, at, blocks = (tmp_path / "flag.sway").read_bytes(), 8, []
    while at < len(content):
        (size,) = struct.unpack_from("<I", content, at)
        blocks.append(zlib.decompress(content[at + 4 : at + 4 + size]))
        at += 4 + size

    def planes(block, kind):
        rows = np.frombuffer(block, np.uint8).reshape(np.dtype(kind).itemsize, -1)
        return np.ascontiguousarray(rows.T).view(kind)[:, 0]

    head, film = json.loads(blocks[0]), read_bundle("flag.sway")
    assert content[:8] == b"SWAY\1\0\0\0"
    assert np.array_equal(planes(blocks[1], "<u4").reshape(-1, 27), film.stencils)
    places = {kind: blocks[2 + k] for k, (kind, *_) in enumerate(head["parts"])}
    rows = np.frombuffer(places["moving"], np.uint8).reshape(-1, head["moving"]).T
    assert np.array_equal(np.ascontiguousarray(rows[:, :12]).view("<f4"), film.position)
    assert np.array_equal(rows[:, 12:16], film.color)
    size = 6 * head["nodes"] * head["frames"]
    v = planes(places["frames"][:size], "<u2").reshape(head["frames"], -1, 3)
    moved = np.cumsum(v >> 1 ^ -(v & 1), axis=0, dtype=np.uint16).view(np.int16) * head["step"]
    assert not planes(places["frames"][size : size + 4 * head["frames"]], "<u4").any()
    assert np.abs(moved - film.displacement).max() < 1e-7
    text = (Path(__file__).parents[3] / "docs/bundle.md").read_text(encoding="utf-8")
    ((example, output),) = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, flags=re.DOTALL)
    exec(compile(example, "docs/bundle.md", "exec"), {})
    assert capsys.readouterr().out == output


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (lambda content: b"PK" + content[2:], "no .sway file"),
        (lambda content: content[:5], "no .sway file"),
        (lambda content: content[:4] + b"\x09" + content[5:], "version 9"),
        (lambda content: content[:-9], "damaged"),
        (lambda content: content[:400] + b"\0\0\0" + content[403:], "damaged"),
        (lambda content: content[:8], "damaged"),
    ],
)
def test_a_bundle_that_cannot_be_read(run, tmp_path, harm, words):
    write_film(run, tmp_path / "flag.sway")
    (tmp_path / "bad.sway").write_bytes(harm((tmp_path / "flag.sway").read_bytes()))
    with value_error(words):
        read_bundle(tmp_path / "bad.sway")


def test_nothing_is_lost_in_the_file(run, tmp_path, capsys):
    assert main(["--web", str(run)]) == 0
    told = capsys.readouterr().out
    text = (run / "film.html").read_text()
    assert re.search(r"384 Gaussians, 6 frames of \d+ nodes\nwrote .*film\.html \(0\.\d MB\)\n", told)
    found = re.findall(r'<script type="text/plain" id="film-([\w-]+)" data-size="(\d+)">([^<]+)</script>', text)
    assert all(int(size) == len(part) for _, size, part in found)
    parts = {name: part for name, _, part in found}
    blocks = {name: zlib.decompress(base64.b64decode(part)) for name, part in parts.items()}
    assert b"SparkRenderer" in blocks.pop("code")
    film, again = read_film(run), unpack(blocks)
    assert film.head == again.head
    _same(film, again)
    assert main([str(run), str(run / "flag.sway")]) == 0
    bundle = read_bundle(run / "flag.sway")
    assert np.array_equal(bundle.displacement, again.displacement)
    _same(film, bundle)
    assert not re.search(r'(src|href)="(?!data:,)', text)
    for licence in ("WORLD LABS", "three.js authors", "Arjun Barrett"):
        assert licence in text
    data = sum(len(block) for block in pack(film).values())
    head, rest = film.head, len(parts["code"]) + 16_384
    far = sum(len(in_steps(frame, head["step"])[1]) for frame in film.displacement)
    raw = 31 * head["count"] + 24 * head["moving"] + 108 * head["stencils"] + 6 * head["nodes"] * head["frames"]
    raw += 4 * head["frames"] + 16 * far + len(blocks["head"])
    assert data == raw
    assert len(text) < rest + 4 / 3 * (1.001 * raw + 256)
    again = page(film)
    assert again == text
    (run / "film.html").unlink()


def test_a_large_film_comes_in_parts(run, monkeypatch):
    """Some of all Gaussians and some frames come first; nothing is lost, whatever the sizes of the parts."""
    monkeypatch.setattr(film_page, "FIRST", {"moving": 30, "still": 20})
    monkeypatch.setattr(film_page, "PART", 100)
    monkeypatch.setattr(film_page, "GROUP", 4)
    film = read_film(run)
    film.head["moving"] = 250  # as if the others stood still
    film = replace(film, arm=film.arm[:250], stencil=film.stencil[:250], facing=film.facing[:250])
    blocks = pack(film)
    head = json.loads(blocks["head"])
    assert head["start"] == 3
    assert head["parts"][:5] == [
        ["moving", 0, 30], ["still", 0, 20], ["frames", 0, 4], ["moving", 30, 130], ["still", 20, 120]
    ]  # fmt: skip
    assert list(blocks) == ["head", "stencils", *(f"part-{k}" for k in range(len(head["parts"])))]
    _same(film, unpack(blocks))


def test_what_comes_first_is_spread_over_all():
    places = torch.rand(1000, 1, generator=seeded(0)).sort(0)[0] * torch.tensor([1.0, 0.0, 0.0])
    order = spread(places)
    assert sorted(order.tolist()) == list(range(1000))
    for count in (8, 30, 200, 999):
        gaps = order[:count].sort()[0].diff()
        assert int(gaps.max()) <= 4 * 1000 / count
    assert spread(places[:1]).tolist() == [0]
    assert spread(torch.zeros(5, 3)).sort()[0].tolist() == [0, 1, 2, 3, 4]


def test_gaussians_grow_less_where_many_lie_behind_each_other(make_flag):
    cloud = FlagScene(spacing=0.05).generate()
    camera = OrbitCamera(width=640, height=360, azimuth=-90.0, radius=1.0)
    found = []
    for clouds in (4, 400):
        scene = Scene(generator=GivenScene(together(*[cloud] * clouds)), points="gaussian")
        simulation = Simulation(scene, Material(), camera=camera, device="cpu")
        found.append(growth(simulation.scene, simulation.painter.camera_at(0))[: len(cloud)])
    few, many = found
    assert many.max() < 1
    assert torch.allclose(torch.where(few < 1, 10 * many, few), few, rtol=1e-5)
    assert (few < 1).float().mean() > 0.2


def test_the_program_is_built_from_its_sources(request):
    player = request.config.rootpath / "tools/player"
    own = sorted(path.name for path in player.glob("*.js") if not path.name.startswith("sway"))
    shared = ["build.js", "bundle.js", "film.glsl.js"]
    for name, sources in {
        "film": [*own, "live_web/page.js", "package-lock.json"],
        "sway": [*shared, "gaussians.js", "sorter.js", "sway.js"],
        "sway-playcanvas": [*shared, "sway-playcanvas.js"],
    }.items():
        checksum = hashlib.sha256(b"".join((player / source).read_bytes() for source in sources)).hexdigest()
        assert (PAGE / f"{name}.min.js").read_text().startswith(f"// Made by tools/player from {checksum}\n")
    packages = json.loads((player / "package-lock.json").read_text())["packages"]
    wanted = json.loads((player / "package.json").read_text())["devDependencies"]
    assert {name: packages[f"node_modules/{name}"]["version"] for name in wanted} == wanted
    told = dict(re.findall(r"^---- (\S+) (\S+)$", (PAGE / "LICENSES.txt").read_text(), re.M))
    assert told == {name: version for name, version in wanted.items() if name not in ("esbuild", "playcanvas")}


# ---- what a run records


def test_nodes_that_swing_far_keep_their_digits(tmp_path):
    """Nodes with hardly any mass move by thousands of metres, beyond what float16 rounds well or holds at all."""
    generator = seeded(0)
    moved = (torch.rand(50, 3, generator=generator) - 0.5).numpy()
    moved[[3, 20]] = [[1e5, 2.00001, -3e7], [0.1, 0.61, 0.2]]
    near, far = split_far(moved, 0.6)
    assert far[:, 0].tolist() == [3, 20]
    assert np.array_equal(join_far(near, far)[[3, 20]], moved[[3, 20]])
    assert np.abs(join_far(near, far) - moved).max() <= 0.6 * 2**-11
    assert near.dtype == np.float16
    assert split_far(moved[:0], 0.6)[1].shape == (0, 4)
    np.savez(tmp_path / "nodes.npz", displacement_00000=near, far_00000=np.full((1, 4), 77, np.int32))
    with value_error(r"nodes\.npz is damaged \(index 77 is out of bounds"):
        load_nodes(tmp_path / "nodes.npz")


def test_damaged_nodes_are_not_added_to(make_flag, tmp_path):
    folder = tmp_path / "run"
    make_flag().run(folder, 3, progress=False)
    assert load_nodes(folder / "nodes.npz").dtype == torch.float32
    (folder / "nodes.npz").write_bytes((folder / "nodes.npz").read_bytes()[:5000])
    with value_error(r"nodes\.npz is not a \.npz file, or is incomplete"):
        make_flag().run(folder, FRAMES + 1, resume=True, progress=False)


def test_a_resumed_run_without_earlier_nodes_says_so(make_flag, tmp_path, capsys):
    folder = tmp_path / "run"
    make_flag().run(folder, 2, progress=False, recorder=Recorder(video=False, nodes=False))
    make_flag().run(folder, 3, resume=True, progress=False)
    assert "so nodes.npz will be without them; start again without --resume to have them." in capsys.readouterr().err
    _refused(capsys, "lacks frames: run the simulation again, without --resume.\n", folder)


# ---- what cannot become a film


def _refused(capsys, words, *arguments):
    return refused(lambda given: main(["--web", *map(str, given)]), arguments, capsys, words)


def test_what_is_no_run_of_total_is_refused(make_flag, run, tmp_path, capsys):
    _refused(capsys, "has no run: give the output folder of `gaussian-swaying sim`", tmp_path)
    _refused(capsys, "to end in .html, but got ", run, tmp_path / "film.mp4")
    _refused(capsys, "--metres-per-unit is not for a film", run, "--metres-per-unit", "2")
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "nodes.npz").unlink()
    _refused(capsys, "run it again with `recorder.nodes: true`.", copy)
    summary = json.loads((copy / "summary.json").read_text())
    (copy / "summary.json").write_text(json.dumps(summary | {"formulation": "updated"}))
    _refused(capsys, "`solver.formulation: updated`", copy)
    (copy / "summary.json").write_text("{")
    _refused(capsys, "summary.json cannot be read", copy)
    assert not list(tmp_path.glob("**/film.*"))


def test_a_splat_that_moved_or_changed_is_refused(make_flag, tmp_path, capsys):
    splat, folder = tmp_path / "flag.ply", tmp_path / "run"
    cloud = FlagScene(spacing=0.1).generate()
    write_ply(splat, cloud)
    make_flag(scene={"generator": None, "ply": str(splat)}, recorder={"renders": []}).run(folder, 2, progress=False)
    assert main(["--web", str(folder)]) == 0
    cloud.means[0] += 0.001
    write_ply(splat, cloud)
    _refused(capsys, "flag.ply has changed since the run in", folder)
    splat.unlink()
    _refused(capsys, "flag.ply of the run is not there (`scene.ply` in ", folder)


def _with_nodes(run, folder, change):
    """A copy of a run with other nodes; ``change`` gets the displacement and the far rows of the third frame."""
    shutil.copytree(run, folder)
    arrays = dict(np.load(run / "nodes.npz"))
    arrays["displacement_00002"], arrays["far_00002"] = change(arrays["displacement_00002"], arrays["far_00002"])
    np.savez(folder / "nodes.npz", **arrays)
    return str(folder)


def _set(value):
    """The first node has another displacement, in float32."""

    def change(near, far):
        moved = join_far(near, far)
        moved[0] = value
        return split_far(moved, 0.5)

    return change


def test_nodes_that_cannot_be_shown_are_refused(run, tmp_path, capsys):
    """A damaged or made up nodes.npz would be a page without a picture."""
    assert main(["--web", _with_nodes(run, tmp_path / "same", lambda near, far: (near, far))]) == 0
    for k, (change, words) in enumerate(
        (
            (_set(np.nan), r"frame 2 has a displacement that is NaN or infinite"),
            (_set(np.inf), r"frame 2 has a displacement that is NaN or infinite"),
            (lambda near, far: (near.astype("f8"), far), r"an array of float64 has the shape"),
            (lambda near, far: (near[:, :2], far), r"an array of float16 has the shape \(\d+, 2\)"),
            (lambda near, far: (near, np.full((1, 4), -1, np.int32)), r"there is no node -1"),
        )
    ):
        told = _refused(capsys, "nodes.npz", _with_nodes(run, tmp_path / str(k), change))
        assert re.search(rf"nodes\.npz .*{words}.*run the simulation again", told), told
        assert not (tmp_path / str(k) / "film.html").exists()
