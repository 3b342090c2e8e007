"""Summary of the diagnostics of a run: tears, largest motion and stretch, and advice on what to change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

SOUND = (0.5, 2.0)  # range of stretch within which the object keeps its intended shape

USUAL = 0.2  # largest displacement, as a fraction of the size, that still looks like wind


def extremes(log: Sequence[Mapping[str, Any]], where: Tensor, size: float, elastic: Tensor | None) -> dict[str, Any]:
    """Return the largest displacement, compression and stretch over the frames of a run.

    Args:
        log: Diagnostics of the frames, as from ``FrameDiagnostics.as_dict``.
        where: Rest positions of the particles [scene units], shape (P, 3).
        size: Longest side of the object [m].
        elastic: Which particles are elastic, shape (P,), None for all; the stretch of plastic materials means nothing.

    Returns:
        ``moved``, ``compressed`` and ``stretched``, each a dictionary with ``value`` (in m or as a ratio of lengths),
        ``at`` (rest position, scene units) and ``time`` [s]; ``moved`` also has its ``share`` of the size. None where
        no frame has a value.
    """
    found: dict[str, Any] = {}
    for name, field, particle, sign in (
        ("moved", "displacement_max", "moved_particle", 1),
        ("compressed", "stretch_min", "compressed_particle", -1),
        ("stretched", "stretch_max", "stretched_particle", 1),
    ):
        told = [entry for entry in log if entry[particle] < len(where)]
        if elastic is not None and name != "moved":
            told = [entry for entry in told if bool(elastic.reshape(-1)[entry[particle]])]
        if not told:
            found[name] = None
            continue
        worst = max(told, key=lambda entry: sign * entry[field])
        place = [round(float(v), 4) for v in where[worst[particle]]]
        found[name] = {"value": worst[field], "at": place, "time": worst["time"]}
    if found["moved"] is not None:
        found["moved"]["share"] = found["moved"]["value"] / size
    return found


def advice(found: Mapping[str, Any], E: float, thickness_matters: bool = True) -> list[str]:
    """Sentences on what went wrong with the shape of the object and what to change; none if all is well.

    Args:
        found: From :func:`extremes`.
        E: Largest Young's modulus of the run [Pa].
        thickness_matters: Whether ``material.thickness`` determines the volume.

    Returns:
        The sentences.
    """
    low, high = SOUND
    small, large, moved = found["compressed"], found["stretched"], found["moved"]
    bad, factor = [], 1.0
    if small is not None and not small["value"] >= low:
        bad.append(f"compressed to {_digits(small['value'])} of its length {_place(small)}")
        factor = max(factor, (1 - max(small["value"], 0.0)) / (1 - low))
    if large is not None and not large["value"] <= high:
        bad.append(f"stretched to {_digits(large['value'])} times its length {_place(large)}")
        factor = max(factor, (large["value"] - 1) / (high - 1))
    if not bad:
        return []
    said = [f"The material was {' and '.join(bad)}; between {low:g} and {high:g} it keeps its shape."]
    if moved is not None:
        said.append(f"The largest displacement was {_digits(moved['value'])} m, {moved['share']:.0%} of the size, "
                    f"{_place(moved)}.")  # fmt: skip
    share = 0.0 if moved is None else moved["share"]
    factor = min(max(2 * factor, share / USUAL, 3.0), 10.0)
    stiffer = f"raise `material.E` to about {E * factor:.0e} Pa"
    if thickness_matters:
        stiffer += f" or `material.thickness` to {factor:.0f} times"
    said.append(
        f"What to change: {stiffer}; or weaken `wind.flow`; or enlarge the `region` of the pins in "
        "`solver.boundaries`, if parts move that should stay in place."
    )
    return said


def _place(entry: Mapping[str, Any]) -> str:
    at = ", ".join(f"{value:.3g}" for value in entry["at"])
    return f"at [{at}] (scene units, at rest) after {entry['time']:.3g} s"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"
