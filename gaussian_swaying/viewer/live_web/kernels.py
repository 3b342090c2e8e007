"""The kernels of a page that simulates: the package's own, as WebAssembly and as shaders, and the memory at rest.

``tools/player/live_web`` writes what differs from substep to substep into the tables that :func:`pack_kernels` names.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels import wasm
from gaussian_swaying.kernels.blocks import TranslationError
from gaussian_swaying.kernels.cpu import Noted, noted
from gaussian_swaying.kernels.launch import narrowed
from gaussian_swaying.kernels.wgsl import shaders
from gaussian_swaying.mpm.dispatch import in_common
from gaussian_swaying.mpm.pull import still_pull
from gaussian_swaying.mpm.run import at_home
from gaussian_swaying.mpm.shared_kernels import squared_stretch
from gaussian_swaying.mpm.total import Total, TotalRun
from gaussian_swaying.wind.force import WindForce

Passes = dict[str, list[Noted]]
Looks = list[tuple[Any, Tensor, Tensor]]

ROWS = 16
"""Rows of held points that a shader loads at once."""


def pack_kernels(bound: Total, force: WindForce | None) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a page needs to run ``total``: numbers for the head of its block, and arrays.

    Args:
        bound: The body at rest, on a CPU.
        force: The wind; None if it does nothing.
    """
    found = None if force is None else force.device_function()
    functions = [] if found is None else [found]
    with narrowed(wasm.LANES), at_home(bound.node_mass):
        run = TotalRun(bound)
        held = run.options_for([*functions, still_pull(bound.points.mass.shape)])
        free = run.options_for(functions)
        run.begin(1, False)
        if run.touching is not None:
            run.touching.take(run.time, run.dt, 1)
        fastest = torch.zeros(2, **run.like)
        tables = {
            "fields": run.fields,
            "schedule": run.schedule,
            "first": run.first_step,
            "winds": run.loads.rows,
            "values": run.values,
            "material": run.material,
            **({"curving": run.curving} if run.bent else {}),
            "fastest": fastest,
            "clock": run.time,
            "step": run.dt,
        }
        looks = _looks(run, fastest)
        passes = _substeps(run, free, held) | _seen(run, looks)
        tables |= {name: run._seen[name] for name in ("position", "velocity")}
        with narrowed(ROWS):
            run.lanes, run.joins = 1, False
            run.cut(run.cell_start.diff(), run.count)
            single = _substeps(run, free, held)
        with narrowed(1):
            single |= _seen(run, looks)
        image = wasm.image(passes, tables, [one for made in single.values() for one in made])
    head, arrays = _packed(image)
    arrays |= {"order": run.order}
    layout = held["FORCES"]
    head |= {
        "widths": [free["FORCES"].width, layout.width],
        "pull": [layout.per_point[-1][0], layout.per_substep[-1][0]],
    }
    if run.touching is not None:
        return head | {"shaders": "something touches the material"}, arrays
    try:
        text, groups = shaders(single, lambda address: image.place(address) - wasm.START)
    except TranslationError as error:
        return head | {"shaders": str(error)}, arrays
    return head | {"passes": groups}, arrays | {"shaders": _bytes(text.encode())}


def _substeps(run: TotalRun, free: dict[str, Any], held: dict[str, Any]) -> Passes:
    """A substep without a pull and one with it."""
    passes: Passes = {}
    for name, options in {"free": free, "held": held}.items():
        with noted() as passes[name]:
            run.substep(0, options)
    return passes


def _seen(run: TotalRun, looks: Looks) -> Passes:
    """What reads the points, and what measures the waves."""
    material = run.material
    with noted() as read:
        run._look_at()
    with noted() as look:
        for run.wave, run.material, run.speed in looks:
            run._look()
    run.material = material
    return {"read": read, "look": look}


def _looks(run: TotalRun, fastest: Tensor) -> Looks:
    """The waves to measure: function, material and place of the largest speed, and that of the largest stretch."""
    looks = []
    for k, law in enumerate(run.bound.points.laws):
        material = run.material.clone()
        material[0] *= run.law == k  # points of other laws have no volume, and so no wave
        looks.append((in_common([law], "wave"), material, fastest[:1]))
    if run.settings.stiffness_damping > 0:
        looks.append((squared_stretch, torch.ones_like(run.material), fastest[1:]))
    return looks


def _packed(image: wasm.Image) -> tuple[dict[str, Any], dict[str, Tensor]]:
    fused, plain = image.modules
    parts = {"image": image.memory, "fusedCode": fused, "plainCode": plain}
    return {"start": wasm.START, "places": image.places}, {name: _bytes(part) for name, part in parts.items()}


def _bytes(content: bytes) -> Tensor:
    return torch.frombuffer(bytearray(content), dtype=torch.int8)
