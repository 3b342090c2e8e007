import importlib
import os
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import call, launch

HERE = Path(__file__).parent


@triton.jit
def _shift(x, by, n, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(x + k, tl.load(x + k, k < n) * 2 + by, k < n)


def _shifted(by=1.0, n=100, block=8):
    x = torch.arange(n, dtype=torch.float32)
    launch(_shift, (-(-n // block),))(x, by, n, BLOCK=block)
    return x


EXPECTED = 2 * torch.arange(100, dtype=torch.float32) + 1


# ---- the cache on disk


def _count_compiled(monkeypatch):
    compiled, plain = [], cpu._compiled
    monkeypatch.setattr(cpu, "_compiled", lambda text: compiled.append(text) or plain(text))
    cpu._crew(cpu.threads(), os.getpid())  # its loop is compiled, too
    compiled.clear()
    return compiled


def test_a_kernel_is_compiled_once(folder, monkeypatch):
    compiled = _count_compiled(monkeypatch)
    for by in (1.0, 2.0, 5):
        assert torch.equal(_shifted(by), EXPECTED - 1 + by)
    assert len(compiled) == 2  # `by` is a floating point number or an integer
    _shifted(block=4)
    assert len(compiled) == 3
    assert len(list(folder.iterdir())) == 3
    monkeypatch.setattr(cpu, "_COMPILED", {})
    assert torch.equal(_shifted(), EXPECTED)
    assert len(compiled) == 3


OWN = """
from gaussian_swaying.kernels.language import tl, triton
import own_numbers
ONE = tl.constexpr(1)

@triton.jit
def _one(x):
    return ONE + 0

@triton.jit
def add(x, FUNCTION: tl.constexpr):
    tl.store(x, tl.load(x) + FUNCTION(x) + own_numbers.number())

def added():
    import torch
    from gaussian_swaying.kernels.launch import launch
    x = torch.zeros(1)
    launch(add, (1,))(x, FUNCTION=_one)
    return float(x)
"""
NUMBERS = """
from gaussian_swaying.kernels.language import triton

@triton.jit
def number():
    return 100
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_kernel.py").write_text(OWN)
    (tmp_path / "own_numbers.py").write_text(NUMBERS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def added():
        for name in ("own_kernel", "own_numbers"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module("own_kernel").added()

    yield added
    for name in ("own_kernel", "own_numbers"):
        sys.modules.pop(name, None)


def test_a_second_process_compiles_nothing(folder, own, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cpu, "_spent", [0, 0.0, 0.0])
    assert cpu.compiled_sentence(0) is None
    assert own() == 101.0
    _shifted()
    count, seconds, busy = cpu.compiled()
    assert count == len(list(folder.iterdir())) == 2
    assert cpu.compiled_sentence(2) is None
    assert cpu.compiled_sentence(1) == f"Compiled 2 kernels for this CPU in {seconds:.1f} s, once (kept in {folder})."
    assert min(seconds, busy) > 0
    assert capsys.readouterr() == ("", "")
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    command = [sys.executable, "-c", f"import sys; sys.path.append({str(tmp_path)!r}); import own_kernel as own"]
    command[-1] += "; print(own.added())"
    given = os.environ | {"GAUSSIAN_SWAYING_CACHE": str(folder)}
    made = subprocess.run(command, env=given, capture_output=True, text=True, check=False)
    assert made.stdout == "101.0\n", made.stderr
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("own_kernel.py", "tl.load(x) +", "tl.load(x) + 10 +", 111.0),
        ("own_kernel.py", "ONE + 0", "ONE + 5", 106.0),
        ("own_kernel.py", "constexpr(1)", "constexpr(2)", 102.0),
        ("own_numbers.py", "100", "200", 201.0),
        ("own_kernel.py", "def added", "# unused\ndef added", 101.0),
        ("own_numbers.py", "@triton", "# unused\n@triton", 101.0),
    ],
    ids=["kernel", "function that is passed", "constant", "function of another file", "host", "comment elsewhere"],
)
def test_a_change_of_the_source_counts(folder, own, tmp_path, file, old, new, expected):
    assert own() == 101.0
    path = tmp_path / file
    path.write_text(path.read_text().replace(old, new))
    assert own() == expected
    assert len(list(folder.iterdir())) == (1 if expected == 101.0 else 2)


def test_a_change_of_the_translator_counts_and_one_of_another_room_does_not(folder, own, tmp_path, monkeypatch):
    package = Path(cpu.__file__).parents[1]
    copy = shutil.copytree(package, tmp_path / "package", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(cpu, "__file__", str(copy / "kernels" / "cpu.py"))
    monkeypatch.setattr(cpu, "_sources", cpu._sources.__wrapped__)
    assert own() == 101.0
    for number, file in [(1, "gaussians/area_triton.py"), (2, "kernels/blocks.py")]:
        with (copy / file).open("a") as text:
            text.write("# a comment\n")
        assert own() == 101.0
        assert len(list(folder.iterdir())) == number


@pytest.mark.parametrize("broken", [b"", b"no object", "cut"], ids=["empty", "text", "cut"])
def test_a_broken_file_is_replaced(folder, broken):
    _shifted()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if broken == "cut" else broken)
    cpu._COMPILED.clear()
    assert torch.equal(_shifted(), EXPECTED)
    assert file.read_bytes() == whole


def test_the_folder_need_not_be_writable(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(cpu, "cache_folder", lambda: tmp_path / "file" / "kernels")
    monkeypatch.setattr(cpu, "_COMPILED", {})
    assert torch.equal(_shifted(), EXPECTED)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"GAUSSIAN_SWAYING_CACHE": "/one", "XDG_CACHE_HOME": "/two"}, "/one"),
        ({"XDG_CACHE_HOME": "/two"}, "/two/gaussian_swaying"),
        ({"HOME": "/three"}, "/three/.cache/gaussian_swaying"),
    ],
)
def test_where_the_folder_is(given, expected, monkeypatch):
    for name in ("GAUSSIAN_SWAYING_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    if "HOME" not in given:  # it is not asked for, and need not be there
        monkeypatch.setattr(Path, "home", lambda: pytest.fail("no home"))
    assert cpu.cache_folder() == Path(expected)


# ---- threads


@triton.jit
def _note_thread(out, turns):
    found = 0.0
    for k in range(turns):
        found += tl.sin(found + k)
    tl.store(out + tl.program_id(0), found)


def test_several_threads_work(use_threads):
    use_threads(3)
    out = torch.zeros(600)
    launch(_note_thread, (600,))(out, 10)
    names = [thread.name for thread in threading.enumerate()]
    assert {"kernels-1", "kernels-2"} <= set(names)
    assert (out == out[0]).all()


@triton.jit
def _neighbours(x, y, n):
    k = tl.program_id(0)
    tl.store(y + k, tl.load(x + k) + tl.load(x + (k + 1) % n))


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_launch_sees_what_the_one_before_has_written(use_threads, number):
    use_threads(number)
    n, turns = 64, 200
    x, y = torch.zeros(2, n, dtype=torch.int64)
    x[0] = 1
    with cpu.recording() as made:
        for _ in range(2):
            launch(_neighbours, (n,))(x, y, n)
            launch(_neighbours, (n,))(y, x, n)
    x.zero_()
    x[0] = 1
    expected = x.clone()
    for _ in range(turns):
        made.replay()
    for _ in range(4 * turns):
        expected = expected + expected.roll(-1)
    assert torch.equal(x, expected)


def test_fewer_programs_than_threads(use_threads):
    use_threads(3)
    assert torch.equal(_shifted(n=8, block=8), EXPECTED[:8])
    x = torch.ones(1)
    launch(_shift, (0,))(x, 1.0, 1, BLOCK=8)
    launch(_shift, (3, 0))(x, 1.0, 1, BLOCK=8)
    assert float(x) == 1.0


def test_launches_from_several_threads_of_python(folder, use_threads):
    use_threads(2)
    found, recorded, start = {}, {}, threading.Barrier(4)

    def work(k):
        start.wait()
        with cpu.recording() as made:
            found[k] = [_shifted(float(k)) for _ in range(5)]
        recorded[k] = [len(part) for part in made.parts]

    crew = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in crew:
        thread.start()
    for thread in crew:
        thread.join()
    for k in range(4):
        assert all(torch.equal(x, EXPECTED - 1 + k) for x in found[k])
    assert recorded == {k: [5] for k in range(4)}
    assert len(list(folder.iterdir())) == 1


FORK = """
import os, sys, warnings
import torch
sys.path.append({here!r})
from test_cpu import _shifted, EXPECTED
warnings.simplefilter("ignore")
torch.set_num_threads(2)
assert torch.equal(_shifted(), EXPECTED)
child = os.fork()
if child == 0:
    same = torch.equal(_shifted(), EXPECTED) and torch.equal(_shifted(2.0, block=4), EXPECTED + 1)
    os._exit(0 if same else 1)
assert os.waitpid(child, 0)[1] == 0
assert torch.equal(_shifted(), EXPECTED)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_process_that_was_forked_has_threads_of_its_own(tmp_path):
    command = [sys.executable, "-c", FORK.format(here=str(HERE))]
    given = os.environ | {"GAUSSIAN_SWAYING_CACHE": str(tmp_path)}
    made = subprocess.run(command, env=given, capture_output=True, text=True, timeout=120, check=False)
    assert made.returncode == 0, made.stderr


# ---- recordings


@triton.jit
def _advance(x, factor):
    tl.store(x, tl.load(x) * factor + 1)


def test_a_recording_is_replayed_in_order():
    x, count = torch.ones(1), torch.zeros(1)
    device = x.device
    with cpu.recording() as made:
        launch(_advance, (1,))(x, 2.0)
        call(lambda: x.mul_(10), device)
        call(lambda: count.add_(1), device)
        launch(_advance, (1,))(x, 3.0)
        launch(_advance, (1,))(x, 1.0)
    assert (float(x), float(count)) == (92.0, 1.0)  # they ran, too
    launch(_advance, (1,))(x, 2.0)
    call(lambda: count.add_(100), device)
    for value in (1.0, 2.0, 5.0):
        x.fill_(value)
        made.replay()
        assert float(x) == (2 * value + 1) * 30 + 2
    assert float(count) == 104.0
    made.reset()
    made.replay()
    assert float(count) == 104.0


def test_a_recording_keeps_its_tensors():
    x = torch.ones(1)
    with cpu.recording() as made:
        own = torch.full((1,), 4.0)
        launch(_add_to, (1,))(x, own)
        address = own.data_ptr()
        del own
    others = [torch.zeros(1) for _ in range(100)]
    assert address not in [other.data_ptr() for other in others]
    made.replay()
    assert float(x) == 9.0


@triton.jit
def _add_to(x, y):
    tl.store(x, tl.load(x) + tl.load(y))


def test_recordings_within_recordings():
    x = torch.zeros(1)
    with cpu.recording() as outer:
        launch(_advance, (1,))(x, 1.0)
        with suppress(RuntimeError), cpu.recording() as inner:
            launch(_advance, (1,))(x, 1.0)
            raise RuntimeError
        launch(_advance, (1,))(x, 1.0)
    assert float(x) == 3.0
    outer.replay()
    assert float(x) == 5.0
    inner.replay()
    assert float(x) == 6.0


# ---- keys


def test_numbers_and_tensors_of_all_types_are_passed():
    for kind in (torch.float32, torch.float64, torch.int32, torch.int64, torch.int8):
        x = torch.full((1,), 5, dtype=kind)
        launch(_advance, (1,))(x, 3)
        assert x.dtype == kind
        assert float(x) == 16
    with pytest.raises(KeyError, match="uint8"):  # its bytes would be read with a sign
        launch(_advance, (1,))(torch.zeros(1, dtype=torch.uint8), 3)
