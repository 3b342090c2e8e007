"""The flag benchmark: command lines that parse, a row from a run, and the page."""

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bench.cases import flags
from bench.cases.trained import filled
from bench.tables import flag_benchmark as tables
from imageio.v3 import imread, imwrite
from small_scenes import plain_cloud

from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure, shown

DRAG = {2: 0.8, 3: 1.28}
PIXEL = imwrite("<bytes>", np.zeros((4, 6, 3), np.uint8), extension=".png")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def settings_of():
    """The settings of a row: what its command line is parsed as."""
    parser = Simulation.parser()

    def settings(name, pattern, *more):
        arguments = flags.sim_arguments(pattern, flags.VARIANTS[name], Path("none"), None)
        return parser.parse_args([*arguments, *more])

    return settings


@pytest.mark.parametrize("pattern", flags.REFERENCES)
def test_every_row_is_a_command_line_that_parses(pattern, settings_of):
    base = settings_of("ours", pattern)
    for name, variant in flags.VARIANTS.items():
        if pattern not in variant.patterns or (pattern not in (1, 2, 3) and name not in ("particle", "thin")):
            continue  # the other rows of the further flags are made of the same files
        settings = settings_of(name, pattern)
        assert settings.recorder.trajectory
        # as the reference at rest
        assert settings.scene.generator.init_args.ripple == {1: 0.003}.get(pattern, 0.0)
        if name == "ours" and pattern != 1:
            aero, drag = settings.aero, DRAG.get(pattern, DRAG[3])
            assert (aero.C_D, aero.C_F, aero.law) == (drag, 0.0, "projected")
            assert not settings.wind.modulations
        one = ("membrane", "particle", "own_volumes", "no_surface", "to_layer", "to_law", "to_area", "to_wind")
        assert settings.scene.layers == (1 if name in one else 3)
        if name in ("particle", "own_volumes", "no_surface", "to_wind"):
            assert settings.aero.C_D == settings.aero.C_F
        if name == "thin":  # the same sheet: E h and density h
            for field in ("E", "density"):
                sheets = [getattr(s.material, field) * s.material.thickness for s in (settings, base)]
                assert sheets[0] == pytest.approx(sheets[1])


def _leaves(settings):
    return {key: value for key, value in settings.items() if "__path__" not in key and key != "config"}


@pytest.mark.parametrize("pattern", ["light"])
def test_rows_lead_from_ours_to_physgaussians_way_by_one_change_each(pattern, settings_of):
    """The last of them is PhysGaussian's way."""
    way = [_leaves(settings_of(name, pattern)) for name in ("ours", *tables.WAY)]
    changes = [{key for key in {**old, **new} if new.get(key) != old.get(key)} for old, new in pairwise(way)]
    assert changes[:4] == [{"material.volume"}, {"scene.layers"}, {"material.law.class_path"}, {"scene.area"}]
    assert changes[4] == {"aero.C_F"}
    assert all(key.startswith("shader") for key in changes[5])
    assert changes[5]
    assert way[-1] == _leaves(settings_of("own_volumes", pattern))


@pytest.mark.parametrize("pattern", [1, "curtain"])
def test_rows_are_scaled_to_the_mass_of_ours(pattern, settings_of):
    """To the rounding of a sum in float32, as the goal on the page asks for; without the scale they are heavier."""
    more = ["--scene.generator.init_args.spacing=0.04", "--solver.dx=0.06", "--scene.particle_spacing=null"]
    more.append("--device=cpu")
    parser = Simulation.parser()

    def body(name, *options):
        return Simulation.from_settings(parser, settings_of(name, pattern, *more, *options)).scene.points

    ours = body("ours")
    for name in ("to_volume", "particle"):
        own, wanted = ([*flags.sim_arguments(pattern, flags.VARIANTS[row], Path("none"), None), *more]
                       for row in (name, "ours"))  # fmt: skip
        scaled, factor = flags.of_equal_mass(own, wanted)
        points, before = body(name, *scaled), body(name)
        assert float(points.mass.sum() / ours.mass.sum()) == pytest.approx(1, abs=tables.SAME_MASS)
        assert float(before.mass.sum() / ours.mass.sum()) > 1.5
        stiffness = [(each.volume * each.youngs_modulus).sum() for each in (points, before)]
        assert float(stiffness[0] / stiffness[1]) == pytest.approx(factor, rel=1e-4)


