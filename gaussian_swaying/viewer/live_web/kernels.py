"""The kernels of a page that simulates: the package's own, as WebAssembly, and the memory of a body at rest.

``tools/player/live_web/kernels.js`` writes the times and the wind of each substep to the first rows of their tables.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels import wasm
from gaussian_swaying.kernels.cpu import recording
from gaussian_swaying.kernels.launch import narrowed
from gaussian_swaying.mpm.dispatch import in_common
from gaussian_swaying.mpm.run import at_home
from gaussian_swaying.mpm.shared_kernels import squared_stretch
from gaussian_swaying.mpm.total import Total, TotalRun
from gaussian_swaying.wind.force import WindForce


def pack_kernels(bound: Total, force: WindForce | None) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a page needs to run the kernels: numbers for the head of its block, and arrays.

    Args:
        bound: The body at rest, on a CPU.
        force: The wind; None if it does nothing.
    """
    function = None if force is None else force.device_function()
    with narrowed(wasm.LANES), at_home(bound.node_mass):
        run = TotalRun(bound)
        run.force_in = torch.zeros(run.count, 4, **run.like)
        options = run.options_for([] if function is None else [function])
        run.begin(1, False)
        if run.touching is not None:
            run.touching.take(run.time, run.dt, 1)
        with recording() as free:
            run.substep(0, options)
        with recording() as pulled:
            run.substep(0, options | {"FORCE": True, "IMPLICIT": True})
        with recording() as read:
            state = run._look_at()
        fastest = torch.zeros(2, **run.like)
        run.speed, material = fastest[:1], run.material
        with recording() as looked:
            for k, law in enumerate(bound.points.laws):
                run.wave, run.material = in_common([law], "wave"), material.clone()
                run.material[0] *= run.law == k  # points of other laws have no volume, and so no wave
                run._look()
            if bound.settings.stiffness_damping > 0:
                run.wave, run.speed, run.material = squared_stretch, fastest[1:], torch.ones_like(material)
                run._look()
        for left in (run.fields, run.load, run.joined, *run._seen.values(), *run._partial.values()):
            left.zero_()
        tensors = {
            "fields": run.fields,
            "schedule": run.schedule,
            "winds": run.loads.rows,
            "material": material,
            "force": run.force_in,
            **({"curving": run.curving} if run.bent else {}),
            "fastest": fastest,
            "clock": run.time,
            "step": run.dt,
            "position": state.position,
            "velocity": state.velocity,
        }
        image = wasm.image({"free": free, "pulled": pulled, "look": looked, "read": read}, tensors)
    fused, plain = image.modules
    parts = {"image": image.memory, "fusedCode": fused, "plainCode": plain}
    arrays = {name: torch.frombuffer(bytearray(part), dtype=torch.int8) for name, part in parts.items()}
    arrays |= {"active": run.active, "order": run.order}
    return {"start": wasm.START, "places": image.places}, arrays
