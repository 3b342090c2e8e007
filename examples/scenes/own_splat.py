"""A splat of your own. `suggest`, like the preview, guesses what moves, how it is held and what it is.

Without a path on the command line, a flag on its pole is made here. Its starter runs for a quarter of a second.
"""

import sys

from PIL import Image

from gaussian_swaying import export_cloud, suggest
from gaussian_swaying.scenes import FlagScene

splat = sys.argv[1] if len(sys.argv) > 1 else "capture.ply"
if len(sys.argv) == 1:
    export_cloud(splat, FlagScene(spacing=0.06, stand="pole").generate())
found = suggest(splat)
print("\n".join(f"{name}: {reason}" for name, reason in found.reasons.items()))
Image.fromarray(found.picture()).save("own_splat.png")
found.to_yaml("starter.yaml")  # to change its numbers, and run it again
moved = found.to_simulation().run("own_splat", frames=7, progress=False)["displacement_mean_max_m"]
print(f"{moved:.2f} m on average; see own_splat.png and own_splat/video.mp4")
assert moved > 0
