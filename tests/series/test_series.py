"""Malformed inputs, faults and extremes: a sample of the series, and all of it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def series(*options):
    """Exit code and what was printed of a run of the series in a process of its own, as it forks."""
    command = [sys.executable, str(HERE / "run.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "TRITON_INTERPRET": "0"})
    return done.returncode, done.stdout, done.stderr


def counts(printed):
    """The last table as a dictionary of rows."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed.splitlines() if line[:1] == "|"]
    head = max(index for index, row in enumerate(rows) if row[0] == "series")
    return {row[0]: dict(zip(rows[head][1:], row[1:], strict=True)) for row in rows[head + 2 :]}


def test_a_sample():
    """Some cases of each series but that of run folders: no traceback, no hang, no gigabytes."""
    code, printed, said = series(
        "--series", "ply", "splat", "yaml", "capture", "fault", "extreme", "--count", "5", "--workers", "1"
    )
    assert code == 0, printed + said[-2000:]
    found = counts(printed)
    assert found["all"]["cases"] == "30"
    assert sum(int(found["all"][kind]) for kind in ("ran", "refused", "slow, but told")) == 30
    assert int(found["all"]["refused"]) > 5


def test_verdicts(monkeypatch):
    """The sandbox finds what it is for: a traceback, a hang, a hog, a bug and an exit code without a sentence."""
    program = """
import sys, time
sys.path.insert(0, sys.argv[1])
from sandbox import Case, try_case

def hang(arguments):
    while True:
        pass

def hog(arguments):
    held = bytearray(5 << 28)
    held[:: 4096] = b"x" * len(held[:: 4096])
    time.sleep(9)

def crash(arguments):
    raise KeyError("x")

def say(text, code):
    def command(arguments):
        print(text, file=sys.stderr)
        return code
    return command

commands = {"hang": hang, "hog": hog, "crash": crash, "bug": say("error: KeyError", 1), "mute": say("no", 2),
    "refused": say("error: no such file.", 2), "ran": say("", 0)}
for name in commands:
    seconds = 1.0 if name == "hang" else 20.0
    print(name, try_case(Case("x", name, name, lambda folder: []), commands, seconds).kind)
"""
    done = subprocess.run([sys.executable, "-c", program, str(HERE)], capture_output=True, text=True)
    kinds = dict(re.findall(r"^(\w+) (.+)$", done.stdout, re.MULTILINE))
    assert kinds == {
        "hang": "hang",
        "hog": "memory",
        "crash": "traceback",
        "bug": "bug",
        "mute": "no sentence",
        "refused": "refused",
        "ran": "ran",
    }, done.stderr


@pytest.mark.slow(twin="test_a_sample")
@pytest.mark.timeout(4 * 3600)
def test_the_whole_series():
    code, printed, said = series()
    print(printed)
    assert code == 0, printed[-20_000:] + said[-2000:]
    assert int(counts(printed)["all"]["cases"]) == 4200
