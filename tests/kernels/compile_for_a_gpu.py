"""Compiles the kernels of a few rollouts for a GPU of NVIDIA on a machine that may have none; prints their names.

A program of its own, as kernels belong to Triton or to the compiler for a CPU from their import on. Launches compile
and do nothing else, so the rollouts end with nonsense.
"""

import contextlib
import sys
from pathlib import Path

import torch

OPTIONS = ("num_warps", "num_stages", "maxnreg")
seen = set()


def kind(value):
    if isinstance(value, torch.Tensor):
        types = {torch.float32: "*fp32", torch.float64: "*fp64", torch.int32: "*i32", torch.int64: "*i64"}
        return (types | {torch.int8: "*i8", torch.uint8: "*u8", torch.bool: "*i1"})[value.dtype]
    return "i32" if isinstance(value, int) else "fp32"


def launch(kernel, grid):
    from triton import compile as compiled
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    def run(*given, **named):
        named.pop("launch_cooperative_grid", None)
        options = {name: named.pop(name) for name in OPTIONS if name in named}
        types = dict(zip(kernel.arg_names, map(kind, given), strict=False)) | dict.fromkeys(named, "constexpr")
        key = kernel.fn.__name__, str(types), str(named)
        assert set(named) <= set(kernel.arg_names), sorted(set(named) - set(kernel.arg_names))
        if key not in seen:
            seen.add(key)
            constants = {(kernel.arg_names.index(name),): value for name, value in named.items()}
            compiled(ASTSource(kernel, types, constants), target=GPUTarget("cuda", 90, 32), options=options)
            print(kernel.fn.__name__, flush=True)

    return run


def main():
    sys.path.insert(0, str(Path(__file__).parents[1]))
    here, torch.cuda.is_available = torch.cuda.is_available, lambda: True
    from gaussian_swaying.kernels import language  # noqa: F401

    torch.cuda.is_available = here
    from gaussian_swaying.kernels import launch as module

    module.launch, module.wide = launch, lambda device: True
    module.lanes, module.compiles = lambda device, gpu, cpu=8: gpu, lambda device: True

    from mpm.kernels.bodies import DT, make_load, make_points, make_solver, noise, set_going
    from mpm.kernels.test_agreement import BOUNDARIES

    if sys.argv[1:] == ["gradient"]:
        # a gradient through sheets with viscosity, pins and wind
        normal = torch.nn.functional.normalize(noise(7, 12, 3), dim=-1)
        bending = torch.full((12,), 1e-3, requires_grad=True)
        points = make_points("cpu", count=12, normal=normal, bending=bending)
        solver = make_solver("kernels", "total", boundaries=BOUNDARIES["two pins"](), stiffness_damping=1e-3)
        with contextlib.suppress(ValueError, FloatingPointError):
            solver.rollout(set_going(solver, points), DT, 3, make_load(points), check=False).position.sum().backward()
        return
    for formulation, boundaries in (("updated", "walls and pins"), ("updated", "handle"), ("total", "two pins")):
        points = make_points("cpu", count=12, batch=(2,))
        solver = make_solver("kernels", formulation, boundaries=BOUNDARIES[boundaries]())
        with contextlib.suppress(ValueError, FloatingPointError):  # of what the rollout should have computed
            solver.rollout(set_going(solver, points), DT, 3, make_load(points))


if __name__ == "__main__":
    main()
