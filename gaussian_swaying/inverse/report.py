"""Outputs of a fit: the table of values, pictures of video, simulation and difference, and a scene for ``sim``."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import torch
from torch import Tensor

from gaussian_swaying._files import write_json, write_table, write_text
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.hand import Judged
from gaussian_swaying.inverse.pictures import BEFORE, titled
from gaussian_swaying.inverse.unknowns import SCALE, Unknown, of_simulation, values_at
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.simulation.model import POLAR, in_settings
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import flow_of

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

PICTURES = "pictures"
PSNR = ("fitted", "predicted", "rest")

ASTRAY = 6.0
"""Largest accepted PSNR loss of fitted frames against the frame at rest [dB]; 6 dB is four times the squared error."""

FOLLOWED, LOST = 0.95, 0.5
"""Share of the tracked motion that the simulation has to explain in a good fit, and below which a fit has failed."""

VAGUE, TURNED = 0.25, 5.0
"""Standard error, as a share of the range (of the value on a logarithmic scale), and of an angle [degrees], above which
an unknown is called not determined."""

CHECK = "Raise `search`, widen the ranges, check the base and `known`"


@dataclass(frozen=True, eq=False)
class Shown:
    """Comparison of the fitted simulation with the video of one camera.

    Attributes:
        fitted: PSNR of the fitted frames [dB].
        predicted: PSNR of the predicted frames [dB]; NaN if there are none.
        rest: PSNR of the first frame, at rest [dB]: what noise, light and the splat itself leave, before any motion.
    """

    camera: str
    fitted: float
    predicted: float
    rest: float


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Attributes:
        covariance: Covariance of the places, as shares of the ranges, shape (U, U).
        shown: Comparison with the video of each camera.
        unsettled: The reason why the values are not a local minimum, and a remedy; empty if they are one.
        notes: What the videos say against the plan.
        followed: For each camera, the share of the motion of its tracks in the fitted frames that the simulation
            explains: 1 - (sum of squared distances) / (sum of squared displacements), of tracks that were not fitted
            and without half a pixel of noise; at least 0 for each track. Without tracks it is empty.
        assumed: What the values rest on that nobody measured, as sentences.
        seen: Where the wind blows, as each camera sees it, as sentences.
        judged: What the background says of the video of each camera; nothing without one.
        rivals: Other values that fit nearly as well.
    """

    unknowns: Sequence[Unknown]
    place: tuple[float, ...]
    covariance: Tensor
    shown: Sequence[Shown]
    history: Sequence[Mapping[str, Any]]
    seconds: float
    unsettled: str = ""
    notes: Sequence[str] = ()
    followed: Mapping[str, float] = field(default_factory=dict)
    assumed: Sequence[str] = ()
    seen: Sequence[str] = ()
    judged: Sequence[Judged] = ()
    rivals: Sequence[Mapping[str, float]] = ()

    @property
    def values(self) -> dict[str, float]:
        return values_at(self.unknowns, self.place)

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors, in the units of the values. They contain noise and the error of the grid, nothing else."""
        share = self.covariance.diagonal().clamp(min=0).sqrt().tolist()
        return {u.name: s * u.slope(p) for u, s, p in zip(self.unknowns, share, self.place, strict=True)}

    @property
    def vague(self) -> list[str]:
        """Names of the unknowns that are not determined."""
        values, errors, found = self.values, self.errors, []
        for u in self.unknowns:
            most = VAGUE * (abs(values[u.name]) if u.scale == "log" else u.high - u.low)
            if errors[u.name] > (min(most, TURNED) if u.unit == "degrees" else most):
                found.append(u.name)
        return found

    @property
    def at_an_end(self) -> list[str]:
        return [u.name for u, p in zip(self.unknowns, self.place, strict=True) if p < 1e-3 or p > 1 - 1e-3]

    @property
    def astray(self) -> list[str]:
        """Names of cameras whose fitted frames the simulation does not follow: much worse than the one at rest."""
        return [one.camera for one in self.shown if one.fitted < one.rest - ASTRAY]

    def doubts(self) -> tuple[list[str], list[str]]:
        """Reasons for which the fit has failed, and for which it is doubtful, as sentences with a remedy."""
        failed: list[str] = []
        doubtful = [*self.notes, *(doubt for one in self.judged for doubt in one.doubts())]
        for rival in self.rivals:
            told = ", ".join(f"{name} {value:.4g}" for name, value in rival.items())
            doubtful.append(
                f"Another start fits as well or better ({told}). Begin there (`start`), or film from one more side."
            )
        for name, share in self.followed.items():
            if share < FOLLOWED:
                (failed if share < LOST else doubtful).append(
                    f"camera {name}: the simulation explains {share:.0%} of the motion of its tracks. {CHECK}, "
                    "or film from a side where the motion is across the picture."
                )
        for one in self.shown:
            if one.camera in self.astray and self.followed.get(one.camera, 0.0) < FOLLOWED:
                failed.append(
                    f"camera {one.camera} is not followed: its fitted frames are {one.rest - one.fitted:.0f} dB worse "
                    f"than the one at rest, so the values may be wrong. {CHECK}, or fit a shorter part (`until`)."
                )
        doubtful += [self.unsettled] if self.unsettled else []
        doubtful += [
            f"{name} is not determined by this video: its error is large. Film longer or from one more side, or lower "
            "`solver.dx`."
            for name in self.vague
        ]
        doubtful += [f"{name} is at an end of its range: widen the range." for name in self.at_an_end]
        return failed, doubtful

    @property
    def verdict(self) -> str:
        """``good``, ``doubtful`` or ``failed``; see :meth:`doubts`."""
        failed, doubtful = self.doubts()
        return "failed" if failed else "doubtful" if doubtful else "good"

    def rows(self) -> list[dict[str, Any]]:
        """The table: a row for each unknown."""
        found = zip(self.unknowns, self.values.values(), self.errors.values(), strict=True)
        return [
            {"name": u.name, "value": value, "standard_error": error, "unit": u.unit, "low": u.low, "high": u.high}
            for u, value, error in found
        ]

    def text(self) -> str:
        """All of it in words."""
        lines = [f"{'':<28}{'value':>12}{'error':>12}"]
        for row in self.rows():
            lines.append(f"{row['name']:<28}{row['value']:>12.5g}{row['standard_error']:>12.2g} {row['unit']}".rstrip())
        for one in self.shown:
            told = "" if math.isnan(one.predicted) else f", predicted frames {one.predicted:.2f} dB"
            lines.append(f"camera {one.camera}: fitted frames {one.fitted:.2f} dB{told}")
        lines += [*self.seen, *(sentence for one in self.judged for sentence in one.sentences())]
        failed, doubtful = self.doubts()
        said = {"good": "This fit is good.", "doubtful": "This fit is doubtful:", "failed": "This fit has failed:"}
        lines += [said[self.verdict], *failed, *doubtful]
        return "\n".join([*lines, *(["Not measured:", *self.assumed] if self.assumed else [])])


def predictions(
    simulation: Simulation,
    videos: Sequence[Footage],
    times: Sequence[float],
    fitted: int,
    moved: Iterable[DeformedGaussians],
    films: Path | None = None,
) -> list[Shown]:
    """Compare all Gaussians at each time with whole videos, of which so many times were fitted.

    ``film_CAMERA.mp4``, the video beside the fit, is written into the folder ``films``.
    """
    squares: list[tuple[list[float], list[float]]] = [([], []) for _ in videos]
    painter, encoders = simulation.painter, list[VideoEncoder]()
    with ExitStack() as left:
        for video in videos if films else ():
            films.mkdir(exist_ok=True)  # type: ignore[union-attr]
            rate = (len(video.times) - 1) / (video.times[-1] - video.times[0])
            encoders.append(VideoEncoder(films / f"film_{video.name}.mp4", rate))  # type: ignore[operator]
            left.callback(encoders[-1].abort)
        for k, (time, gaussians) in enumerate(zip(times, moved, strict=True)):
            for number, video in enumerate(videos):
                if (frame := video.frame_at(time)) is None:
                    continue
                drawn = painter.picture(gaussians, video.cameras[frame].to(painter.device))
                shown, real = drawn.color.clamp(0, 1).float().cpu(), video.images[frame].float() / 255
                squares[number][k >= fitted].append(float((shown - real).square().mean()))
                if encoders:
                    title = "predicted" if k >= fitted else "fitted"
                    encoders[number].write(titled([(f"film, {time:.2f} s", real), (title, shown)]))
        for encoder in encoders:
            encoder.finish()
    return [
        Shown(video.name, _psnr(before), _psnr(after), _psnr(before[:1]))
        for video, (before, after) in zip(videos, squares, strict=True)
    ]


def write_results(
    folder: Path, result: Fit, parser: ArgumentParser, settings: Namespace, simulation: Simulation
) -> None:
    """Write ``values.csv``, ``result.json`` and ``scene.yaml``."""
    write_table(folder / "values.csv", result.rows())
    failed, doubtful = result.doubts()
    told = {
        "values": result.rows(),
        "covariance_of_shares": result.covariance.tolist(),
        "cameras": [{"camera": one.camera} | {f"psnr_{n}_db": getattr(one, n) for n in PSNR} for one in result.shown],
        "verdict": result.verdict,
        "why": [*failed, *doubtful],
        "motion_explained": result.followed,
        "assumed": result.assumed,
        "background": [asdict(one) for one in result.judged],
        "not_settled": result.unsettled,
        "not_followed": result.astray,
        "not_determined": result.vague,
        "history": result.history,
        "seconds": result.seconds,
    }
    write_json(folder / "result.json", told)
    write_text(folder / "scene.yaml", scene_text(result.values, parser, settings, simulation))


def scene_text(values: Mapping[str, float], parser: ArgumentParser, settings: Namespace, simulation: Simulation) -> str:
    """The configuration of the base with the values that were found, as YAML for ``sim``."""
    found = settings.clone()
    if any(name in values for name in POLAR):
        found.wind.flow = flow_of(simulation.wind.flows[0].tolist(), values)  # type: ignore[index]
    in_settings(found, {name: value for name, value in of_simulation(values).items() if name not in POLAR})
    if SCALE in values:  # cells and spacings are in metres
        ratio = values[SCALE] / simulation.scene.frame.metres_per_unit
        found.scene.metres_per_unit, found.scene.longest_side = values[SCALE], None
        found.solver.dx = ratio * float(simulation.solver.dx)
        if found.scene.filling and found.scene.filling.spacing:
            found.scene.filling.spacing *= ratio
    told = "".join(f"# {name}: {value:.6g}\n" for name, value in values.items())
    return "# Found by gaussian-swaying fit:\n" + told + f"frames: {settings.frames}\n" + config_text(parser, found)


def consequences(assumed: Sequence[str], values: Mapping[str, float], simulation: Simulation) -> list[str]:
    """Sentences on what follows for the values from what was only assumed, of ``length`` and ``mass``."""
    scene, found = simulation.scene, []
    longest = scene.size * scene.frame.metres_per_unit
    if "length" in assumed:
        speed = values.get("wind.speed")
        told = "" if speed is None else f" In its own lengths the speed is {speed / longest:.3g} a second."
        if any(simulation.model.value("solver.gravity")):
            told += " Gravity makes both depend on the length: measure one, and give it with --length."
        found.append(
            f"No length is known: the longest side of what moves was taken as {longest:.3g} m. Metres a second and "
            f"pascals have no absolute value then, while angles do.{told}"
        )
    if "mass" in assumed:
        area = float(scene.points.mass.sum() / scene.patches.area.sum())
        found.append(
            f"The mass was taken as {area:.3g} kg/m². With twice the mass the speed is about 1.4 times and E twice as "
            "large: weigh it, and set material.density."
        )
    return found


def wind_seen(values: Mapping[str, float], videos: Sequence[Footage], simulation: Simulation) -> list[str]:
    """Sentences on where the wind blows in the picture of each camera; none if no direction was sought."""
    if not {"wind.azimuth", "wind.elevation"} & set(values):
        return []
    flow = torch.tensor(flow_of(simulation.wind.flows[0].tolist(), values)).double()  # type: ignore[index]
    scene, found = flow @ simulation.scene.frame.rotation.double().cpu() / flow.norm(), []
    for video in videos:
        right, down, away = (video.cameras[0].world_to_camera[:3, :3].double().cpu() @ scene).tolist()
        ways = [f"to the {'right' if right > 0 else 'left'}"] * (abs(right) > 0.1)
        ways += ["down" if down > 0 else "up"] * (abs(down) > 0.2)
        angle = math.degrees(math.asin(min(1.0, abs(away))))
        ways.append(f"{angle:.0f} degrees {'away from' if away > 0 else 'towards'} it")
        found.append(f"camera {video.name} sees the wind blow {', '.join(ways)}")
    return found


def _psnr(squares: Sequence[float]) -> float:
    """PSNR of mean squares [dB], of their mean; NaN for none."""
    mean = sum(squares) / len(squares) if squares else math.nan
    return -10 * math.log10(mean) if mean != 0 else math.inf


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 70em; padding: 0 1em; color: #222; }
table { border-collapse: collapse; } td, th { padding: .2em .8em; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child { text-align: left; } video, img { max-width: 100%; border: 1px solid #ddd; } video { max-height: 85vh; }
.good { color: #06752e; } .doubtful { color: #9a6200; } .failed { color: #b00020; }
"""


