"""One thread does what is asked, in order."""

import threading

from browsers import until

from gaussian_swaying.viewer.screen import Turns


def test_what_is_asked_is_done_in_order_and_of_the_same_only_the_last():
    done, failed, begun, go_on = [], [], threading.Event(), threading.Event()
    turns = Turns(lambda: None, 0.01, failed.append)

    def wait():
        begun.set()
        go_on.wait(10)

    turns.ask("wait", wait)
    begun.wait(10)
    for k in range(5):
        turns.ask("slider", lambda k=k: done.append(("slider", k, threading.current_thread().name)))
        turns.ask("button", lambda k=k: done.append(("button", k, threading.current_thread().name)))
    go_on.set()
    until(lambda: len(done) == 2)
    assert done == [("slider", 4, "turns"), ("button", 4, "turns")]
    turns.ask("bad", lambda: 1 / 0)
    turns.ask("good", lambda: done.append("good"))
    until(lambda: done[-1] == "good")
    assert [type(error) for error in failed] == [ZeroDivisionError]
    turns.close()
    turns.ask("late", lambda: done.append("late"))  # its thread has ended
    assert done[-1] == "good"


def test_something_is_done_regularly_however_much_is_asked():
    times = []
    turns = Turns(lambda: times.append(1), 0.02, print)
    until(lambda: turns.ask("busy", lambda: None) or len(times) >= 5)
    turns.close()
