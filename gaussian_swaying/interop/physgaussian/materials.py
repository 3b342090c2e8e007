"""The material of a PhysGaussian configuration: ``material`` with its law and regions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from gaussian_swaying.interop.physgaussian.fields import Fields, Notes, box_about, part

_YIELD = math.sqrt(1.5)  # from a bound on |dev tau| to the yield stress in uniaxial tension

_MATERIALS = ("jelly", "metal", "sand", "foam", "snow", "plasticine")

_LAW_KEYS = {
    "yield_stress": ("metal", "foam", "plasticine"),
    "hardening": ("metal", "plasticine"),
    "xi": ("metal", "plasticine"),
    "friction_angle": ("sand",),
    "plastic_viscosity": ("foam",),
    "softening": ("plasticine",),
}

_FLOW_DEFAULTS = {
    "yield_stress": 0.0,
    "hardening": 0.0,
    "xi": 0.0,
    "friction_angle": 25.0,
    "plastic_viscosity": 0.0,
    "softening": 0.1,
}


def material_settings(take: Fields, notes: Notes) -> dict[str, Any]:
    """``material`` with its regions."""
    kind = take.get("material", "jelly")
    if kind not in _MATERIALS:
        raise ValueError(f"Expected `material` to be one of {', '.join(_MATERIALS)}, but got {kind!r}.")
    for name, kinds in _LAW_KEYS.items():
        if take.given(name) and kind not in kinds:
            notes.add(f"`{name}` has no effect on {kind}.")
    flow = {name: take.number(name, default) for name, default in _FLOW_DEFAULTS.items()}
    E, nu = take.positive("E", 1e5), _poisson_ratio(take, 0.4)
    density = take.positive("density", 200.0)
    material: dict[str, Any] = {"E": E, "nu": nu, "density": density, "volume": "cell"}
    law = _law(kind, flow, E, nu, notes)
    if law is not None:
        material["law"] = law
    regions = []
    for k, entry in enumerate(take.list("additional_material_params", [])):
        given = Fields(entry, f"additional_material_params[{k}]")
        box = box_about(given.vector("point"), given.vector("size"))
        own_E, own_nu = given.positive("E"), _poisson_ratio(given)
        region = {"region": box, "E": own_E, "nu": own_nu, "density": given.positive("density", density)}
        given.finish()
        own = _law(kind, flow, own_E, own_nu, notes)
        if own != law:
            region["law"] = own
        regions.append(region)
    if regions:
        material["regions"] = regions
    if kind == "sand":
        notes.add(
            "`material`: PhysGaussian uses the mean volume of all particles for sand; here each cell has its own."
        )
    return material


def _law(kind: str, flow: Mapping[str, float], E: float, nu: float, notes: Notes) -> dict[str, Any] | None:
    """``material.law``; None for fixed corotated elasticity.

    PhysGaussian bounds ``|dev tau|`` by its yield stress, which grows by ``2 mu xi`` (with ``hardening`` = 1) and falls
    by ``softening`` times the plastic logarithmic strain. In terms of uniaxial tension the yield stress is
    ``sqrt(3/2)`` times and the growth 3/2 times as large.
    """
    stress = flow["yield_stress"]
    growth = 2 * E / (2 * (1 + nu)) * flow["xi"] if flow["hardening"] == 1 else 0.0
    if kind == "jelly":
        return None
    if kind == "sand":
        return part("Sand", friction_angle=flow["friction_angle"])
    if kind == "foam":
        notes.add(
            "`plastic_viscosity`: the overstress relaxes exactly here, but by one implicit step in PhysGaussian, where "
            "the shear modulus also grows with the stretch."
        )
        return part("Foam", yield_stress=stress, viscosity=flow["plastic_viscosity"])
    if kind == "snow":
        notes.add("`material`: PhysGaussian computes no stress for snow; here it is that of Stomakhin et al. 2013.")
        return part("Snow")
    if kind == "metal":
        if stress <= 0:
            raise ValueError(
                f"Expected `yield_stress` of metal to be positive, but got {stress:g}: without it nothing keeps its "
                "shape; set it, or use foam."
            )
        if growth < 0:
            raise ValueError(f"Expected `xi` of metal not to be negative, but got {flow['xi']:g}: use plasticine.")
        return part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)
    if stress <= 0:
        notes.add("`yield_stress`: plasticine with zero never yields in PhysGaussian, so it is elastic here.")
        return None
    notes.add(
        "`material`: plasticine has Hencky's stress here and the fixed corotated one in PhysGaussian. There a particle "
        "loses all stress when its yield stress reaches zero; here it keeps its pressure."
    )
    growth -= flow["softening"]
    if growth > 0:
        return part("Metal", yield_stress=_YIELD * stress, hardening=1.5 * growth)
    return part("Plasticine", yield_stress=_YIELD * stress, softening=-1.5 * growth)


def _poisson_ratio(take: Fields, *default: float) -> float:
    nu = take.number("nu", *default)
    if not 0 <= nu < 0.5:
        raise ValueError(
            f"Expected `nu` to be from 0 to below 0.5, but got {nu}: at 0.5 the stress is infinite, use 0.49."
        )
    return nu