def write_page(folder: Path, result: Fit) -> None:
    """Write ``page.html``, named after the last two folders of its path, with the films and pictures of the fit."""
    name = html.escape("/".join(folder.resolve().parts[-2:]))
    failed, doubtful = result.doubts()

    def listed(sentences: Sequence[str]) -> str:
        return "<ul>" + "".join(f"<li>{html.escape(one)}</li>" for one in sentences) + "</ul>" if sentences else ""

    rows = "".join(
        f"<tr><td>{html.escape(row['name'])}</td><td>{row['value']:.5g}</td><td>± {row['standard_error']:.2g}</td>"
        f"<td>{html.escape(row['unit'])}</td><td>{row['low']:g} to {row['high']:g}</td></tr>"
        for row in result.rows()
    )
    shown = "".join(
        f'<h3>Camera {html.escape(one.camera)}</h3><video src="{PICTURES}/film_{quote(one.camera)}.mp4" autoplay loop '
        f'muted controls></video><img src="{BEFORE}/rest_{quote(one.camera)}.png" alt="the scene at rest">'
        f'<img src="{BEFORE}/tracks_{quote(one.camera)}.png" alt="points that are followed">'
        for one in result.shown
    )
    text = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{name}</title><style>{_STYLE}</style>
<h1>{name}</h1>
<p class="{result.verdict}"><b>This fit {"has failed" if failed else f"is {result.verdict}"}.</b></p>
{listed([*failed, *doubtful])}
<table><tr><th></th><th>value</th><th>standard error</th><th></th><th>range</th></tr>{rows}</table>
{listed([*result.seen, *result.assumed])}
<h2>The film beside the fit, the scene at rest, and the points that are followed</h2>
<p>At half speed. What is called predicted was not fitted.</p>
{shown}
<script>for (const film of document.querySelectorAll('video')) film.playbackRate = 0.5;</script></html>
"""
    write_text(folder / "page.html", text)
