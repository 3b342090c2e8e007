"""Wind on captured 3D Gaussian scenes: aerodynamics on the normals and areas of Gaussians, in PyTorch.

``__init__.pyi`` lists the public names. They are imported when they are first used, so importing the package is quick.

Docstrings of internal functions leave out arguments whose names mean the same everywhere: ``dx`` grid spacing [m],
``dt`` substep [s], ``frame_dt`` [s]; of Gaussians ``means`` [scene units] (N, 3), ``covariances`` (N, 3, 3),
``quats`` wxyz of any length above zero (N, 4), ``log_scales`` of standard deviations [scene units] (N, 3),
``opacities`` from 0 to 1 (N,), ``colors`` as displayed (N, 3), ``sh`` (N, K, 3) with K = 1, 4, 9 or 16, unit
``normals`` of either sign (N, 3), ``background`` (3,), black if None; ``reduction`` over Gaussians, ``mean`` or
``sum``; ``E``, ``mu``, ``lam`` [Pa], ``nu``, ``F`` (..., 3, 3); ``metres_per_unit`` of a scene, and its ``rotation`` to
z up (3, 3); ``width``, ``height`` of images [pixels].
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
