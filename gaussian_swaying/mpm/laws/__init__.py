"""Constitutive laws.

Every file in this folder is imported automatically, so a law can be used by its name (``class_path: Sand``) as soon as
it is in one of them. ``LAWS`` lists the classes by name.
"""

from __future__ import annotations

from gaussian_swaying._folders import classes_of
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw

LAWS: dict[str, type[ConstitutiveLaw]] = {
    name: law for name, law in classes_of(__name__, __path__, ConstitutiveLaw).items() if law.device is not None
}
"""The laws of this package by name."""
