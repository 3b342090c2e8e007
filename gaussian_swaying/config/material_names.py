"""Materials by name in a configuration: ``material: cotton`` stands for the numbers of cotton.

A name is replaced by its numbers where it is read. So numbers beside it win, and what comes later in further files and
options wins over both, as with any other field.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from gaussian_swaying.mpm.materials import MATERIALS, known_material


def with_named_materials(found: Any) -> Any:
    """A configuration with numbers in place of the names in ``material`` and ``material.regions``.

    Its ``solver.damping`` is that of the material, unless it gives its own or has a ``custom_solver``.
    """
    if not isinstance(found, dict) or "material" not in found:
        return found
    given = found["material"]
    given = {"name": given} if isinstance(given, str) else given
    if not isinstance(given, Mapping):
        return found
    material = _numbers(given, "material")
    if isinstance(given.get("regions"), list):
        material["regions"] = [
            _numbers(part, "material.regions.name") if isinstance(part, Mapping) else part for part in given["regions"]
        ]
    changed = {**found, "material": material}
    solver = found.get("solver", {})
    if given.get("name") is not None and isinstance(solver, Mapping) and "custom_solver" not in found:
        changed["solver"] = {"damping": known_material(given["name"]).damping, **solver}
    return changed


def _numbers(given: Mapping[str, Any], field: str) -> dict[str, Any]:
    own = {key: value for key, value in given.items() if key != "name"}
    name = given.get("name")
    return own if name is None else {**known_material(name, field).numbers, **own}


def with_material_option(arguments: Sequence[str]) -> list[str]:
    """A command line with numbers in place of ``--material NAME``; options after it override them.

    Example:
        >>> with_material_option(["--material", "silk"])
        ['--material={"E": 16000000.0, "nu": 0.3, "density": 520.0, "thickness": 0.0001}', '--solver.damping=0.25']
    """
    found: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        option, equals, value = argument.partition("=")
        if option != "--material":
            found.append(argument)
            continue
        value = value if equals else next(rest, "")
        if value and not value.isalpha():  # a mapping or a file
            found += [argument] if equals else [argument, value]
            continue
        known = known_material(value, "--material")
        found += [f"--material={json.dumps(known.numbers)}", f"--solver.damping={known.damping}"]
    return found


NAMES = ", ".join(MATERIALS)
"""The names, for help."""