def test_pictures_have_the_size_of_the_reference(tmp_path):
    video = tmp_path / "pattern2" / "video"
    video.mkdir(parents=True)
    (video / "camera.json").write_text(json.dumps({"w": 320, "h": 180}))
    settings = Simulation.parser().parse_args(flags.sim_arguments(2, flags.VARIANTS["ours"], tmp_path, None))
    assert (settings.camera.init_args.width, settings.camera.init_args.height) == (320, 180)


def test_gaussians_turned_to_the_reference(tmp_path):
    """Normals are those of the nearest vertex, the normal's own axis is the one that was turned, sizes stay."""
    from gaussian_swaying.gaussians.ply import read_ply, write_ply
    from gaussian_swaying.geometry.patches import smallest_axis_normal

    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(50, 4, generator=generator)
    cloud = plain_cloud(torch.rand(50, 3, generator=generator), torch.tensor([-4.0, -3.0, -9.0]), quats, 0.0)
    write_ply(tmp_path / "own.ply", cloud)
    vertices = np.array([[[0.0, 0.5, 0.5], [1.0, 0.5, 0.5]]])
    normals = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, 0.8]])
    np.savez(tmp_path / "cloth.npz", positions=vertices, rest_normals=normals)
    flags.turn_to_reference(tmp_path / "own.ply", tmp_path / "cloth.npz", tmp_path / "turned.ply")
    turned = read_ply(tmp_path / "turned.ply")
    expected = torch.from_numpy(normals)[(cloud.means[:, 0] > 0.5).long()]
    found = smallest_axis_normal(turned.quats.double(), turned.scales.double())
    torch.testing.assert_close((found * expected).sum(-1).abs(), torch.ones(50, dtype=torch.float64))
    assert torch.equal(turned.scales, cloud.scales)
    assert torch.equal(turned.means, cloud.means)


def test_a_row_of_a_flag_is_simulated_and_compared(tmp_path):
    """A flag in still air that cannot fall, against one at rest: what is left is the spacing of the points."""
    u, v = np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 1, 17), indexing="ij")
    x, z = 1.2 * u.ravel(), 0.8 * v.ravel()
    rest = np.stack([x, 0.003 * np.sin(3 * np.pi * u.ravel()), z], -1)
    corner = (np.arange(24)[:, None] * 17 + np.arange(16)).ravel()
    faces = np.stack([corner, corner + 17, corner + 18, corner + 1], -1)
    folder = tmp_path / "data" / "pattern1"
    folder.mkdir(parents=True)
    settings = {"width": 1.2, "height": 0.8}
    np.savez(folder / "cloth.npz", positions=np.repeat(rest[None], 2, 0), faces=faces, settings=json.dumps(settings))
    options = SimpleNamespace(dataset=tmp_path / "data", device="cpu", frames=2, points=500)
    options.more = "--scene.generator.init_args.spacing=0.1 --solver.dx=0.2 --solver.gravity=[0,0,0] "
    options.more += "--solver.boundaries=[] --scene.particle_spacing=null"
    ours = flags.VARIANTS["ours"]
    row = flags.run_row(1, ours, options, None, tmp_path / "ours_1")
    assert (row["status"], row["frames"]) == ("complete", 2)
    assert row["mean"]["chamfer_m"] < 0.1  # the spacing
    assert row["chamfer_share"] == pytest.approx(row["mean"]["chamfer_m"] / 1.2)
    particle = flags.run_row(1, flags.VARIANTS["particle"], options, None, tmp_path / "particle_1")
    assert particle["mass_kg"] == pytest.approx(row["mass_kg"], rel=tables.SAME_MASS)
    assert particle["volume_factor"] < 0.7
    assert "volume_factor" not in row
    options.more = "--solver.dx=nonsense"
    assert "solver.dx" in flags.run_row(1, ours, options, None, tmp_path / "again" / "ours_1")["failed"]


def test_the_line_that_names_the_error():
    told = "Traceback\nRuntimeError: CUDA error: out\nCompile with `X` to enable assertions.\n\n"
    assert flags.what_failed(told) == "RuntimeError: CUDA error: out"
    assert flags.what_failed("one\ntwo\n") == "two"
    assert flags.what_failed("") == "no message"


