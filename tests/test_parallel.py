"""Pieces of work side by side: the results of ``map``, and the threads and gradients of the caller."""

import threading

import pytest
import torch

from gaussian_swaying._parallel import in_threads


@pytest.mark.parametrize("threads", [1, 3])
def test_it_is_map(threads):
    before, barrier = torch.get_num_threads(), threading.Barrier(threads)

    def work(number, name):
        if number < threads:  # the first ones meet, so they do run side by side
            barrier.wait(10)
        return name * number, torch.get_num_threads(), torch.is_grad_enabled()

    torch.set_num_threads(threads)
    try:
        with torch.no_grad():
            found = list(in_threads(work, range(5), "abcde", most=4))
        later = []
        thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
        thread.start()
        thread.join()
    finally:
        torch.set_num_threads(before)
    assert found == [(name * number, 1, False) for number, name in enumerate("abcde")]
    assert later == [threads]


def test_one_at_a_time_if_more_need_too_much_memory():
    here = []
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        list(in_threads(lambda _: here.append(threading.current_thread()), range(3), most=0))
    finally:
        torch.set_num_threads(before)
    assert here == [threading.current_thread()] * 3


def test_an_error_is_raised_and_the_threads_are_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(ZeroDivisionError):
            list(in_threads(lambda number: 1 // number, [1, 0], most=2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
