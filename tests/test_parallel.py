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
            found = list(in_threads(work, range(5), "abcde", threads=threads))
        later = []
        thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
        thread.start()
        thread.join()
    finally:
        torch.set_num_threads(before)
    assert found == [(name * number, 1, False) for number, name in enumerate("abcde")]
    assert later == [threads]


def test_the_caller_does_the_work_alone_if_no_more_threads_are_wanted():
    here = []
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        list(in_threads(lambda _: here.append(threading.current_thread()), range(3), threads=0))
    finally:
        torch.set_num_threads(before)
    assert here == [threading.current_thread()] * 3


def test_an_error_is_raised_and_the_threads_are_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(ZeroDivisionError):
            list(in_threads(lambda number: 1 // number, [1, 0], threads=2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_no_more_is_done_than_a_few_pieces_ahead():
    """Results that nobody has taken yet fill the memory."""
    done = []
    found = in_threads(done.append, range(50), threads=2)
    next(found)
    found.close()
    assert len(done) < 10


def test_threads_have_the_inference_mode_of_the_caller():
    with torch.inference_mode():
        assert list(in_threads(lambda _: torch.is_inference_mode_enabled(), range(3), threads=2)) == [True] * 3
    assert list(in_threads(lambda _: torch.is_inference_mode_enabled(), range(3), threads=2)) == [False] * 3
