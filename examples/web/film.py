"""A film for the web. A run becomes one page that plays by a double click, and a .sway file for other programs.

The browser moves the Gaussians by the nodes of the grid, so a frame takes a few kilobytes.
"""

from pathlib import Path

from gaussian_swaying.cli.main import main

small = ["--scene.generator.init_args.spacing=0.05", "--solver.dx=0.1", "--recorder.renders=[]"]
assert main(["sim", "--config=flag", "--frames=10", "--output=film", *small]) == 0
assert main(["export", "--web", "film", "film.html"]) == 0
assert main(["export", "film", "film.sway"]) == 0
page, film = (Path(name).stat().st_size for name in ("film.html", "film.sway"))
print(f"film.html has {page / 1e6:.1f} MB with its player, film.sway {film / 1e3:.0f} kB")
assert film < page / 5
