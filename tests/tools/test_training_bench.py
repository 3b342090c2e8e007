"""The page of the training benchmark says what the JSON says."""

import threading
from pathlib import Path
from types import SimpleNamespace

from bench.cases import training

from .conftest import HEAD, cells, measure, shown

DOCS = Path(__file__).resolve().parents[2] / "docs"


def _row(**values):
    base = {"psnr_db": 25.0, "ssim": 0.8, "gaussians": 1000, "seconds": 40.0, "memory_bytes": 2**29, "steps": 7000}
    return base | values


def test_goals_are_judged_from_the_medians():
    pair = {
        "bare": [_row(), _row(seconds=44.0), _row(seconds=39.0, psnr_db=25.2)],
        "lightning": [_row(seconds=42.0, psnr_db=24.95), _row(seconds=41.0, psnr_db=24.8), _row(seconds=60.0)],
    }

    def goals():
        return [row[1:] for row in cells("training.goals", HEAD | {"pair": pair, "variants": variants})]

    variants = {}
    assert goals() == [["-0.05 dB", "yes"], ["1.05 times", "yes"], ["1.05 times", "no"], ["0.50 GiB", "yes"]]
    pair["lightning"] = [_row(seconds=44.1, psnr_db=24.89, memory_bytes=2**31)]
    assert [reached for _, reached in goals()] == ["no", "no", "no", "no"]
    variants |= {"mcmc": _row(psnr_db=25.4), "absgrad": {"failed": "x"}, "surface": _row(psnr_db=24.0)}
    best = ["+0.40 dB (MCMC, 300,000 Gaussians)", "yes"]
    assert goals()[4] == best
    variants["degree_1"] = _row(psnr_db=29.0, runs_per_device=2)  # under other conditions
    assert goals()[4] == best
    pair["bare"].append(_row(psnr_db=24.5))  # the runs of the bare loop differ by more than that
    assert goals()[4][1] == "no"


def test_the_page_shows_every_row_that_did_not_fail():
    shares = dict.fromkeys(("round_share", "decided_share", "small_share"), 0.9)
    quality = shares | dict.fromkeys(
        ("angle_median_deg", "angle_p90_deg", "area_paper_ratio", "area_coverage_ratio"), 4
    )
    quality |= {"distance_median_m": 1e-3, "distance_p90_m": 2e-3}
    flag = {"flag:size": _row(**quality, steps=30_000), "flag:none": {"failed": "x"}}
    pair = {"bare": [_row(psnr_db=24.0), _row(psnr_db=24.4)], "lightning": []}
    variants = {"surface": {"failed": "x"}, "degree_1": _row(psnr_db=24.1), "mcmc": _row()}
    result = HEAD | {"flag": flag, "pair": pair, "variants": variants}
    assert shown("training.spread", result, "bare") == "0.40 dB"
    assert shown("training.gains", result) == ["- +0.80 dB MCMC, 300,000 Gaussians", "- -0.10 dB harmonics of degree 1"]
    assert [row[0] for row in cells("training.flag", result)] == ["+ size (all)"]
    assert ["all surface losses, paper's weights", "failed: x"] in [
        row[:2] for row in cells("training.capture", result)
    ]
    assert ["flag, all losses: PSNR of at least 35 dB", "25.0 dB", "no"] in cells("training.goals", result)


def test_the_recipe_is_measured_with_its_own_number_of_images(tmp_path, monkeypatch):
    asked = []

    def run(config, more, steps, folder, look):
        asked.append((config, more, steps))
        return {"psnr_db": 26.0, "seconds": 3.0, "seconds_with_files": 4.0, "memory_bytes": None}

    monkeypatch.setattr(training, "lightning_run", run)
    assert training.photos_run("fox", tmp_path, None) == {"psnr_db": 26.0}
    assert asked == [("photos_cpu", ["--data.init_args.path=fox"], 1000)]


def test_the_page_has_a_picture_of_each_row():
    text = (DOCS / "training.md").read_text()
    for name, (title, _) in training.FLAG_ROWS.items():
        assert f"![{title}](pictures/training_flag_{name}.png)" in text


def test_every_run_is_a_command_line_that_parses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def of(config, more):
        words = [*training._arguments(config, more, 10, tmp_path), "--trainer.accelerator=cpu"]
        return training.make_cli(words, run=False)

    for name, (_, more) in training.FOX_VARIANTS.items():
        cli = of("fox", more)
        surface = [cli.model.loss.weights[term] for term in ("anisotropy", "entropy", "size")]
        assert surface == ([10.0, 0.01, 0.01] if name == "surface" else [0.0, 0.0, 0.0])
    for place, name in enumerate(training.FLAG_ROWS):
        more = training.flag_options(name)
        cli = of("flag", more)
        used = set(cli.model.loss.terms) - {"rgb"}
        assert len(used) == min(place, 3)
        assert cli.model.densification.stop == (5000 if name == "settled" else 15_000)


def test_runs_are_spread_over_the_gpus(tmp_path, monkeypatch):
    """Each process sees one of those that the parent sees."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    monkeypatch.setattr(training.torch.cuda, "device_count", lambda: 2)
    seen, together = [], threading.Barrier(4, timeout=20)

    def run(command, env, **_):
        together.wait()  # all four go on at once
        seen.append(env["CUDA_VISIBLE_DEVICES"])
        Path(command[6]).write_text("{}")
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(training.subprocess, "run", run)
    jobs = [(name, "nowhere", 3, None) for name in ("a", "b", "c", "d")]
    found = [work() for _, work in training.run_apart("variants", jobs, tmp_path, 4)]
    assert sorted(seen) == ["3", "3", "5", "5"]
    assert [row["runs_per_device"] for row in found] == [2, 2, 2, 2]


def test_a_run_of_its_own_fails_with_its_message(tmp_path):
    result, _ = measure("train", "--capture", tmp_path / "none", "--only", "variants", "--variants", "surface")
    assert "does not exist" in result["variants"]["surface"]["failed"]
