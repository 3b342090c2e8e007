"""``bench.py drawn`` measures a browser that draws the live page."""

import pytest
from bench.cases import drawn

from .conftest import shown


@pytest.mark.usefixtures("chromium")
def test_messages_times_and_pictures_of_a_scene(request, monkeypatch):
    pytest.importorskip("viser", reason="needs the extra [viewer]")
    monkeypatch.setattr(drawn, "WARM", 4.0)
    flag = ["--config", str(request.config.rootpath / "configs/sim/flag.yaml"), "--device=cpu", "--solver.dx=0.1"]
    row = drawn.scene_of([*flag, "--scene.generator.init_args.spacing=0.05"], 3.0)
    assert row["gaussians"] == 384
    assert 6 * row["nodes"] < row["state_bytes"] < 22 * row["nodes"] + 200
    # a Gaussian and the number of its stencil; and stencils of 27 numbers, of which a sheet has one for three nodes
    each = 54 * row["gaussians"]
    assert each < row["scene_bytes"] < each + 27 * 4 * row["nodes"] / 3 + 4000
    assert row["jpeg_bytes"] > 1000
    assert row["state_ms"] > 0
    assert row["jpeg_ms"] > 0
    assert row["pictures_per_s"] > 0
    assert row["steps_per_s"] > 0
    table = shown(
        "drawn.scenes", {"scenes": {"flag": row}, "device": "a CPU", "versions": {"torch": "2", "gsplat": "1"}}
    )
    assert any(line.startswith("| flag | 384 | ") for line in table)
