"""What ``bench.py gradients`` measures: the memory of gradients through long rollouts, and tools/fit_flag.py."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from bench import record

ROLLOUTS = ((50, 0), (500, 0), (500, 22), (2000, 45))
"""Number of substeps, and the interval at which states are kept (0: all are kept)."""


def run(options: argparse.Namespace) -> None:
    """Measure the memory of gradients through long rollouts, and fit a flag."""
    folder = Path(options.results)
    _, result = record.start("cpu")
    result["memory"] = []
    for formulation in ("total", "updated"):
        for steps, checkpoint in ROLLOUTS:
            command = [sys.executable, "-m", "bench.cases.gradient_memory", formulation]
            words = [*command, str(steps), str(checkpoint)]
            done = subprocess.run(words, check=True, capture_output=True, text=True, cwd=record.ROOT / "tools")
            result["memory"].append(json.loads(done.stdout))
            print(result["memory"][-1], flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "fit.json"
        fit = [sys.executable, str(record.ROOT / "tools" / "fit_flag.py"), "--json", str(path)]
        subprocess.run(fit, check=False)
        result["fit"] = json.loads(path.read_text())
    record.write(folder, "gradients_cpu", result)
