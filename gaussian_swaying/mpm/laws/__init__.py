"""Constitutive laws, one file each.

Every file in this folder is imported automatically, so a law can be used by its name (``class_path: Sand``) as soon as
its file is here. ``LAWS`` lists the classes by name.
"""

from __future__ import annotations

from gaussian_swaying._folders import classes_of
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw

LAWS: dict[str, type[ConstitutiveLaw]] = classes_of(__name__, __path__, ConstitutiveLaw)
"""The laws of this package by name."""
