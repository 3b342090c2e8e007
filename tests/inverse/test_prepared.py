"""Films as a fit takes them: which of them are changed, and what is said of it."""

import pytest
from handheld_films import drift, tripod, write_film
from shared import peak, value_error

from gaussian_swaying.inverse.hand import Judged, prepared
from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.videos import read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")

FRAMES = 7


def test_a_tripod_keeps_its_camera_and_loses_the_drift(room, tmp_path):
    """A camera that is said to move is looked for, though."""
    write_film(room, tmp_path, [tripod(200, 120)] * FRAMES, drift(FRAMES))
    (video,) = read_videos(tmp_path)
    lines = []
    (found,), (judged,) = prepared(room, [video], say=lines.append)
    assert found.cameras is video.cameras
    assert not judged.hand_held
    assert judged.moved < 0.3
    assert judged.gains[0][2] == pytest.approx(0.65, abs=0.05)
    means = found.images.double().mean((1, 2))
    assert peak(means[-1] / means[0] - 1) < 0.05
    assert lines == judged.sentences()
    assert "blue 0.6" in lines[0]
    assert prepared(room, [video], hand_held=True)[1][0].hand_held


def test_many_frames_without_background_make_a_fit_doubtful():
    assert Judged("0", 10, hand_held=True, unseen=2).doubts() == []
    (doubt,) = Judged("0", 10, hand_held=True, unseen=3).doubts()
    assert doubt.startswith("camera 0: 3 of 10 frames show too little")
    (said,) = Judged("0", 10, moved=12.3, hand_held=True, residual=0.3, unseen=3).sentences()
    assert said.endswith("0.30 pixels off; 3 of 10 frames have that of their neighbours.")


def test_the_fit_file(tmp_path):
    file = tmp_path / "fit.yaml"
    lines = "base: [printed_flag]\nvideos: [film]\nunknowns: {wind.speed: [1, 9]}\n"
    file.write_text(lines + "hand_held: true\nalso_moves: tree\n")
    plan = read_plan(file)
    assert plan.hand_held is True
    assert plan.also_moves == ["tree"]
    file.write_text(lines)
    assert read_plan(file).hand_held is None
    file.write_text(lines + "hand_held: maybe\n")
    with pytest.raises(TypeError, match=r"`hand_held` of .*fit\.yaml to be true or false or None, but got 'maybe'"):
        read_plan(file)
    file.write_text(lines + "wind_changes: true\n")
    with value_error(r"`fit\.wind_changes` is gone: use `until`"):
        read_plan(file)
