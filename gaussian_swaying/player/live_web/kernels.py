"""The kernels of a page that simulates: the package's own, as WebAssembly and as shaders, and the memory at rest.

``tools/player/live_web`` writes what differs from substep to substep into the tables that :func:`pack_kernels` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels import wasm
from gaussian_swaying.kernels.blocks import TranslationError
from gaussian_swaying.kernels.cpu import Noted, noted
from gaussian_swaying.kernels.launch import lanes, launch, narrowed
from gaussian_swaying.kernels.wgsl import shaders
from gaussian_swaying.mpm import modal_kernels as modal
from gaussian_swaying.mpm.contact import LONGEST, SURE, ContactRun
from gaussian_swaying.mpm.device_functions import Composed, DeviceFunction, Packed
from gaussian_swaying.mpm.dispatch import in_common
from gaussian_swaying.mpm.forces import MOST_STEPS, Force
from gaussian_swaying.mpm.modes import Modes, SiteForces
from gaussian_swaying.mpm.pull import still_pull
from gaussian_swaying.mpm.run import at_home
from gaussian_swaying.mpm.shared_kernels import site_forces, squared_stretch
from gaussian_swaying.mpm.total import Total, TotalRun
from gaussian_swaying.wind.field import BUFFERS, WindField
from gaussian_swaying.wind.force import AirLift, WindForce
from gaussian_swaying.wind.tables import CarriedField
from gaussian_swaying.wind.turbulence import Turbulence

Passes = dict[str, list[Noted]]
Looks = list[tuple[Any, Tensor, Tensor]]

MORE = 4
"""Room for what touches, which cannot grow in a page, as a multiple of what a run starts with."""

LISTED = ("low", "limit", "hashes", "cells", "order", "ordered", "start", "status", "motion")
"""Tables of what makes the lists, see ``ContactRun.make_lists``."""

ROWS = 16
"""Rows of held points that a shader loads at once."""


def pack_total(bound: Total, forces: Sequence[Force], wind: WindField) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a page needs to run ``total``: the head of its block, and arrays.

    Args:
        forces: The forces, of which the wind is the first if it does something; all have device functions.
    """
    functions = _functions(forces)
    with narrowed(wasm.LANES), at_home(bound.node_mass):
        run, (blow, tables) = TotalRun(bound), blown(wind)
        held = run.options_for([*functions, still_pull(bound.points.mass.shape)])
        free = run.options_for(functions)
        run.begin(1, False)
        touching = run.touching
        contact, lists, more = _touched(run, touching) if touching is not None else ({}, {}, {})
        tables |= more
        fastest = torch.zeros(2, **run.like)
        looks = _looks(run, fastest)
        passes = _substeps(run, free, held) | _seen(run, looks) | lists
        tables |= {
            "fields": run.fields,
            "schedule": run.schedule,
            "first": run.first_step,
            "values": run.values,
            "material": run.material,
            **({"curving": run.curving} if run.bent else {}),
            "fastest": fastest,
            "clock": run.time,
            "step": run.dt,
            **{name: run._seen[name] for name in ("position", "velocity")},
        }
        with narrowed(ROWS):
            run.lanes, run.joins = 1, False
            run.cut(run.cell_start.diff(), run.count)
            single = _substeps(run, free, held)
        with narrowed(1):
            single |= _seen(run, looks)
        layouts = free["FORCES"], held["FORCES"]
        head, arrays, place = _packed(passes | blow, tables, run.loads, layouts, wind, single)
    arrays |= {"sorted": run.order}
    if touching is not None:
        head["contact"] = contact
        head["kernels"]["shaders"] = "something touches the material"
        return head, arrays
    try:
        text, head["kernels"]["passes"] = shaders(single, lambda address: place(address) - wasm.START)
        arrays["shaders"] = _bytes(text.encode())
    except TranslationError as error:
        head["kernels"]["shaders"] = str(error)
    return head, arrays


