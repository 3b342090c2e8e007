import json
import math

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from shared import small_network, value_error

from gaussian_swaying.evaluation.compare import compare_run, evaluate, table
from gaussian_swaying.evaluation.reference import surface_points
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance

HEIGHT, WIDTH = 16, 24
POINTS = 2000


@pytest.fixture
def compared(make_run, make_reference):
    def compare(run=None, reference=None, **options):
        return compare_run(make_run(**(run or {})), make_reference(**(reference or {})), **{"points": POINTS} | options)

    return compare


# ---- runs


@pytest.fixture
def network(tmp_path):
    return FrechetVideoDistance(small_network(tmp_path / "network.pt"), clip_length=2, resize=8)


def test_a_run_that_is_the_reference(compared):
    """Pictures are equal, and the Chamfer distance is that of two samples of one surface."""
    found = compared()
    assert found["frames"] == 4
    assert found["mean"]["mse"] == 0.0
    assert found["mean"]["psnr_db"] is None  # JSON has no infinity
    # a point's nearest of n random ones on an area A is 0.5 sqrt(A / n) away on average, a little more at the rim
    expected = 0.5 * math.sqrt(2 / POINTS)
    for distance in (found["mean"]["chamfer_m"], found["sampling_m"]):
        assert distance == pytest.approx(expected, rel=0.1)
    assert found["run_points"] == 2000
    assert found["particles"] == 3000
    assert found["skipped"] == []
    json.dumps(found, allow_nan=False)


def test_a_run_with_known_errors(compared):
    """Particles 0.5 m beside the sheet and pixels that are 5 brighter."""
    found = compared({"above": 0.5, "change": 5}, {"side": 2.0})
    for psnr in (found["mean"]["psnr_db"], found["psnr_of_mean_db"]):
        assert psnr == pytest.approx(-20 * math.log10(5 / 255), abs=1e-3)
    # nearest points are beside by 0.5 sqrt(A / n) = 0.016: sqrt(0.5^2 + 0.016^2) is at most 0.1 % more than 0.5
    for name in ("run_to_reference_m", "reference_to_run_m"):
        assert found["mean"][name] == pytest.approx(0.5, rel=2e-3)
    assert found["chamfer_share"] == pytest.approx(found["mean"]["chamfer_m"] / 2.0)
    assert [row["frame"] for row in found["per_frame"]] == [0, 1, 2, 3]
    chamfer = [row["chamfer_m"] for row in found["per_frame"]]
    assert found["mean"]["chamfer_m"] == pytest.approx(np.mean(chamfer))
    assert found["worst"]["chamfer_m"] == max(chamfer)
    assert found["worst"]["ssim"] == min(row["ssim"] for row in found["per_frame"])


def test_points_without_a_gaussian_are_not_compared(make_run, make_reference):
    run, reference = make_run(), make_reference()
    before = compare_run(run, reference)["mean"]["chamfer_m"]
    arrays = dict(np.load(run / "trajectory.npz"))
    count = len(arrays["position_00000"])
    for name in arrays:
        arrays[name] = np.concatenate([arrays[name], arrays[name] + 100.0])
    np.savez(run / "trajectory.npz", **arrays)
    assert compare_run(run, reference)["mean"]["chamfer_m"] > 10.0
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps(summary | {"simulated_gaussians": count}))
    assert compare_run(run, reference)["mean"]["chamfer_m"] == before
    # further points of large Gaussians lie on the surface too: they count
    fields = {"simulated_gaussians": count, "surface_particles": 2 * count}
    (run / "summary.json").write_text(json.dumps(summary | fields))
    assert compare_run(run, reference)["mean"]["chamfer_m"] > 10.0


def test_the_side_given_holds(compared):
    assert compared(points=100)["chamfer_share"] is None
    found = compared({"name": "other"}, {"name": "another"}, points=100, side=4.0)
    assert found["chamfer_share"] == pytest.approx(found["mean"]["chamfer_m"] / 4)
    assert found["side_m"] == 4.0


def test_scene_units_that_are_not_metres(compared):
    """The reference is in metres from the origin of the scene, whatever a scene unit is."""
    assert compared({"scale": 0.5})["mean"]["chamfer_m"] < 0.02


def test_a_turned_frame(make_run, make_reference):
    turn = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    run = make_run(sim_frame={"origin": [1.0, 2.0, 3.0], "rotation": turn, "metres_per_unit": 1.0})
    with np.load(run / "trajectory.npz") as arrays:
        turned = {n: a @ np.array(turn, np.float32).T if n.startswith("position") else a for n, a in arrays.items()}
    np.savez(run / "trajectory.npz", **turned)
    assert compare_run(run, make_reference(), points=POINTS)["mean"]["chamfer_m"] < 0.02


