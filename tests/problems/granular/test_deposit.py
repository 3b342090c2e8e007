"""Run-outs of columns of sand in experiments."""

from bench.problems.granular.deposit import lajeunesse, lube


def test_experiments():
    assert [round(lube(a), 2) for a in (0.5, 1, 2, 3)] == [0.6, 1.2, 2.4, 3.95]
    assert [round(lube(a, planar=False), 2) for a in (0.5, 1, 2, 3)] == [0.62, 1.24, 2.26, 2.77]
    assert [round(lajeunesse(a), 2) for a in (0.5, 1, 2, 3)] == [0.5, 2.0, 2.83, 3.46]