def test_a_figure_needs_all_pictures(tmp_path):
    frames = {"reference": tmp_path / "reference/video/frames", "ours": tmp_path / "ours/frames"}
    frames["particle"] = tmp_path / "particle/frames"
    for folder in frames.values():
        folder.mkdir(parents=True)
        for number in range(250):
            (folder / f"{number:05d}.png").write_bytes(PIXEL)
    runs = {name: tmp_path / name for name in ("ours", "particle")}
    target = tmp_path / "figures" / "one.png"
    assert not flags.figure(tmp_path / "reference", {"ours": runs["ours"]}, target)
    assert not target.exists()
    assert flags.figure(tmp_path / "reference", runs, target)
    assert imread(target).shape[1] > 1000


def _share(share, mass=0.5, **more):
    return {"status": "complete", "chamfer_share": share, "torn_particles": 0, "mass_kg": mass,
            "mean": {"chamfer_m": share}} | more  # fmt: skip


def test_the_page_tells_what_was_not_and_how_far_the_reference_is_from_itself():
    stopped = _share(0.0213, status="diverged", frames=31)
    rows = {"ours": {"1": _share(0.0213), "3": stopped}, "particle": {"1": {"failed": "x"}}}
    known = {"cells": 60, "quality": 16, "frames_compared": 250, "chamfer": 0.034}
    ways = {"coarser": known, "hardly bending": known | {"chamfer": 0.082}, "half": known | {"chamfer": 0.041}}
    result = HEAD | {"splats": "made in code", "rows": rows, "uncertainty": {"1": ways}}
    result |= {"more": "--solver.dx=0.03", "note": "Other work ran beside these."}
    assert [row[1:3] for row in cells("flags.rows", result)] == [["2.13 %", "stopped at frame 31"], ["failed", "-"]]
    told = "\n".join(shown("flags.device", result))
    assert "`--solver.dx=0.03`" in told
    assert "Other work ran beside these." in told
    told = "\n".join(shown("flags.reference", [result]))
    assert "coarser (60 cells, 16 steps, 250 frames) 3.40 %" in told
    assert "another flag: with a fiftieth of its bending stiffness (60 cells, 16 steps, 250 frames) 8.20 %" in told
    # the largest of all that are this flag
    assert cells("flags.goals", result)[0][1] == "2.13 % (reference itself: 4.10 %)"
    assert shown("flags.reference_doubt", [result]) == "4.10 %"


def test_the_page_quotes_the_paper():
    assert "| Gaussian Swaying | 21.44 | 0.0178 |" in (ROOT / "docs/flag_benchmark.md").read_text()


def test_numbers_of_the_prose_are_those_of_the_reference():
    """The wind of pattern 2, (2.5, 0.5, 0) m/s, along a flag in the x-z plane: atan(0.2), and a degree over tan."""
    assert shown("flags.ripple", [], "1") == "3 mm"
    assert shown("flags.incidence", [], "2") == "11 degrees"
    assert shown("flags.per_degree", [], "2") == "9 %"


def test_goals_and_what_changes_do():
    def row(share, psnr, **more):
        return _share(share) | {"mean": {"psnr_db": psnr, "chamfer_m": 2 * share}} | more

    ours = row(0.02, 22.0, chamfer_per_frame_m=[0.01, 0.02, 0.06])
    rows = {"ours": {"3": ours}, "particle": {"3": row(0.1, 18.0)}, "no_surface": {"3": row(0.03, 18.0)}}
    rows |= {"no_shading": {"3": row(0.02, 23.0)}, "undamped": {"3": row(0.025, 22.0)}, "thin": {"3": row(0.018, 22.0)}}
    rows |= {"to_volume": {"3": row(0.022, 22.0)}, "to_layer": {"3": row(0.06, 22.0)}, "own_volumes": {"3": row(1, 1)}}
    result = {"splats": "made in code", "rows": rows}
    found = cells("flags.goals", result)
    assert [row[1:] for row in found] == [
        ["2.00 %", "yes"], ["1.000000 times", "yes"], ["0.20 times", "yes"], ["+4.00 dB", "no"], ["1.50 times", "no"],
        ["+1.00 dB", "no"],
    ]  # fmt: skip
    trained = cells("flags.goals", result | {"splats": "trained, 7000 images"})
    assert trained[0][0::2] == ["pattern 3: Chamfer distance within 1.2 % of the longer side", "no"]
    assert trained[1:] == found[1:]
    thirds, way, single = shown("flags.changes", {"rows": rows})
    assert thirds.endswith("0.50 %, 1.00 %, 3.00 %")
    told = "ours with volumes of grid cells +0.20; one layer +3.80; no shading: PhysGaussian's way +4.00"
    assert way == f"- pattern 3, what each further change adds [% of the longer side]: {told}"
    assert "half the thickness, double E and density -0.20; no shading +0.00; without the" in single
    assert single.endswith("damping +0.50")
    rows["particle"]["3"]["mass_kg"] = 0.5001
    assert cells("flags.goals", result)[1][1:] == ["1.000200 times", "no"]