def test_the_frame_that_a_run_writes_is_understood(compared):
    frame = SimFrame.fit(torch.tensor([[0.0, 1.5, 2.5], [2.0, 2.5, 3.5]]), metres_per_unit=1.0)
    place = {"origin": frame.origin.tolist(), "rotation": frame.rotation.tolist(), "metres_per_unit": 1.0}
    assert compared({"sim_frame": place})["mean"]["chamfer_m"] < 0.02
    with value_error("has no `sim_frame`: run the simulation again"):
        compared({"name": "other", "sim_frame": None}, {"name": "another"})


def test_offsets(make_run, make_reference):
    reference = make_reference(before=2)
    found = compare_run(make_run(), reference, reference_offset=2, points=POINTS)
    assert found["mean"]["mse"] == 0.0
    assert found["mean"]["chamfer_m"] < 0.02
    assert found["per_frame"][0]["reference_frame"] == 2
    found = compare_run(make_run("longer", frames=6), reference, points=POINTS)
    assert found["mean"]["mse"] > 0.01
    later = make_reference("later", frames=4)
    for path in sorted((later / "frames").iterdir())[:1]:
        path.unlink()
    arrays = dict(np.load(later / "cloth.npz"))
    np.savez(later / "cloth.npz", positions=arrays["positions"][1:], faces=arrays["faces"])
    found = compare_run(make_run("whole"), later, reference_offset=-1, points=POINTS)
    assert found["mean"]["mse"] == 0.0
    assert (found["frames"], found["first_frame"], found["first_reference_frame"]) == (3, 1, 0)


def test_pictures_may_lie_in_a_folder_of_the_video(make_run, make_reference):
    reference = make_reference()
    (reference / "video").mkdir()
    (reference / "frames").rename(reference / "video/frames")
    assert compare_run(make_run(), reference, points=100)["mean"]["mse"] == 0.0


def test_pictures_or_surfaces_alone(make_run, make_reference):
    run = make_run()
    found = compare_run(run, make_reference("pictures", cloth=False))
    assert "chamfer_m" not in found["mean"]
    assert found["skipped"][0].startswith("surface: there is no")
    found = compare_run(run, make_reference("surfaces", pictures=False), points=100)
    assert "psnr_db" not in found["mean"]
    assert found["size"] is None
    assert "skipped: ['pictures: " in table(found)


@pytest.mark.gpu
def test_a_gpu_finds_the_same(make_run, make_reference):
    run, reference = make_run(above=0.1, change=5), make_reference()
    found = [compare_run(run, reference, points=POINTS, device=device)["mean"] for device in ("cpu", "cuda")]
    assert found[0] == pytest.approx(found[1], rel=1e-4)


# ---- files


def test_files(make_run, make_reference, tmp_path):
    result = evaluate(make_run(change=5), make_reference(side=2.0), tmp_path / "a/b", points=100)
    assert sorted(path.name for path in (tmp_path / "a/b").iterdir()) == ["comparison.mp4", "eval.json", "eval.md"]
    assert json.loads((tmp_path / "a/b/eval.json").read_text()) == result
    text = (tmp_path / "a/b/eval.md").read_text()
    assert text == table(result)
    assert f"{result['mean']['psnr_db']:.5g}" in text
    assert f"chamfer_share: {result['chamfer_share']}" in text
    video = iio.imread(tmp_path / "a/b/comparison.mp4")
    assert video.shape[0] == 4
    assert video.shape[2] >= 3 * WIDTH
    for name in ("seed", "device", "versions", "size"):
        assert result[name] is not None


def test_the_same_twice(make_run, make_reference, tmp_path):
    run, reference = make_run(), make_reference()
    first = evaluate(run, reference, tmp_path / "out", points=100)
    assert evaluate(run, reference, tmp_path / "out", points=100, video=False) == first
    assert not (tmp_path / "out/comparison.mp4").exists()


def test_nothing_is_left_of_a_comparison_that_fails(make_run, make_reference, tmp_path):
    run, reference = make_run(), make_reference()
    path = run / "frames/00002.png"
    path.write_bytes(path.read_bytes()[:120])  # the header says the right size
    with value_error(r"00002\.png cannot be read"):
        evaluate(run, reference, tmp_path / "a/b")
    assert not (tmp_path / "a").exists()
    with value_error(r"The run folder .*nowhere does not exist"):
        evaluate(tmp_path / "nowhere", reference, tmp_path / "nowhere/eval")
    assert not (tmp_path / "nowhere").exists()


def test_an_output_that_is_a_file(make_run, make_reference, tmp_path):
    (tmp_path / "taken").write_text("")
    with value_error(r"output folder .*taken cannot be written .* --output"):
        evaluate(make_run(), make_reference(), tmp_path / "taken")


# ---- bad input


def _resize(folder):
    for path in (folder / "frames").iterdir():
        iio.imwrite(path, np.zeros((HEIGHT, 2 * WIDTH, 3), np.uint8))


def _one_smaller(folder):
    iio.imwrite(folder / "frames/00002.png", np.zeros((HEIGHT, WIDTH - 1, 3), np.uint8))