def pack_modes(
    bound: Modes, wind_force: WindForce | None, wind: WindField, nodes: int
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a page needs to run ``modes``, as :func:`pack_total`; it fills the tables ``sites`` and ``nodes`` itself.

    Args:
        wind_force: The wind on the sites; None without wind.
    """
    count, sites = bound.square.shape[-1], bound.sites
    functions = _functions([] if wind_force is None else [wind_force])
    if any(bound.settings.gravity):
        functions += _functions([AirLift(bound.site_mass, [-g for g in bound.settings.gravity])])
    pull = still_pull(bound.site_mass.shape)
    with narrowed(wasm.LANES), at_home(bound.site_mass):
        real = partial(torch.zeros, dtype=torch.float32)
        blow, tables = blown(wind)
        own, block = SiteForces(bound.site_rest), lanes(bound.site_rest.device, 128)
        blocks, moved = -(-count // block), {name: real(6 * many, 2) for name, many in (("s", sites), ("n", nodes))}
        tables |= {
            "q": real(count),
            "p": real(count),
            "ahead": real(1),
            "numbers": real(4, dtype=torch.float64),
            "factors": real(4, count, dtype=torch.float64),
            "factor": real(4, count),
            "sites": real(6 * sites, count),
            "nodes": real(6 * nodes, count),
            "shown": real(nodes, 4),
        }
        q, p, ahead, factor, shapes = (tables[name] for name in ("q", "p", "ahead", "factor", "sites"))
        load, drag, left, lost, places = real(count), real(count, count), real(count), real(count), real(sites, 3)
        passes: Passes = dict(blow)

        def note(name: str, kernel: Any, grid: tuple[int, ...], *given: Any, **named: Any) -> None:
            with noted() as made:
                launch(kernel, grid)(*given, **named, BLOCK=block)
            passes[name] = [*passes.get(name, []), *made]

        def move(name: str, shape: Tensor, to: Tensor) -> None:
            note(name, modal.modal_moved, (len(shape),), shape, q, p, ahead, to, count)

        layouts: list[Composed] = []
        for name, acting in {"held": [*functions, pull], "free": functions or [pull]}.items():
            own.prepare(acting, torch.zeros((), dtype=torch.float64), 0.0, 1)
            out, loads = real(sites, 8), own.loads
            layouts.insert(0, loads.layout)
            tables.setdefault("values", own.values)
            move(name, shapes, moved["s"])
            note(
                name, site_forces, (-(-sites // block),), moved["s"], bound.site_rest, own.values, loads.rows,
                loads.buffer, out, sites, sites, 1, 0, FORCES=loads.layout,
            )  # fmt: skip
            note(name, modal.modal_load, (blocks,), shapes, out, load, sites, count)
            note(
                f"{name}Drag",
                modal.modal_drag,
                (blocks, -(-count // modal.TALL.value)),
                shapes,
                out,
                drag,
                sites,
                count,
            )
        note("swing", modal.modal_swing, (1,), q, p, load, drag, factor, left, lost, count)
        omega, settings = bound.square.sqrt(), bound.settings
        ratio = bound.ratio - (settings.damping / omega + settings.stiffness_damping * omega) / 2  # of the material
        note(
            "factors", modal.modal_factors, (blocks,), bound.square, ratio, tables["numbers"], tables["factors"], count
        )
        move("read", shapes, moved["s"])
        note("read", modal.modal_placed, (-(-sites // block),), moved["s"], bound.site_rest, places, sites)
        tables["position"] = places
        move("show", tables["nodes"], moved["n"])
        note("show", modal.modal_shown, (-(-nodes // block),), moved["n"], tables["shown"], nodes)
        head, arrays, _ = _packed(passes, tables, own.loads, layouts, wind)
    return head, arrays


def _touched(run: TotalRun, touching: ContactRun) -> tuple[dict[str, Any], Passes, dict[str, Tensor]]:
    """How lists are made of the samples that may touch, kernels and tables of it, and those of moving obstacles.

    The page sorts the samples between the kernels.
    """
    with noted() as turn:
        touching.take(run.time, run.dt, MOST_STEPS)
    moving = [packed.rows for packed, (solid,) in filter(None, touching.solids) if solid.per_substep.count]
    passes: Passes = {"turn": turn} if moving else {}
    tables = {f"row{k}": rows for k, rows in enumerate(moving)}
    tables |= {f"pose{k}": one.tensors[-1] for k, one in enumerate(turn)}
    if touching.stage.contact is None:
        return {}, passes, tables
    touching.take_room(MORE * touching.room, MORE * touching.slots)
    with noted() as made:
        touching.make_lists()
    gap = float(touching.limit) - touching.margin
    head = {"gap": gap, "least": touching.margin, "sure": SURE, "longest": LONGEST, "interval": touching.interval}
    head |= {"room": touching.room, "slots": touching.slots}
    passes |= {name: [one] for name, one in zip(("place", "cell", "list"), made, strict=True)}
    return head, passes, tables | {"samples": touching.position, **{name: getattr(touching, name) for name in LISTED}}


def _functions(forces: Sequence[Force]) -> list[DeviceFunction]:
    functions = [force.device_function() for force in forces]
    return [function for function in functions if function is not None]


def blown(wind: WindField) -> tuple[Passes, dict[str, Tensor]]:
    """The kernel that samples the wind at :data:`MOST_STEPS` times; its tables: times, velocities, how gusty."""
    times = gusts = torch.zeros(MOST_STEPS, dtype=torch.float64)
    with noted() as blow:
        air = wind(times)
    if blow:
        air, times, gusts, *_ = blow[0].tensors
    return {"blow": blow}, {"times": times, "air": air.contiguous(), "gusts": gusts}


def _substeps(run: TotalRun, free: dict[str, Any], held: dict[str, Any]) -> Passes:
    passes: Passes = {}
    for name, options in {"free": free, "held": held}.items():
        with noted() as passes[name]:
            run.substep(0, options)
    return passes


def _seen(run: TotalRun, looks: Looks) -> Passes:
    material = run.material
    with noted() as read:
        run._look_at()
    with noted() as look:
        for run.wave, run.material, run.speed in looks:
            run._look()
    run.material = material
    return {"read": read, "look": look}


def _looks(run: TotalRun, fastest: Tensor) -> Looks:
    looks = []
    for k, law in enumerate(run.bound.points.laws):
        material = run.material.clone()
        material[0] *= run.law == k  # points of other laws have no volume, and so no wave
        looks.append((in_common([law], "wave"), material, fastest[:1]))
    if run.settings.stiffness_damping > 0:
        looks.append((squared_stretch, torch.ones_like(run.material), fastest[1:]))
    return looks


def _packed(
    passes: Passes, tables: dict[str, Tensor], loads: Packed, layouts: Sequence[Composed], wind: WindField,
    others: Passes | None = None,
) -> tuple[dict[str, Any], dict[str, Tensor], Callable[[int], int]]:  # fmt: skip
    free, held = layouts
    carried, packed, past, small = [], [], [], {}
    tables["winds"] = loads.rows
    for m, effect in enumerate(wind.effects if free.parts and free.parts[0].functions else ()):
        part, start = free.parts[0], free.tables[0]
        if not isinstance(effect, CarriedField):
            past += [3 + part.per_substep[m][0]] if part.per_substep[m][1] else []
            continue
        count, name = effect.table.numel(), f"effect{m}"
        first = start + part.tables[m]
        tables[name] = loads.buffer[first : first + count]
        tables[name].zero_()  # a page is smaller with whole numbers
        unit = float(effect.table.abs().max()) / 64
        values = (effect.table / unit).round().char()
        small[name] = values.diff(dim=0, prepend=torch.zeros_like(values[:1]))
        packed.append({"name": name, "table": name, "unit": unit, "row": values[0].numel()})
        at = effect.now(wind.moment(torch.zeros(1, dtype=torch.float64)))[0, :3]
        cells = zip(effect.sizes.tolist(), effect.wraps, strict=True)
        carried.append(
            {
                "column": 3 + part.per_substep[m][0],
                "offset": at.tolist(),
                "axes": (effect.axes / effect.step[:, None]).tolist(),
                "cells": [size if wraps else None for size, wraps in cells],
                "scale": effect.scale,
                "grows": isinstance(effect, Turbulence),
            }
        )
    every = [one for made in (others or {}).values() for one in made]
    image = wasm.image(passes, tables, every)
    kinds = {torch.float32: "f4", torch.float64: "f8", torch.int32: "i4"}
    places = {name: [image.places[name][0], tensor.numel(), kinds[tensor.dtype]] for name, tensor in tables.items()}
    kernels = {
        "start": wasm.START,
        "places": places,
        "widths": [free.width, held.width],
        "pull": [held.per_point[-1][0], held.per_substep[-1][0]],
    }
    keys = {name: getattr(wind, name).tolist() for name in BUFFERS}
    flow = {**keys, "linear": wind.interpolation == "linear", "carried": carried, "past": past}
    head = {"kernels": kernels, "packed": packed, "wind": flow}
    fused, plain = image.modules
    parts = {"image": image.memory, "fusedCode": fused, "plainCode": plain}
    return head, small | {name: _bytes(part) for name, part in parts.items()}, image.place


def _bytes(content: bytes) -> Tensor:
    return torch.frombuffer(bytearray(content), dtype=torch.int8)
