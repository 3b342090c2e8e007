import torch

from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.player.painting import MOST_KEPT, Strokes

SOFT, HELD, STILL = Part("soft"), Part("held", "held"), Part("pot", "still")


def _painted(*strokes, count=6):
    made = Strokes(Parts(torch.zeros(count), [SOFT]))
    for part, index, *more in strokes:
        made.paint(part, torch.tensor(index).long(), *more)
    return made


def _labels(strokes):
    parts = strokes.parts()
    return [parts.parts[k].name for k in parts.labels.tolist()]


def test_strokes_give_gaussians_to_parts_and_are_taken_back_one_by_one():
    strokes = _painted((HELD, [1, 2]), (STILL, [2, 3]), (SOFT, [1]))
    assert _labels(strokes) == ["soft", "soft", "pot", "pot", "soft", "soft"]
    assert strokes.parts().parts == (SOFT, HELD, STILL)
    strokes.take_back()
    assert _labels(strokes) == ["soft", "held", "pot", "pot", "soft", "soft"]
    strokes.take_back()
    assert _labels(strokes) == ["soft", "held", "held", "soft", "soft", "soft"]
    assert strokes.known == (SOFT, HELD)  # the part that the stroke brought went, too
    for _ in range(3):
        strokes.take_back()
    assert _labels(strokes) == ["soft"] * 6
    assert strokes.known == (SOFT,)
    assert len(strokes) == 0


def test_the_pieces_of_a_stroke_are_taken_back_together():
    strokes = _painted((STILL, [0]), (HELD, [1, 2], "a", False), (HELD, [2, 3, 0], "a", True))
    assert len(strokes) == 2
    strokes.take_back()
    assert _labels(strokes) == ["pot"] + 5 * ["soft"]
    assert strokes.known == (SOFT, STILL)


def test_a_piece_with_another_part_or_from_another_browser_is_a_stroke_of_its_own():
    for part, mark in ((STILL, "a"), (HELD, "b")):
        strokes = _painted((HELD, [1, 2], "a"), (part, [2, 3], mark, True))
        assert len(strokes) == 2
        strokes.take_back()
        assert _labels(strokes) == ["soft", "held", "held", "soft", "soft", "soft"]
    assert len(_painted((HELD, [1], "a", True))) == 1  # there is nothing to go on from


def test_a_stroke_that_changes_nothing_is_none():
    strokes = _painted((HELD, []), (SOFT, [0, 1]), (HELD, [2]), (HELD, [2]))
    assert len(strokes) == 1
    assert strokes.known == (SOFT, HELD)


def test_roles_follow_the_labels_and_are_another_tensor_each_time():
    strokes = _painted()
    before = strokes.roles
    strokes.paint(STILL, torch.tensor([4]))
    assert [ROLES[k] for k in strokes.roles] == ["soft"] * 4 + ["still", "soft"]
    assert not before.any()
    strokes.take_back()
    assert torch.equal(strokes.roles, before)


def test_only_so_many_strokes_are_kept():
    strokes = _painted(*[(HELD if k % 2 else SOFT, [0]) for k in range(1, MOST_KEPT + 5)])
    assert len(strokes) == MOST_KEPT


def test_the_given_parts_stay_as_they_are():
    given = Parts([0, 0], [SOFT])
    Strokes(given).paint(HELD, torch.tensor([0]))
    assert given.labels.tolist() == [0, 0]
