"""Boundary conditions, one file each.

Every file in this folder is imported automatically, so a condition can be used by its name (``class_path: Plane``) as
soon as its file is here. ``BOUNDARIES`` lists the classes by name.
"""

from __future__ import annotations

from gaussian_swaying._folders import classes_of
from gaussian_swaying.mpm.boundaries.boundary import Boundary

BOUNDARIES: dict[str, type[Boundary]] = classes_of(__name__, __path__, Boundary)
"""The boundary conditions of this package by name."""