def _gap(folder):
    (folder / "frames/00002.png").unlink()


def _foreign(folder):
    (folder / "frames/last.png").write_bytes((folder / "frames/00002.png").read_bytes())


def _transparent(folder):
    iio.imwrite(folder / "frames/00002.png", np.full((HEIGHT, WIDTH, 4), 100, np.uint8))


def _no_summary(folder):
    (folder / "summary.json").unlink()


def _no_trajectory(folder):
    (folder / "trajectory.npz").write_bytes(b"PK")


def _nan(folder):
    arrays = dict(np.load(folder / "trajectory.npz"))
    arrays["position_00002"][7] = np.nan
    np.savez(folder / "trajectory.npz", **arrays)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_resize, r"have 48 x 16 pixels, but those of .*reference 24 x 16: render the run"),
        (_one_smaller, r"00002\.png has 23 x 16 pixels, but the first one 24 x 16"),
        (_gap, r"missing or duplicated between .*00001\.png and 00003\.png"),
        (_foreign, r"Expected the name of .*last\.png to be the number"),
        (_transparent, r"00002\.png has transparent pixels"),
        (_no_summary, r"has no readable summary\.json"),
        (_no_trajectory, r"trajectory\.npz cannot be read as a trajectory"),
        (_nan, r"NaN or infinite at frame 2: compare the frames before with --frames"),
    ],
)
def test_a_bad_run(make_run, make_reference, spoil, message):
    run = make_run()
    spoil(run)
    with value_error(message):
        compare_run(run, make_reference(), points=100)


def test_numbers_of_frames_that_differ(make_run, make_reference):
    run, reference = make_run(frames=4), make_reference(frames=6)
    message = r"differ: there are 4 pictures in .*run and 6 in .*reference, .*surfaces.* with --frames 4"
    with value_error(message):
        compare_run(run, reference)
    assert compare_run(run, reference, frames=4, points=100)["frames"] == 4
    with value_error("only 4 frames can be compared: lower --frames"):
        compare_run(run, reference, frames=5)
    with value_error(r"nothing is left beginning with .* correct --reference-offset"):
        compare_run(run, reference, reference_offset=6)


def test_nothing_to_compare(make_run, make_reference, tmp_path):
    run = make_run()
    with value_error(r"The reference folder .*nowhere does not exist"):
        compare_run(run, tmp_path / "nowhere")
    with value_error(r"Nothing can be compared \(pictures: .*; surface: there is no .*cloth\.npz"):
        compare_run(run, make_reference(cloth=False, pictures=False))


@pytest.mark.parametrize("option", ["points", "frames", "side"])
def test_bad_options(compared, option):
    with value_error(f"Expected `{option}` to be positive"):
        compared(**{option: 0})


def test_the_points_of_a_surface_are_uniform_by_area():
    """A 2 x 1 square and a 0.5 x 1 upright triangle: 2 to 0.25 of the points."""
    vertices = torch.tensor([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [0, 0, 5], [0.5, 0, 5], [0, 0, 6]])
    points = surface_points(vertices, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6]]), 40_000)
    upright = points[:, 2] > 4
    assert float(upright.float().mean()) == pytest.approx(0.25 / 2.25, abs=0.01)
    flat = points[~upright]
    assert flat[:, 2].abs().max() == 0
    counts = torch.histogramdd(flat[:, :2], [4, 2], range=[0.0, 2.0, 0.0, 1.0]).hist
    torch.testing.assert_close(counts / len(flat), torch.full((4, 2), 1 / 8), rtol=0.06, atol=0)
    with value_error("degenerate"):
        surface_points(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]), 5)


def test_fvd_with_its_protocol(make_run, make_reference, network):
    """That of the two videos given at once; equal ones have none."""
    run, reference = make_run(change=5), make_reference()
    found = compare_run(run, reference, points=100, fvd=network)
    again = FrechetVideoDistance(network.weights, clip_length=2, resize=8)
    for folder, real in ((reference, True), (run, False)):
        frames = [torch.from_numpy(iio.imread(path)) for path in sorted((folder / "frames").iterdir())]
        again.update(torch.stack(frames).permute(0, 3, 1, 2) / 255, real=real)
    assert found["fvd"]["fvd"] == pytest.approx(float(again.compute()))
    assert found["fvd"]["fvd"] > 1e-3
    assert found["fvd"]["weights_sha256"] == network.sha256
    assert network.sha256 in table(found)
    # what it saw before is forgotten
    assert compare_run(run, reference, points=100, fvd=network)["fvd"] == found["fvd"]


def test_fvd_without_what_it_needs(make_run, make_reference, network):
    run = make_run()
    with value_error("needs pictures"):
        compare_run(run, make_reference(pictures=False), fvd=network)
    with value_error("Two clips of 2 frames need 3 frames, but 2 are compared"):
        compare_run(run, make_reference("other"), frames=2, fvd=network)
