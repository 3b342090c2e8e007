"""Runs of tools/sim.py in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from bench.record import ROOT


def what_failed(told: str) -> str:
    """The line of a process's last output that names the error."""
    lines = [line for line in told.strip().splitlines() if line.strip()]
    named = [line for line in lines if "rror:" in line]
    return (named or lines or ["no message"])[-1]


def simulate(arguments: list[str], output: Path, device: str, frames: int | None = None) -> dict[str, Any]:
    """Run tools/sim.py as a user would: its summary with ``process_s`` [s], or why it ``failed``.

    A run that diverged (exit code 3) has a summary too.
    """
    command = [sys.executable, str(ROOT / "tools" / "sim.py"), *arguments, "--device", device, "--output", str(output)]
    command += [f"--frames={frames}"] if frames else []
    begin = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    if done.returncode not in (0, 3) or not (output / "summary.json").exists():
        return {"failed": what_failed(done.stderr)}
    return json.loads((output / "summary.json").read_text()) | {"process_s": seconds}
