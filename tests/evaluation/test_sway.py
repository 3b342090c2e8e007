import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import value_error

from gaussian_swaying.evaluation.sway import sway_score

TIMES = np.arange(250) * 0.04
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rest():
    """A pole of 2 m, whose lowest tenth is still in the motions below."""
    draw = np.random.default_rng(0).random((3000, 3))
    return (draw - [0.5, 0.5, 0]) * [0.1, 0.1, 2]


def bent(rest, *, x=0.0, y=0.0):
    """Displacements of a pole that turns at 0.2 m by an angle whose tip moves by ``x`` and ``y`` (T,) [m]."""
    share = np.clip(rest[:, 2] - 0.2, 0, None) / 1.8
    tip = np.stack(np.broadcast_arrays(x, y, np.zeros_like(TIMES)), axis=-1)
    return share[:, None] * tip[:, None]


def sine(hertz, phase=0.0):
    return np.sin(2 * np.pi * hertz * TIMES + phase)


def test_a_pole_that_rocks(rest):
    """The upper tenth is at shares of 0.9 to 1 of the tip; the side is that of the moving 0.38 m to 2 m."""
    score = sway_score(rest, bent(rest, x=0.3 + 0.1 * sine(1.5)), TIMES)
    side, share = 0.98 * (2 - (0.2 + 0.1 * 1.8)), 0.955
    assert score.side == pytest.approx(side, rel=0.02)
    assert score.moving_share == pytest.approx(0.81, abs=0.03)
    assert score.lean == pytest.approx(0.3 * share / side, rel=0.02)
    assert score.sway == pytest.approx(0.1 / math.sqrt(2) * share / side, rel=0.02)
    assert score.ratio == pytest.approx(1 / (3 * math.sqrt(2)), rel=0.02)
    assert score.peak == pytest.approx(1.5, abs=1 / (4 * 8))
    assert score.peak_share > 0.98
    assert score.cross < 1e-6
    assert score.drift < 0.03
    assert 0 <= score.stiller < 0.02


def test_tensors_give_the_same_score(rest):
    moved = bent(rest, x=0.3 + 0.1 * sine(1.5))
    as_tensors = sway_score(*(torch.from_numpy(values) for values in (rest, moved, TIMES)))
    assert as_tensors == pytest.approx(sway_score(rest, moved, TIMES), nan_ok=True)


def test_the_score_does_not_depend_on_units_or_axes(rest):
    moved = bent(rest, x=0.3 + 0.1 * sine(1.5), y=0.04 * sine(0.9))
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0][[2, 0, 1]]
    plain, other = sway_score(rest, moved, TIMES), sway_score(7 * rest, 7 * moved @ turned, TIMES)
    for name in ("peak", "peak_share", "ratio", "drift", "cross", "moving_share"):
        assert getattr(other, name) == pytest.approx(getattr(plain, name), rel=1e-6), name
    assert other.lean * other.side == pytest.approx(7 * plain.lean * plain.side)


def test_the_tip_goes_round_an_ellipse(rest):
    score = sway_score(rest, bent(rest, x=0.2 + 0.1 * sine(1), y=0.05 * sine(1, np.pi / 2)), TIMES)
    assert score.cross == pytest.approx(0.5, abs=0.01)


def test_what_creeps_drifts(rest):
    """From 2 s to 10 s the mean of the halves is that at 4 s and 8 s: 4 / 6 of the mean at 6 s."""
    creeping = sway_score(rest, bent(rest, x=0.05 * TIMES), TIMES)
    assert creeping.drift == pytest.approx(4 / 6, rel=0.01)
    assert sway_score(rest, bent(rest, x=0.2 + 0 * TIMES), TIMES).drift < 1e-9


def test_what_stands_still_has_no_score(rest):
    score = sway_score(rest, np.zeros((250, *rest.shape)), TIMES)
    assert (score.lean, score.sway, score.moving_share) == (0, 0, 0)
    assert math.isnan(score.peak)


@pytest.mark.parametrize(
    ("frames", "times", "says"),
    [
        (250, TIMES[:200], r"but got shapes \(3000, 3\), \(250, 3000, 3\) and \(200,\)"),
        (55, TIMES[:55], r"Expected at least 8 frames from `skip` = 2 s on, but got 5"),
        (250, TIMES**2, "Expected `times` that increase evenly"),
    ],
)
def test_input_that_does_not_fit(rest, frames, times, says):
    with value_error(says):
        sway_score(rest, bent(rest, x=0.1 * sine(1))[:frames], times)


# ---- the command


def test_the_tool_scores_a_configuration(tmp_path):
    text = """
scene: {generator: {class_path: FlagScene, init_args: {width: 0.4, height: 0.3, spacing: 0.05}}}
solver:
  dx: 0.1
  boundaries:
    - class_path: PinnedRegion
      init_args: {region: {class_path: Box, init_args: {min: [null, null, null], max: [0.06, null, null]}}}
material: {E: 3000.0, density: 30.0}
camera: {class_path: OrbitCamera, init_args: {width: 48, height: 32}}
device: cpu
"""
    (tmp_path / "flag.yaml").write_text(text)
    command = [sys.executable, ROOT / "tools/sway.py", tmp_path / "flag.yaml", "--frames", "60"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    score = json.loads(done.stdout)
    assert 0.2 < score["side"] < 0.4
    assert score["ratio"] > 0