def test_rows_of_another_mass_or_splat_are_marked_and_those_that_were_dropped_named():
    """A splat is another one when ours was measured again with a splat trained anew and the row was not."""
    old, new = ({"training": {"seconds": seconds}} for seconds in (78.2, 80.1))
    rows = {"ours": {"1": _share(0.02) | new}, "own_volumes": {"1": _share(0.04, 1.0) | new}}
    rows |= {"linear": {"1": _share(0.03) | new}, "thin": {"1": _share(0.01, 0.514) | old}}
    told = [row[1:] for row in cells("flags.rows", {"rows": rows})]
    assert told == [["2.00 %", "1.00"], ["4.00 % (2.00 times the mass)", "2.00"], ["3.00 %", "1.00"],
                    ["1.00 % (another splat)", "1.03"]]  # fmt: skip
    (line,) = shown("flags.changes", {"rows": rows})
    assert line.endswith("pressure linear in the cloth's speed +1.00")
    dropped = {"ours": {"2": _share(0.0162)}, "updated_04": {"2": _share(0.0149)}}
    assert cells("flags.dropped", {"dropped": dropped}) == [["`updated`, dx = 0.04 m", "pattern 2", "1.49 %", "1.62 %"]]
    assert shown("flags.dropped", {"rows": {}}) == []
    kept = json.loads((ROOT / "docs/results/flags_made_cpu.json").read_text())["dropped"]
    assert sum(len(row) for name, row in kept.items() if name != "ours") == 10  # those that commit 211bfec left out


def test_the_headline_is_the_mean_over_all_flags():
    """Of the fullest record of each kind; PhysGaussian's way only where each of these flags has it at equal mass."""
    trained = {"splats": "trained, 7000 images", "rows": {"ours": {"1": _share(0.02), "3": _share(0.01)}}}
    made = {"splats": "made in code", "rows": {"ours": {"1": _share(0.03)}}}
    more = {"splats": "made in code", "rows": {"ours": {"4": _share(0.01), "light": _share(0.02)}}}
    told = shown("flags.headline", [trained, made, more])
    own, in_code = "**1.50 %** with splats trained on photos (mean of 2 flags", "**1.50 %** with splats made in code"
    assert told == f"{own}) and {in_code} (mean of 2 flags)"
    trained["rows"] |= {"own_volumes": {"1": _share(0.3), "3": _share(0.3)}, "particle": {"1": _share(0.1)}}
    assert shown("flags.headline", [trained]) == f"{own})"
    trained["rows"]["particle"]["3"] = _share(0.2)
    way = "; PhysGaussian's way, with the same splats and mass, **15.00 %**"
    assert shown("flags.headline", [trained]) == f"{own}{way})"


def test_splats_made_in_code_have_records_of_their_own(bench, tmp_path, monkeypatch):
    """For all flags; those without photos cannot be trained."""
    monkeypatch.setattr(flags, "run_row", lambda *_: {"status": "complete"})
    (tmp_path / "curtain").mkdir()
    (tmp_path / "curtain" / "cloth.npz").write_bytes(b"")
    given = ("flags", "--device", "cpu", "--dataset", tmp_path, "--patterns", "curtain", "--rows", "ours,particle")
    bench(*given, "--splats", "made", "--results", tmp_path / "results")
    record = json.loads((tmp_path / "results" / "flags_made_cpu.json").read_text())
    assert record["rows"] == {name: {"curtain": {"status": "complete"}} for name in ("ours", "particle")}
    with pytest.raises(SystemExit, match="curtain has no photos to train a splat from: add `--splats made`"):
        bench(*given, "--results", tmp_path / "results")


