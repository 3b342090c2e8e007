"""Shared by all commands: settings of the process, and errors as one sentence.

It must be imported before torch, since torch reads once how long OpenMP's threads spin before they sleep. The default
is much longer. On a quiet machine it is not faster, but it makes a run tens of times slower as soon as another program
needs a core.
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")
