"""Pictures of the examples and at the top of two guides: ``python tools/gallery.py [NAME ...]``.

Runs each script of ``examples/`` in an empty folder and draws what it ends with, into ``docs/pictures/examples``. An
example that saves pictures is shown by them; another one by a plot of its variables.
"""

from __future__ import annotations

import io
import os
import runpy
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

from gaussian_swaying import export_cloud, suggest
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.simulation.draw import Frame
from gaussian_swaying.simulation.simulation import Simulation

mpl.use("Agg")
mpl.rcParams.update({"font.size": 7, "axes.spines.top": False, "axes.spines.right": False})

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"
SIZE = (540, 338)  # pixels
SKY = np.array([0.90, 0.93, 0.96])
Names = dict[str, Any]


def drawn(frame: Frame) -> Image.Image:
    """A frame on a light sky where its own background is black, cut out around what it shows."""
    picture = frame.render()
    color, alpha = (value.detach().cpu().numpy() for value in (picture.color, picture.alpha))
    if frame.painter.background.max() == 0:
        color = color + (1 - alpha) * SKY
    return around(color, alpha[..., 0] > 0.05)


def around(color: np.ndarray, mask: np.ndarray) -> Image.Image:
    """The part of a picture around a mask."""
    (top, bottom), (left, right) = ((hits[0], hits[-1]) for hits in (np.flatnonzero(mask.any(k)) for k in (1, 0)))
    margin = round(0.08 * max(bottom - top, right - left)) + 2
    box = [max(0, left - margin), max(0, top - margin), right + margin, bottom + margin]
    whole = Image.fromarray((color.clip(0, 1) * 255 + 0.5).astype(np.uint8))
    return whole.crop((*box[:2], min(box[2], whole.width), min(box[3], whole.height)))


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Pictures in a row, each as high as the lowest fits."""
    width = SIZE[0] / sum(picture.width / picture.height for picture in pictures)
    height = round(min(SIZE[1], width))
    sized = [one.convert("RGB").resize((round(height * one.width / one.height), height), 3) for one in pictures]
    return Image.fromarray(np.concatenate([np.asarray(one) for one in sized], 1))


def plotted(draw: Callable[[Names, Any], None]) -> Callable[[Names], Image.Image]:
    """A picture of a plot that a function makes of the variables of an example."""

    def picture(names: Names) -> Image.Image:
        figure, axes = plt.subplots(figsize=(3.6, 2.25), dpi=150, layout="constrained")
        draw(names, axes)
        file = io.BytesIO()
        figure.savefig(file)
        plt.close(figure)
        return Image.open(file).convert("RGB")

    return picture


def vortex(names: Names, axes: Any) -> None:
    """Points and their velocities, from above."""
    (x, y, _), (u, v, _) = names["place"].T, names["kernels_v"].T
    axes.quiver(x, y, u, v, torch.hypot(u, v), cmap="viridis")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="velocities after five substeps")


def magnet(names: Names, axes: Any) -> None:
    """The sheet from its side."""
    axes.plot(*names["sheet"].T[1:], ".", color="0.75", label="at rest")
    axes.plot(*names["state"].position.T[1:], ".", color="tab:blue", label="after 0.4 s")
    axes.plot(*names["magnet"][1:], "s", color="tab:red", label="magnet")
    axes.set(xlabel="y [m]", ylabel="z [m]", xlim=(-0.1, 0.7))
    axes.legend(frameon=False)


def law(names: Names, axes: Any) -> None:
    """Stress against stretch."""
    stretch = torch.linspace(0.7, 1.4, 60, dtype=torch.float64)
    F = torch.diag_embed(torch.stack([stretch, torch.ones(60), torch.ones(60)], -1).double())
    mu, lam = torch.full((60,), 4e3).double(), torch.full((60,), 6e3).double()
    for factor in (1.0, 1.5):
        stress = names["SaintVenant"](factor).pk1(F, mu, lam)[:, 0, 0] / 1e3
        axes.plot(stretch, stress, label=f"factor {factor}")
    axes.plot(stretch, 14 * (stretch - 1), "--", color="0.6", label="linear")
    axes.set(xlabel="stretch", ylabel="stress [kPa]")
    axes.legend(frameon=False)


def strip(names: Names, axes: Any) -> None:
    """The strip of springs in the wind, and the plate."""
    y, z = names["place"].T[1:]
    angle, length = np.radians(names["exact"]), 1.0
    axes.plot([0, length * np.sin(angle)], [0, -length * np.cos(angle)], "--", color="0.6", label="hinged plate")
    axes.plot(y, z, "o-", color="tab:blue", markersize=3, label="cloth of springs")
    axes.annotate("", (-0.1, -0.4), (-0.5, -0.4), arrowprops={"arrowstyle": "->", "color": "tab:green"})
    axes.text(-0.5, -0.36, "wind", color="tab:green")
    axes.set(aspect="equal", xlabel="y [m]", ylabel="z [m]", ylim=(-0.9, 0.05), xlim=(-0.6, 1.2))
    axes.legend(frameon=False, loc="lower right")


def skeleton(names: Names, axes: Any) -> None:
    """The stem from its side with its joints, at rest and bent."""
    axes.plot(*names["means"].T[[0, 2]], ".", markersize=2, color="0.75", label="at rest")
    axes.plot(*names["moved"].means.T[[0, 2]], ".", markersize=2, color="tab:green", label="bent")
    axes.plot(
        *torch.cat([names["joints"][:1], names["bones"].cumsum(0)]).T[[0, 2]], "k.-", linewidth=0.7, label="joints"
    )
    axes.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", xlim=(-0.3, 1.3))
    axes.legend(frameon=False)


def blender_mesh(names: Names, axes: Any) -> None:
    """The Gaussians from above with the vertices of the mesh, in two frames."""
    for frame, color in ((12, "tab:orange"), (23, "tab:blue")):
        axes.plot(*names["places"][frame].T[:2], "o", markersize=4, color="0.85")
        axes.plot(*names["moved"][frame].means.T[:2], ".", markersize=1, color=color, label=f"frame {frame + 1}")
    axes.set(xlabel="x [m]", ylabel="y [m]", ylim=(-0.1, 0.03), title="from above; vertices in grey")
    axes.legend(frameon=False, markerscale=5, ncols=2)


def newton_cloth(names: Names, axes: Any) -> None:
    """Both flags from above, and the flag at rest."""
    shown = {"at rest": names["skin"].gaussians.means, "Newton": names["moved"], "this package": names["own"]}
    for (label, means), color in zip(shown.items(), ("0.75", "tab:orange", "tab:blue"), strict=True):
        axes.plot(*means.cpu().T[:2], ".", markersize=1.5, color=color, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", title="two flags from above, after 0.32 s")
    axes.legend(frameon=False, markerscale=5)


def newton_mpm(names: Names, axes: Any) -> None:
    """The post from its side, six times beside each other."""
    for k, frame in enumerate(names["moved"][::10]):
        axes.scatter(frame[:, 1] + 0.3 * k, frame[:, 2], s=1, c=names["means"][:, 0], cmap="viridis")
        axes.text(0.3 * k, 0.52, f"{0.2 * k:.1f} s", ha="center")
    axes.set(aspect="equal", xlabel="y [m], shifted", ylabel="z [m]", ylim=(-0.02, 0.58))


def sand(names: Names, axes: Any) -> None:
    """The heap from its side, before and after."""
    for x, color, label in zip(
        names["frames"][:: len(names["frames"]) - 1], ("0.75", "peru"), ("0 s", "0.28 s"), strict=True
    ):
        axes.plot(*x.cpu().T[[0, 2]], ".", markersize=2, color=color, label=label)
    axes.axhline(-0.25, color="0.3", linewidth=1)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", xlim=(-0.6, 0.6), ylim=(-0.35, 0.3))
    axes.legend(frameon=False, markerscale=3)


def two_numbers(names: Names, axes: Any) -> None:
    """The path of a corner of the flag in the noise, and as fitted."""
    corner = int(names["seen"][0].sum(-1).argmax())
    with torch.no_grad():
        fitted, first = names["motion"](*names["logs"].exp()), names["motion"](torch.tensor(3.5), torch.tensor(2e3))
    for path, style, label in ((first, ":", "first guess"), (fitted, "-", "fitted"), (names["seen"], "o", "seen")):
        axes.plot(*(100 * (path - path[0])[:, corner, 1:]).T, style, label=label, markersize=4)
    axes.set(xlabel="aside [cm]", ylabel="up [cm]", title="a corner of the flag")
    axes.legend(frameon=False)


def wind_by_gradient(names: Names, axes: Any) -> None:
    """The sheet from its side: as seen, at the first guess, and as found."""
    with torch.no_grad():
        ends = {"first guess": names["end"](1.0), "found": names["end"](names["speed"].detach())}
    axes.plot(names["seen"][:, 0], 1e3 * names["seen"][:, 2], "o", color="0.75", markersize=7, label="seen")
    for (label, end), color in zip(ends.items(), ("tab:orange", "tab:blue"), strict=True):
        axes.plot(end[:, 0], 1e3 * end[:, 2], ".", color=color, label=label)
    axes.set(xlabel="x [m]", ylabel="z [mm]")
    axes.legend(frameon=False)


def winds_together(names: Names, axes: Any) -> None:
    """Eight sheets from above."""
    for speed, sheet in zip(names["speeds"], names["state"].position.reshape(8, 10, 10, 3), strict=True):
        axes.plot(*sheet.mean(1)[:, :2].T, ".-", color=mpl.colormaps["viridis"](speed / 8), label=f"{speed:.0f} m/s")
    axes.set(xlabel="x [m], from the pole", ylabel="y [m], with the wind", title="eight sheets from above")
    axes.legend(frameon=False)


def gusts(names: Names, axes: Any) -> None:
    """Speed against time."""
    axes.plot(names["times"], names["speed"], linewidth=0.8)
    axes.axhline(5, color="0.6", linewidth=0.8)
    axes.set(xlabel="time [s]", ylabel="speed [m/s]")


def air(names: Names, axes: Any, height: float = 0.0, time: float = 0.4) -> None:
    """The speed of the wind in a horizontal plane."""
    x, y = torch.meshgrid(torch.linspace(-0.6, 2, 130), torch.linspace(-0.8, 0.8, 80), indexing="xy")
    places = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)
    velocity = names["wind"].at(torch.tensor(time, dtype=torch.float64), places).reshape(80, 130, 3)
    shown = axes.imshow(velocity.norm(dim=-1), origin="lower", extent=(-0.6, 2, -0.8, 0.8), cmap="viridis")
    few = (slice(4, None, 10), slice(4, None, 12))
    axes.quiver(x[few], y[few], velocity[..., 0][few], velocity[..., 1][few], color="white", width=0.004)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.figure.colorbar(shown, shrink=0.7, label="m/s")


def two_winds(names: Names) -> Image.Image:
    """The kept state, half a second on in either wind."""
    simulation, pictures = names["simulation"], []
    for speed in (3.0, -6.0):
        simulation.change("wind.flow", [0.0, speed, 0.0])
        state = names["state"]
        for _ in range(10):
            state, _ = simulation.advance(state)
        picture = simulation.painter.render(state, 0)
        alpha = picture.alpha.cpu().numpy()
        pictures.append(around(picture.color.cpu().numpy() + (1 - alpha) * SKY, alpha[..., 0] > 0.05))
    return beside(pictures)


def page(name: str, ready: str) -> Callable[[Names], Image.Image]:
    """A picture of a page in a browser, once an expression is true there."""

    def picture(_: Names) -> Image.Image:
        from playwright.sync_api import sync_playwright

        options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path="/usr/bin/chromium", args=options)
            shown = browser.new_page(viewport={"width": 720, "height": 450})
            shown.goto(Path(name).absolute().as_uri())
            while not shown.evaluate(ready):  # `wait_for_function` is refused by the policy of the page
                shown.wait_for_timeout(100)
            shown.wait_for_timeout(4000)
            return Image.open(io.BytesIO(shown.screenshot())).convert("RGB")

    return picture


def saved(*files: str) -> Callable[[Names], Image.Image]:
    """Pictures that the example itself wrote, in a row."""
    return lambda _: beside([Image.open(file) for file in files])


def passes(_: Names) -> Image.Image:
    """The five pictures of the example, three above two."""
    rows = [row[35:145, 85:235] for row in np.split(iio.imread("render_passes.png"), 5)]
    return Image.fromarray(np.concatenate([np.concatenate(rows[:3], 1), np.concatenate([*rows[3:], 0 * rows[0]], 1)]))


OWN: dict[str, Callable[[Names], Image.Image]] = {
    "behind_a_pole": plotted(air),
    "blender_mesh": plotted(blender_mesh),
    "custom_force": plotted(vortex),
    "custom_law": plotted(law),
    "film": page("film.html", "!!window.film"),
    "gusts": plotted(gusts),
    "live_page": page("live_page.html", "!!window.windPage"),
    "magnet": plotted(magnet),
    "newton_cloth": plotted(newton_cloth),
    "newton_mpm": plotted(newton_mpm),
    "own_splat": saved("own_splat.png"),
    "render_passes": passes,
    "sand": plotted(sand),
    "skeleton": plotted(skeleton),
    "stepping_by_hand": two_winds,
    "sweep_to_dataset": saved("flags/contact_sheet.png"),
    "turbulence": plotted(air),
    "wind_and_stiffness": plotted(two_numbers),
    "wind_by_gradient": plotted(wind_by_gradient),
    "wind_on_own_cloth": plotted(strip),
    "winds_together": plotted(winds_together),
}


def shown(path: Path) -> Image.Image:
    """The picture of an example, which is run in the current folder."""
    pictures: list[Image.Image] = []
    write = Frame.save

    def save(self: Frame, path: str | os.PathLike[str], format: str | None = None) -> None:
        pictures.append(drawn(self))
        write(self, path, format)

    Frame.save, sys.argv = save, [str(path)]  # type: ignore[method-assign]
    sys.path.insert(0, str(path.parent))
    try:
        names = runpy.run_path(str(path), run_name="__main__")
    finally:
        Frame.save = write  # type: ignore[method-assign]
        sys.path.remove(str(path.parent))
    own = OWN.get(path.stem)
    if own:
        return own(names)
    several = beside(pictures[-3:] or [drawn(names["frame"])])
    return several if several.height > SIZE[1] / 2.5 else pictures[-1]


def animate_first_flag() -> None:
    """Three seconds of the shipped flag."""
    simulation = Simulation.from_yaml(ROOT / "configs/sim/flag.yaml", device="cpu")
    pictures = []
    for frame in simulation.frames(75):
        if frame.index % 2 == 0:
            color = (frame.render().color.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
            pictures.append(Image.fromarray(color).resize((480, 270), 3))
    first, *rest = pictures
    first.save(PICTURES / "first_flag.webp", save_all=True, append_images=rest, duration=80, loop=0, quality=70)


def preview_of_a_plant() -> None:
    """What the preview says of a plant made in code, beside the plant after a second in its wind."""
    with tempfile.TemporaryDirectory() as here:
        export_cloud(Path(here) / "plant.ply", ficus(spacing=0.02))
        found = suggest(Path(here) / "plant.ply", look="gusts")
        guess = Image.fromarray(found.picture())
        *_, frame = found.to_simulation(device="cpu").frames(26)
        moved = drawn(frame)
    height = 360
    rows = [one.convert("RGB").resize((round(height * one.width / one.height), height), 3) for one in (guess, moved)]
    whole = Image.fromarray(np.concatenate([np.asarray(one) for one in rows], 1))
    whole.save(PICTURES / "own_splat.webp", quality=80)


def main(wanted: list[str]) -> None:
    """Make the pictures of some examples by name, or of all and of the first flag."""
    folder = PICTURES / "examples"
    folder.mkdir(exist_ok=True)
    for path in sorted((ROOT / "examples").glob("*/*.py")):
        if wanted and path.stem not in wanted:
            continue
        with tempfile.TemporaryDirectory() as here:
            os.chdir(here)
            picture = shown(path)
            os.chdir(ROOT)
        picture.thumbnail(SIZE)
        whole = Image.new("RGB", SIZE, picture.getpixel((0, 0)))
        whole.paste(picture, ((SIZE[0] - picture.width) // 2, (SIZE[1] - picture.height) // 2))
        whole.save(folder / f"{path.stem}.webp", quality=80)
        print(path.stem, picture.size)
    if not wanted or "flag" in wanted:
        animate_first_flag()
    if not wanted or "plant" in wanted:
        preview_of_a_plant()


if __name__ == "__main__":
    main(sys.argv[1:])
