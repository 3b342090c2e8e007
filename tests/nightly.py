"""Which tests the gate leaves to the nightly run."""


def is_left(item):
    """Whether a test is marked ``slow``, and is no part of a series that the mark keeps in the gate.

    ``@pytest.mark.slow(gate=["total", "updated"])`` keeps these two parameters, by their ids, of a series. A test that
    is left as a whole names another one, of any file, that stands for it: ``@pytest.mark.slow(twin="test_...")``.
    """
    slow = item.get_closest_marker("slow")
    return slow is not None and _parameters(item) not in slow.kwargs.get("gate", ())


def without_a_twin(items):
    """Names of what is left although nothing in the gate stands for it, and ids of a `gate` that are no parameters."""
    left, gate, unknown = {}, set(), set()
    for item in items:
        slow, name = item.get_closest_marker("slow"), item.originalname
        own = (item.path, name)
        if slow is not None:
            unknown |= {f"{name}[{known}]" for known in slow.kwargs.get("gate", ())}
        if is_left(item):
            left.setdefault(own, slow.kwargs.get("twin"))
        elif item.get_closest_marker("gpu") is None:
            gate |= {own, name}
    unknown -= {f"{item.originalname}[{_parameters(item)}]" for item in items}
    return [own[1] for own, twin in left.items() if not {own, twin} & gate] + sorted(unknown)


def _parameters(item):
    return item.callspec.id if hasattr(item, "callspec") else None
