"""Thousands of malformed inputs, faults and extremes: each ends well, in one sentence, or shows that it takes long."""

import os
import re
import resource
import sys
import tempfile
import traceback
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest
from cases import SERIES, case

GIGABYTE = 1 << 30
SECONDS = 30  # of the processor
GOOD = ("ran", "refused", "slow, but told")


@pytest.fixture(scope="module")
def commands():
    import torch

    from gaussian_swaying.captures.capture import read_capture
    from gaussian_swaying.cli import evaluate, export, preview, train
    from gaussian_swaying.cli.errors import run_command
    from gaussian_swaying.cli.simulate import main
    from gaussian_swaying.simulation.simulation import Simulation

    torch.set_num_threads(1)
    Simulation.parser()  # imports what it needs

    def look(arguments):
        return run_command(lambda: [view.load() for view in read_capture(arguments[0]).views] and None)

    tools = {"eval": evaluate.main, "export": export.main, "preview": preview.main, "train": train.main}
    return {"sim": main, "look": look, **tools}


def _child(command, arguments, folder, said, largest, seconds):
    code = 99
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(said, 2)
        os.close(said)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        if largest:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        try:
            code = command(arguments) or 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stderr.flush()
        os._exit(code)


def verdict(commands, make, largest=0, seconds=SECONDS):
    with tempfile.TemporaryDirectory(prefix="series-") as name:
        (Path(name) / "input").mkdir()
        command, *arguments = make(Path(name) / "input")
        size = sum(path.stat().st_size for path in Path(name).rglob("*") if path.is_file())
        reading, writing = os.pipe()  # a file would be cut by `largest` too
        child = os.fork()
        if child == 0:
            os.close(reading)
            _child(commands[command], arguments, name, writing, largest, seconds)
        os.close(writing)
        with os.fdopen(reading, "rb") as stream:
            said = stream.read().decode(errors="replace")
        _, status, used = os.wait4(child, 0)
    told = re.search(r"left in this frame|\[[^\]]*<\d[^\]]*frame", said)
    sentences = [line for line in said.splitlines() if "error: " in line]  # how to go on may follow it
    if used.ru_maxrss * 1024 > 2 * GIGABYTE + 10 * size:  # of which the libraries have one
        kind = "memory"
    elif not os.WIFEXITED(status):
        kind = "slow, but told" if told else "hang"
    elif "Traceback (most recent call last)" in said or os.WEXITSTATUS(status) == 99:
        kind = "traceback"
    else:
        one = "refused" if len(sentences) == 1 else "no sentence"
        kind = {0: "ran", 1: "bug", 2: one}.get(os.WEXITSTATUS(status), "killed")
    return kind, said[-500:]


@pytest.mark.parametrize("share", [0.0, pytest.param(1.0, marks=[pytest.mark.slow, pytest.mark.timeout(4 * 3600)])])
@pytest.mark.parametrize("name", SERIES)
def test_no_traceback_no_hang_and_no_gigabytes(name, share, commands):
    found = [verdict(commands, *case(name, number)) for number in range(max(int(share * SERIES[name][1]), 5))]
    assert [(number, *one) for number, one in enumerate(found) if one[0] not in GOOD] == []
    assert Counter(kind for kind, _ in found)["refused"] > 0


def test_verdicts():
    def say(text, code):
        return lambda arguments: print(text, file=sys.stderr) or code

    def hang(arguments):
        while True:
            pass

    def hog(arguments):
        held = bytearray(2 * GIGABYTE)
        held[::4096] = b"x" * len(held[::4096])

    commands = {"hang": hang, "memory": hog, "traceback": lambda arguments: {}["x"], "bug": say("error: KeyError", 1)}
    commands |= {"no sentence": say("no", 2), "refused": say("error: no such file.", 2), "ran": say("", 0)}
    seconds = {"hang": 1}
    kinds = {
        name: verdict(commands, lambda folder, name=name: [name], seconds=seconds.get(name, SECONDS))[0]
        for name in commands
    }
    assert kinds == {name: name for name in commands}
