import threading
from contextlib import contextmanager

import torch

from gaussian_swaying.simulation import simulation


def test_each_step_is_done_once_in_a_thread_and_errors_are_left_to_others(monkeypatch):
    done, entered = [], []

    @contextmanager
    def device(number):
        entered.append(number)
        yield

    def step(name):
        def work(*_, **__):
            done.append((name, threading.current_thread().name))
            raise RuntimeError(name)

        return work

    monkeypatch.setattr(torch.cuda, "device", device)
    monkeypatch.setattr(torch, "empty", step("context"))
    monkeypatch.setattr(simulation, "compiles", step("triton"))
    monkeypatch.setattr(simulation, "load_kernels", step("gsplat"))
    for before, steps in (True, ["context", "triton", "gsplat"]), (False, ["context", "triton"]):
        done.clear()
        monkeypatch.setattr(simulation, "loaded_before", lambda before=before: before)
        simulation.load_ahead(torch.device("cuda"))()
        assert done == [(name, "load-ahead") for name in steps]
    assert set(entered) == {0}
    done.clear()
    simulation.load_ahead(torch.device("cpu"))()
    assert done == []
    entered.clear()
    simulation.load_ahead(torch.device("cuda:1"))()
    assert set(entered) == {1}
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 2)
    entered.clear()
    simulation.load_ahead(torch.device("cuda"))()
    assert set(entered) == {2}
