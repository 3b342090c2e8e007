import os

import pytest

from gaussian_swaying.kernels.triton_key import remember_key, remembered


def test_it_is_computed_again_only_if_a_file_has_changed(tmp_path, monkeypatch):
    monkeypatch.setenv("GAUSSIAN_SWAYING_CACHE", str(tmp_path / "cache"))
    root = tmp_path / "triton"
    (root / "_C").mkdir(parents=True)
    (root / "language").mkdir()
    library, module = root / "_C" / "libtriton.so", root / "language" / "core.py"
    library.write_bytes(b"library")
    module.write_text("a = 1")
    computed = []

    def key():
        computed.append(None)
        return f"key {len(computed)}"

    assert [remembered(key, root) for _ in range(3)] == ["key 1"] * 3
    library.write_bytes(b"library 2")
    assert remembered(key, root) == "key 2"
    os.utime(module, ns=(1, 1))
    assert remembered(key, root) == "key 3"
    (root / "language" / "more.py").touch()
    assert [remembered(key, root) for _ in range(2)] == ["key 4"] * 2


def test_a_folder_that_cannot_be_written_to_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "cache").touch()
    monkeypatch.setenv("GAUSSIAN_SWAYING_CACHE", str(tmp_path / "cache"))
    assert [remembered(lambda: "key", tmp_path) for _ in range(2)] == ["key", "key"]


def test_triton_names_its_files_with_it(tmp_path, monkeypatch):
    pytest.importorskip("triton")
    from triton.runtime import cache

    monkeypatch.setenv("GAUSSIAN_SWAYING_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "triton_key", lambda: "the key of Triton")
    remember_key()
    monkeypatch.setattr(cache, "triton_key", cache.triton_key)

    class Part:
        def hash(self):
            return "part"

    assert cache.get_cache_key(Part(), Part(), Part(), {}).startswith("the key of Triton-part")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["the key of Triton"]
