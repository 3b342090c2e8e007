"""What a GPU needs is loaded in a thread, while the scene is made."""

import threading

import torch

from gaussian_swaying.simulation import ahead


def test_each_step_is_done_once_in_a_thread_and_errors_are_left_to_others(monkeypatch):
    done = []

    def step(name):
        def work(*_, **__):
            done.append((name, threading.current_thread().name))
            raise RuntimeError(name)

        return work

    monkeypatch.setattr(torch, "empty", step("context"))
    monkeypatch.setattr(ahead, "compiles", step("triton"))
    monkeypatch.setattr(ahead, "load_kernels", step("gsplat"))
    for before, steps in (True, ["context", "triton", "gsplat"]), (False, ["context", "triton"]):
        done.clear()
        monkeypatch.setattr(ahead, "loaded_before", lambda before=before: before)
        ahead.load_ahead(torch.device("cuda"))()
        assert done == [(name, "load-ahead") for name in steps]
    done.clear()
    ahead.load_ahead(torch.device("cpu"))()
    assert done == []