def test_a_training_that_is_there_is_kept_with_its_account(tmp_path, monkeypatch):
    """And one that is not is run, and its account written."""
    target = tmp_path / "all_losses"

    def made(command, **_):
        assert f"--trainer.default_root_dir={target}" in command
        target.mkdir()
        (target / "point_cloud.ply").write_bytes(b"ply")

    monkeypatch.setattr(flags.subprocess, "run", made)
    first = flags.train(1, flags.VARIANTS["ours"], tmp_path, target, 7)
    assert first["steps"] == 7
    assert first["seconds"] >= 0
    monkeypatch.setattr(flags.subprocess, "run", lambda *_, **__: pytest.fail("trained again"))
    assert flags.train(1, flags.VARIANTS["ours"], tmp_path, target, 7) == first
    (target / "training.json").unlink()
    assert flags.train(1, flags.VARIANTS["ours"], tmp_path, target, 7) == {"kept": True}


def test_rows_with_trainings_at_the_same_time(tmp_path, monkeypatch):
    """Each splat is trained once; a training that fails leaves its row, and no other."""
    trained, simulated = [], []

    def train(pattern, variant, dataset, target, steps):
        trained.append((pattern, target.name))
        if target.name == "two_views":
            (target.parent / "two_views.log").write_text("ValueError: no photos\n")
            raise flags.subprocess.CalledProcessError(1, "train.py")
        target.mkdir(parents=True)
        (target / "point_cloud.ply").write_bytes(b"ply")
        return {"seconds": 1.0, "steps": steps}

    def run_row(pattern, variant, options, splat, output):
        simulated.append(pattern)
        return {"status": "complete", "splat": str(splat)}

    monkeypatch.setattr(flags, "train", train)
    monkeypatch.setattr(flags, "run_row", run_row)
    monkeypatch.setattr(flags, "tilts", lambda splat, cloth: {"gaussians": 3})
    for pattern in (1, 2):
        (tmp_path / f"pattern{pattern}").mkdir()
        (tmp_path / f"pattern{pattern}" / "cloth.npz").write_bytes(b"")
    given = {"--rows": "ours,neighbours,two_views", "--patterns": "1,2", "--splats": tmp_path / "splats"}
    given |= {"--note": "Quiet.", "--dataset": tmp_path, "--train_steps": 7, "--at_once": 3, "--sims_at_once": 2}
    words = [word for pair in given.items() for word in pair]
    result, saved = measure("flags", *words, result={"rows": {"membrane": {"1": {"status": "complete"}}}})
    assert sorted(trained) == [(1, "all_losses"), (1, "two_views"), (2, "all_losses"), (2, "two_views")]
    assert sorted(simulated) == [1, 1, 2, 2]
    rows = result["rows"]
    assert result["note"] == "Quiet."
    assert rows["membrane"] == {"1": {"status": "complete"}}
    assert rows["two_views"]["2"]["failed"] == "ValueError: no photos"
    assert rows["ours"]["1"]["tilt"] == {"gaussians": 3}
    assert "tilt" not in rows["neighbours"]["1"]
    assert rows["neighbours"]["2"]["training"] == {"seconds": 1.0, "steps": 7, "at_once": 3}
    assert len(saved) == 8


def test_two_view_options_parse_for_any_number_of_images(tmp_path, monkeypatch):
    from gaussian_swaying.cli.train import make_cli

    monkeypatch.chdir(tmp_path)
    given = [f"--config={ROOT}/configs/train/default.yaml", f"--config={ROOT}/configs/bench/train.yaml"]
    cli = make_cli([*given, *filled(flags.GENTLE, 100), "--trainer.accelerator=cpu"], run=False)
    for name in ("geometric", "photometric"):
        term = cli.model.loss.terms[name]
        assert (term.start, term.stop, term.every) == (50, 100, 2)
        assert term.share(50) > 0
    assert cli.model.loss.terms["photometric"].contrast == 0.03
