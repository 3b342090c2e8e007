"""Which tests the gate leaves to the nightly run."""


def is_left(item):
    """Whether a test is marked ``slow``, and is no part of a series that the mark keeps in the gate.

    ``@pytest.mark.slow(gate=["total", "updated"])`` keeps these two parameters, by their ids, of a series.
    """
    slow = item.get_closest_marker("slow")
    return slow is not None and _parameters(item) not in slow.kwargs.get("gate", ())


def _parameters(item):
    return item.callspec.id if hasattr(item, "callspec") else None
