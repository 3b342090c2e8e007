"""What the commands share: settings of the process, streams that may fail, and errors as one sentence.

Imported before torch: how long OpenMP's threads spin before they sleep is read once, when torch is loaded. The default,
much longer, is no faster on a quiet machine, but makes a run tens of times slower as soon as another program wants a
core.
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")
