"""``gaussian-swaying warm``."""

import pytest
import torch

from gaussian_swaying.cli import shipped, warm


def test_on_a_cpu_there_is_nothing_to_compile(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert warm.main([]) == 0
    assert "no CUDA device" in capsys.readouterr().out


def test_an_unknown_configuration_is_refused_before_anything_is_compiled(capsys):
    assert warm.main(["flag", "flga"]) == 2
    said = capsys.readouterr()
    assert "did you mean flag?" in said.err
    assert said.out == ""


def test_by_default_every_scene_that_needs_no_splat():
    names = warm.without_splat()
    assert {"flag", "ficus", "sand", "telephone"} <= set(names)
    assert "hanging_object" not in names
    assert set(names) < set(shipped.names("sim"))


def test_the_caches_are_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "t"))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "e"))
    triton, gsplat = warm.caches().values()
    assert triton == tmp_path / "t"
    assert tmp_path / "e" in gsplat.parents


@pytest.mark.gpu
def test_kernels_of_a_scene_are_compiled(capsys):
    assert warm.main(["flag"]) == 0
    said = capsys.readouterr().out
    assert "flag: " in said
    assert "gsplat's kernels: " in said
    assert any(folder.exists() for folder in warm.caches().values())
