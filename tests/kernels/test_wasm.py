import subprocess
from functools import partial

import pytest
import torch

from gaussian_swaying.kernels import cpu, wasm
from gaussian_swaying.kernels.blocks import TranslationError
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import launch, narrowed
from gaussian_swaying.kernels.wgsl import shaders
from gaussian_swaying.simulation.simulation import Simulation

# Runs each module that Node.js knows on the image, and writes the memory after it beside the module.
RUN = """
import { existsSync, readFileSync, writeFileSync } from "node:fs";
const [folder, start] = process.argv.slice(1);
const image = readFileSync(folder + "/image");
const libm = { sinf: Math.sin, cosf: Math.cos };
for (let k = 0; existsSync(`${folder}/${k}.wasm`); k++) {
  const bytes = readFileSync(`${folder}/${k}.wasm`);
  if (!WebAssembly.validate(bytes)) continue;
  const memory = new WebAssembly.Memory({ initial: Math.ceil((Number(start) + image.length) / 65536) });
  const stack = new WebAssembly.Global({ value: "i32", mutable: true }, Number(start));
  const { exports } = new WebAssembly.Instance(new WebAssembly.Module(bytes), {
    env: { __linear_memory: memory, __stack_pointer: stack, ...libm },
  });
  const whole = new Uint8Array(memory.buffer);
  whole.set(image, Number(start));
  for (const name in exports) exports[name]();
  writeFileSync(`${folder}/${k}.out`, whole);
}
"""


@pytest.fixture
def in_node(node, tmp_path):
    """Runs an image: its tensors by name after that, once for each module that Node.js knows."""

    def run(image, **tensors):
        (tmp_path / "image").write_bytes(image.memory)
        for k, module in enumerate(image.modules):
            (tmp_path / f"{k}.wasm").write_bytes(module)
        command = [node, "--input-type=module", "-e", RUN, tmp_path, str(wasm.START)]
        subprocess.run(command, timeout=120, check=True)
        found = []
        for path in sorted(tmp_path.glob("*.out")):
            memory = bytearray(path.read_bytes())
            own = {}
            for name, tensor in tensors.items():
                first, size = image.places[name]
                assert size == tensor.nbytes
                own[name] = torch.frombuffer(memory, dtype=tensor.dtype, count=tensor.numel(), offset=first)
            found.append({name: own[name].view(tensor.shape) for name, tensor in tensors.items()})
        assert (tmp_path / f"{len(image.modules) - 1}.out").exists()  # the last one needs nothing new
        return found

    return run


@triton.jit
def _words(x_in, y_in, place, out, whole, n, scale, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < n
    x = tl.load(x_in + k, mask, 0.5)
    y = tl.load(y_in + tl.load(place + k, mask, 0), mask, 0.0)
    size = 0
    while size < 3 and tl.max(tl.abs(x)) > size:
        size += 1
    rows = (tl.maximum(x, y), tl.minimum(y, x), tl.maximum(x, 0.25), tl.exp(x) * scale, tl.log(tl.abs(x)))
    more = (tl.sin(x), tl.floor(x), tl.sqrt(tl.abs(x)) + size, tl.sum(x) + tl.min(x), 1.0 / y)
    for row in tl.static_range(5):
        tl.store(out + row * n + k, rows[row], mask)
        tl.store(out + (5 + row) * n + k, more[row], mask)
    steps = (k * 7 - 20) // 3 + (k << 2) - k % 5 + x.to(tl.int32)
    tl.store(whole + k, tl.load(whole + k, mask, 0) + steps, mask)
    tl.atomic_add(whole + n, tl.where(mask, k, 0), mask)


def test_kernels_give_the_numbers_of_the_cpu(in_node):
    """Also of NaN, infinity and lanes beyond the end, and twice on the same memory.

    With relaxed SIMD the larger of NaN and a number may be NaN.
    """
    nan, inf = float("nan"), float("inf")
    x = torch.tensor([1.5, -2.0, nan, 0.0, 0.7, 3.0, -0.3, 2.5, 1e-3, -1.25])
    y = torch.tensor([2.0, nan, 1.0, -inf, 0.7, 1e-3, 5.0, inf, -4.0, 1.0])
    place = torch.tensor([0, 1, 2, 3, 4, 5, 6, 7, 9, 8], dtype=torch.int32)
    out, whole = torch.zeros(10, 10), torch.zeros(11, dtype=torch.int32)
    again = partial(launch(_words, (3,)), x, y, place, out, whole, 10, 0.5, BLOCK=wasm.LANES)
    with cpu.noted() as made:
        again()
    image = wasm.image({"words": made, "again": made}, {"out": out, "whole": whole})
    assert not whole.any()
    again()
    again()
    *relaxed, exact = in_node(image, out=out, whole=whole)
    torch.testing.assert_close(exact["out"], out, rtol=4e-7, atol=1e-7, equal_nan=True)
    for found in relaxed:
        torch.testing.assert_close(found["out"][:, 4:], out[:, 4:], rtol=4e-7, atol=1e-7)  # without NaN
    assert all(found["whole"].tolist() == whole.tolist() for found in (exact, *relaxed))


def test_the_first_flag_flies_as_on_the_cpu(in_node, request):
    """With its wind, pins and contact, for 32 substeps."""
    with narrowed(wasm.LANES):
        config = request.config.rootpath / "configs" / "sim" / "flag.yaml"
        simulation = Simulation.from_yaml(config, device="cpu")
        simulation.advance(simulation.start())
        run, force = simulation.solver.kernels, simulation.stepper.wind_force
        options = run.options_for([force.device_function()])
        run.first_step.zero_()
        with cpu.noted() as made:
            for k in range(16):
                run.substep(k, options)
        image = wasm.image({"first": made, "second": made}, {"fields": run.fields})
        before = run.displacement.clone()
        for k in range(32):
            run.substep(k % 16, options)
    motion = float((run.displacement - before).abs().max())
    assert motion > 0.02  # m
    for found in in_node(image, fields=run.fields):
        assert float((found["fields"][:, :4] - run.displacement).abs().max()) < 1e-4 * motion


def test_tensors_that_share_numbers_still_do(in_node):
    x = torch.arange(24, dtype=torch.float32)
    half, other = x[12:], torch.full((3,), 7.0)
    image = wasm.image({"nothing": []}, {"x": x, "half": half, "other": other})
    assert image.places["half"][0] == image.places["x"][0] + 48
    for found in in_node(image, x=x, half=half, other=other):
        assert found["half"].tolist() == half.tolist()
        assert found["other"].tolist() == [7.0] * 3


@pytest.mark.parametrize(("dtype", "why"), [(torch.float64, "double precision"), (torch.float32, "largest")])
def test_what_shaders_do_not_have_is_refused(dtype, why):
    x, whole = torch.zeros(10, dtype=dtype), torch.zeros(11, dtype=torch.int32)
    with cpu.noted() as made:
        launch(_words, (10,))(x, x, whole, x.new_zeros(10, 10), whole, 10, 0.5, BLOCK=1)
    with pytest.raises(TranslationError, match=why):
        shaders({"words": made}, lambda address: 0)
