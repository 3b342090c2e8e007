"""The gallery: each scene has its files, a run is pictured, and the page says what was lost."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from bench.cases import gallery
from imageio.v3 import imread

from .conftest import HEAD, ROOT, cells, shown


def test_each_scene_has_its_files():
    for name in gallery.SCENES:
        files = [Path(part) for part in gallery.arguments(name, "preview") if part != "--config"]
        assert all(file.is_file() for file in files), files
        assert len(files) >= (2 if not name.startswith("solid_surface") else 1)
    files = [Path(part) for part in gallery.arguments("sand_to_foam", "preview") if part != "--config"]
    order = [f"{file.parent.name}/{file.stem}" for file in files]
    assert order == ["sim/sand", "preview/sand", "variants/sand_to_foam"]


@pytest.mark.slow(twin="test_a_row_of_a_flag_is_simulated_and_compared")
def test_a_scene_is_run_and_pictured(tmp_path):
    more = "--scene.generator.init_args.spacing=0.05 --solver.dx=0.1 --camera.width=64 --camera.height=36"
    options = SimpleNamespace(preset=None, device="cpu", frames=3, more=more, pictures=tmp_path)
    row = gallery.run_scene("flag2", options)
    assert row["frames"] == 3
    assert row["displacement_share"] == pytest.approx(row["displacement_mean_max_m"] / row["size_m"])
    assert gallery.of_today("flag2", row)
    assert row["size_m"] == pytest.approx(1.2, abs=0.2)
    picture = imread(tmp_path / "gallery_flag2.png")
    assert picture.shape[1] == 5 * 360
    assert picture.max() > 100
    options.more = "--solver.dx=nonsense"
    assert "solver.dx" in gallery.run_scene("flag2", options)["failed"]


def test_whole_means_all_of_it():
    row = {"status": "complete", "frames": 250, "frames_wanted": 250, "lost_particles": 0, "displacement_share": 0.1}
    assert gallery.whole(row)
    changes = {"status": "diverged"}, {"frames": 249}, {"lost_particles": 1}, {"displacement_share": 0.009}
    for change in (*changes, {"displacement_share": 0.51}, {"displacement_share": None}):
        assert not gallery.whole(row | change)
    row |= {"particles": 1000, "formulation": "total", "substeps": 2490, "wall_s": {"simulation": 2.5}}
    row |= {"peak_memory_bytes": {"host": 2**30, "device": None}, "preset": "preview", "process_s": 4.0}
    result = HEAD | {"scenes": {"ficus": row, "sand": {"failed": "x"}}}
    assert cells("gallery.scenes", result)[0][0] == "Ficus \\*, preset `preview`"  # no word of its configuration
    assert "Recorded before" in shown("gallery.scenes", result)[-1]
    row["configuration"] = gallery.fingerprint("ficus", "preview")
    assert row["configuration"] != gallery.fingerprint("ficus", None)
    whole, failed = cells("gallery.scenes", result)
    assert "Recorded before" not in shown("gallery.scenes", result)[-1]
    assert whole[:6] == ["Ficus, preset `preview`", "1,000", "`total`", "250", "10", "10.0"]
    assert whole[6:] == ["4", "1.00", "-", "10.0 %", "yes"]
    assert failed[:2] == ["Sand", "failed: x"]


def test_the_page_shows_each_scene():
    text = (ROOT / "docs/gallery.md").read_text()
    for name, title in gallery.SCENES.items():
        after = text.split(f"### {title}\n", 1)[1]
        assert f"![Five frames of {title}](pictures/gallery_{name}.png)" in after.split("\n#", 1)[0]
        assert (ROOT / f"docs/pictures/gallery_{name}.png").exists()
