"""A Mac computes on its CPU, whose kernels compile for arm64."""

import llvmlite.binding as binding
import pytest

from gaussian_swaying.kernels import cpu
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Simulation


def test_a_mac_computes_on_its_cpu(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: True)
    simulation = Simulation(FlagScene(spacing=0.1), device="auto", recorder=Recorder(renders=()))
    assert simulation.device.type == "cpu"
    simulation.run(tmp_path / "run", frames=2)


@pytest.mark.parametrize(
    ("triple", "processor", "head"),
    [
        ("arm64-apple-macosx", "apple-m1", bytes.fromhex("cffaedfe0c000001")),  # Mach-O, arm64
        ("aarch64-linux-gnu", "generic", b"\x7fELF\x02\x01"),
    ],
    ids=["mac", "linux"],
)
def test_the_kernels_of_a_run_compile_for_arm64(triple, processor, head, tmp_path, monkeypatch):
    texts, plain = [], cpu._compiled
    monkeypatch.setattr(cpu, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(cpu, "_COMPILED", {})
    monkeypatch.setattr(cpu, "_compiled", lambda text: texts.append(text) or plain(text))
    list(Simulation(FlagScene(spacing=0.1), wind=[3, 0, 0], device="cpu").frames(2))
    assert len(texts) > 5
    assert not any("x86" in text or "target-" in text for text in texts)
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    machine = cpu._machine_for(triple, processor)
    for text in sorted([*texts, cpu._RUN], key=len)[:5]:
        assert plain(text, machine).startswith(head)
