"""Wind on captured 3D Gaussian scenes: aerodynamics on the normals and areas of Gaussians, in PyTorch.

``__init__.pyi`` lists the public names. They are imported when they are first used, so importing the package is quick.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
