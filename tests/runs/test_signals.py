"""Signals that end a run as Ctrl-C does, and the command that goes on."""

import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from gaussian_swaying.cli.errors import command, how_to_resume
from gaussian_swaying.runs.signals import StoppedBySignal, exit_code, reason, stop_signals

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="sends signals to itself"),
    pytest.mark.usefixtures("default_signals"),
]


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_the_first_signal_stops_and_the_second_does_not_disturb(name):
    number, saved = getattr(signal, name), []

    def stopped():
        with stop_signals():
            try:
                os.kill(os.getpid(), number)
            finally:
                os.kill(os.getpid(), signal.SIGTERM)
                os.kill(os.getpid(), signal.SIGHUP)
                saved.append("all")

    with pytest.raises(KeyboardInterrupt) as caught:
        stopped()
    assert saved == ["all"]
    assert isinstance(caught.value, StoppedBySignal)
    assert exit_code(caught.value) == 128 + number
    assert reason(caught.value) == f"stopped by {name}"
    assert exit_code(KeyboardInterrupt()) == 130
    assert signal.getsignal(number) == signal.SIG_DFL


def test_what_is_ignored_stays_ignored_as_under_nohup():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_signals():
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) != signal.SIG_DFL
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_outside_the_main_thread_nothing_is_changed():
    found = []

    def work():
        with stop_signals():
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.SIG_DFL]


def test_the_command_that_goes_on(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["tools/sim.py"])
    said = how_to_resume(Path("outputs/run/checkpoint.pt"), 11, ["--config", "my file.yaml"])
    assert said == (
        "outputs/run/checkpoint.pt contains the run up to frame 11; to continue:\n"
        "  python tools/sim.py --config 'my file.yaml' --resume"
    )
    assert command(["--resume"], "--resume") == "python tools/sim.py --resume"
    monkeypatch.setattr(sys, "argv", ["/usr/bin/sway"])
    given = ["fit", "--ckpt_path", "old", "--ckpt_path=older", "--x", "1"]
    assert command(given, "--ckpt_path", "new", without="--ckpt_path") == "sway fit --x 1 --ckpt_path new"
    assert "to continue" not in how_to_resume(Path("c.pt"), 1, [], diverged=True)
