import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_checkout_is_compared_with_itself():
    words = [sys.executable, "tools/bench/speed/turns.py", ".", "."]
    words += ["--runs", "1", "--cases", "flag", "--device", "cpu"]
    lines = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [["cpu", "flag", part] for part in ("start", "frame", "picture")]
    for line in lines[1:]:
        old, new, ratio = map(float, line.split()[-3:])
        assert ratio == pytest.approx(new / old, rel=0.02)


def test_two_checkouts_are_asked_for():
    done = subprocess.run([sys.executable, "tools/bench/speed/turns.py", "."], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "Expected two checkouts" in done.stderr
