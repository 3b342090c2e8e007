"""What ``bench.py gradients`` measures: the memory of gradients through long rollouts, and examples/fit_flag.py."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import Case, Measurement
from bench.record import ROOT, Row

ROLLOUTS = ((50, 0), (500, 0), (500, 22), (2000, 45))
"""Number of substeps, and the interval at which states are kept (0: all are kept)."""


def _memory(*words: object) -> Row:
    command = [sys.executable, "-m", "bench.cases.gradient_memory", *map(str, words)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT / "tools")
    return json.loads(done.stdout)


def _fit() -> Row:
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "fit.json"
        subprocess.run([sys.executable, str(ROOT / "examples" / "fit_flag.py"), "--json", str(path)], check=False)
        return json.loads(path.read_text())


def rows(_: argparse.Namespace, __: Row) -> Iterator[Measurement]:
    """The memory of each rollout, and the fit."""
    for formulation in ("total", "updated"):
        for steps, checkpoint in ROLLOUTS:
            known = {"formulation": formulation, "substeps": steps, "checkpoint": checkpoint}
            yield ("memory", known), partial(_memory, formulation, steps, checkpoint)
    yield ("fit",), _fit


CASE = Case(
    "Measure the memory of gradients through long rollouts, and fit a flag.",
    rows,
    page="validation.md",
    device=False,
    keeps="none",
)
