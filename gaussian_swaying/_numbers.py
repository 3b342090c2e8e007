"""The numbers of settings: their units, and the range in which each makes sense.

The ranges are wide: from snow to steel, from millimetres to a landscape, from a breeze to a blast. What lies outside
is a slip, or would only overflow later.
"""

from typing import NamedTuple


class Sense(NamedTuple):
    """Unit and range of a number; one that is zero or less has only zero below the range."""

    unit: str = ""
    low: float = 1e-12
    high: float = 1e12

    @property
    def words(self) -> str:
        """The range with its unit."""
        return f"from {self.low:g} to {self.high:g}" + (f" {self.unit}" if self.unit else "")


SENSE = {
    "E": Sense("Pa", 1e-3, 1e16),
    "nu": Sense("", -0.999, 0.499),
    "density": Sense("kg/m³", 1e-4, 1e6),
    "thickness": Sense("m", 1e-8, 1e3),
    "bending": Sense("N m", 1e-20, 1e12),
    "damping_ratio": Sense("", 0.0, 100.0),
    "joint_stiffness": Sense("N/m", 0.0, 1e12),
    "joint_turning": Sense("N m/rad", 0.0, 1e12),
    "dx": Sense("m", 1e-6, 1e4),
    "gravity": Sense("m/s²", -1e4, 1e4),
    "damping": Sense("1/s", 0.0, 1e6),
    "stiffness_damping": Sense("s", 0.0, 1e3),
    "cfl": Sense("", 1e-4, 1e3),
    "substep": Sense("s", 1e-12, 10.0),
    "frame_dt": Sense("s", 1e-7, 100.0),
    "fps": Sense("1/s", 1e-3, 1e6),
    "time": Sense("s", 0.0, 1e7),
    "begin": Sense("s", 0.0, 1e7),
    "seconds": Sense("s", 1e-3, 1e7),
    "w": Sense("pixels", 1.0, 32768.0),
    "h": Sense("pixels", 1.0, 32768.0),
    "flow": Sense("m/s", -1e4, 1e4),
    "speed": Sense("m/s", 0.0, 1e4),
    "azimuth": Sense("degrees", -1e6, 1e6),
    "elevation": Sense("degrees", -1e6, 1e6),
    "gusts": Sense("", 0.0, 1e3),
    "amplitude": Sense("", 0.0, 1e3),
    "delta": Sense("", 0.0, 1e3),
    "std": Sense("m/s", 0.0, 1e4),
    "period": Sense("s", 1e-4, 1e7),
    "interval": Sense("s", 1e-7, 1e7),
    "phase": Sense("rad", -1e6, 1e6),
    "C_D": Sense("", 0.0, 1e4),
    "C_F": Sense("", 0.0, 1e4),
    "C_L": Sense("", -1e4, 1e4),
    "air_density": Sense("kg/m³", 0.0, 1e5),
    "added_mass": Sense("m", 0.0, 1e4),
    "air.speed": Sense("m/s", 1e-4, 1e4),
    "copies.shift": Sense("m", -1e4, 1e4),
    "copies.turn": Sense("degrees", -1e6, 1e6),
    "copies.delay": Sense("s", -1e6, 1e6),
    "longest_side": Sense("m", 1e-5, 1e6),
    "metres_per_unit": Sense("m", 1e-9, 1e9),
    "friction": Sense("", 0.0, 1e3),
}
"""By the name of a setting, or the end of it. Others are from 1e-12 to 1e12, whatever their unit, or zero."""


def sense_of(name: str) -> Sense | None:
    """Unit and range of a setting by its name, such as ``material.E`` or "E of the part 'leaf'"; None if unknown."""
    name = name.split(" of ")[0].split("`")[0]
    return SENSE.get(name) or SENSE.get(name.rpartition(".")[2])
