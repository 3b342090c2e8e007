"""The table of the materials by name in configuration.md, which comes from the code and not from a record."""

from __future__ import annotations

from bench import slots
from bench.tables.markdown import grid
from gaussian_swaying.mpm.materials import MATERIALS

HEAD = (
    "name | `E` [Pa] | `nu` | `density` [kg/m³] | `thickness` [mm] | mass [kg/m²] | `solver.damping` [1/s] "
    "| waves [m/s] | read in a source"
)


@slots.table("configuration.md", "materials.known", "*", together=True)
def known(_: list[slots.Row]) -> list[str]:
    """All materials; the mass is that of a sheet of their thickness."""
    rows = []
    for name, m in MATERIALS.items():
        numbers = [f"{m.E:.1e}", str(m.nu), f"{m.density:g}", f"{1e3 * m.thickness:g}"]
        derived = [f"{m.density * m.thickness:.2g}", f"{m.damping:g}", f"{m.wave_speed:.0f}"]
        rows.append([f"`{name}`", *numbers, *derived, m.source or "-"])
    return grid(HEAD.split(" | "), rows)
