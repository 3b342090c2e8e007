"""Outputs of a fit: the table of values, pictures of video, simulation and difference, and a scene for ``sim``."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from gaussian_swaying._files import write_json, write_table, write_text
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.inverse.plan import Unknown, Values, of_simulation, values_at
from gaussian_swaying.inverse.tracks import Tracks, opencv, picture_of
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.model import POLAR, in_settings
from gaussian_swaying.simulation.simulation import Simulation, classify
from gaussian_swaying.wind.field import flow_of

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

PICTURES, BEFORE = "pictures", "before"
BAND = 22  # height of the line of text above a picture [pixels]
HELD_TINT, MOVING, STILL_TINT = (0.85, 0.1, 0.1), (0.1, 0.65, 0.25), (0.55, 0.55, 0.55)
ASTRAY = 6.0  # largest accepted PSNR loss of fitted frames against the frame at rest [dB]
FOLLOWED, LOST = 0.95, 0.5  # share of the tracked motion that a good fit explains, and below which a fit has failed
VAGUE, TURNED = 0.25, 5.0  # standard error per range or value, and of an angle [degrees], that determines nothing
CHECK = "Raise `search`, widen the ranges, check the base and `known`"


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Attributes:
        covariance: Covariance of the places, as shares of the ranges, shape (U, U).
        unsettled: Why the values are not a local minimum, and a remedy; empty if they are one.
        notes: What the videos say against the plan.
        worse: How much the fitted frames of each camera are worse than its frame at rest: loss of PSNR [dB].
        followed: For each camera the share of the motion of its held-out tracks that is explained, 0 to 1.
        assumed: What the values rest on that nobody measured.
        background: What the background says of the videos, in words.
        rivals: Other values that fit nearly as well.
    """

    unknowns: Sequence[Unknown]
    place: tuple[float, ...]
    covariance: Tensor
    history: Sequence[Mapping[str, Any]]
    seconds: float
    unsettled: str = ""
    notes: Sequence[str] = ()
    worse: Mapping[str, float] = field(default_factory=dict)
    followed: Mapping[str, float] = field(default_factory=dict)
    assumed: Sequence[str] = ()
    background: Sequence[str] = ()
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
        found = []
        for u, row in zip(self.unknowns, self.rows(), strict=True):
            most = VAGUE * (abs(row["value"]) if u.scale == "log" else u.high - u.low)
            most = min(most, TURNED) if u.unit == "degrees" else most
            found += [u.name] if row["standard_error"] > most else []
        return found

    @property
    def at_an_end(self) -> list[str]:
        return [u.name for u, p in zip(self.unknowns, self.place, strict=True) if p < 1e-3 or p > 1 - 1e-3]

    def doubts(self) -> tuple[list[str], list[str]]:
        """Reasons for which the fit has failed, and for which it is doubtful, as sentences with a remedy."""
        failed: list[str] = []
        doubtful = list(self.notes)
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
        for name, loss in self.worse.items():
            if loss > ASTRAY and self.followed.get(name, 0.0) < FOLLOWED:
                failed.append(
                    f"camera {name} is not followed: its fitted frames are {loss:.0f} dB worse than the one at rest, "
                    f"so the values may be wrong. {CHECK}, or fit a shorter part (`until`)."
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
        found = zip(self.unknowns, self.values.values(), self.errors.values(), strict=True)
        return [
            {"name": u.name, "value": value, "standard_error": error, "unit": u.unit, "low": u.low, "high": u.high}
            for u, value, error in found
        ]

    def text(self) -> str:
        lines = [f"{'':<28}{'value':>12}{'error':>12}"]
        for row in self.rows():
            lines.append(f"{row['name']:<28}{row['value']:>12.5g}{row['standard_error']:>12.2g} {row['unit']}".rstrip())
        lines += self.background
        failed, doubtful = self.doubts()
        said = {"good": "This fit is good.", "doubtful": "This fit is doubtful:", "failed": "This fit has failed:"}
        lines += [said[self.verdict], *failed, *doubtful]
        return "\n".join([*lines, *(["Not measured:", *self.assumed] if self.assumed else [])])


def write_films(
    folder: Path, parts: Sequence[Tracks], values: Values, times: Sequence[float], fitted: int
) -> dict[str, float]:
    """Write ``pictures/film_CAMERA.mp4``, each video beside its simulation at all times, of which so many were fitted.

    Returns:
        For each camera the loss of PSNR of the fitted frames against the first one [dB].
    """
    simulation, losses = parts[0].simulation, {}
    states = [state for (state,) in states_of(simulation, [values], times, alike=False)]
    (folder / PICTURES).mkdir(exist_ok=True)
    for video in (part.video for part in parts):
        rate = (len(video.times) - 1) / (video.times[-1] - video.times[0])
        encoder, errors = VideoEncoder(folder / PICTURES / f"film_{video.name}.mp4", rate), list[float]()
        for k, (time, state) in enumerate(zip(times, states, strict=True)):
            if (frame := video.frame_at(time)) is not None:
                gaussians, real = simulation.painter.deformed(state), video.images[frame].float() / 255
                shown = picture_of(simulation, gaussians, video.cameras[frame]).color.clamp(0, 1).float().cpu()
                encoder.write(
                    titled([(f"film, {time:.2f} s", real), ("predicted" if k >= fitted else "fitted", shown)])
                )
                errors += [float((shown - real).square().mean())] if k < fitted else []
        encoder.finish()
        if errors:
            losses[video.name] = 10 * math.log10(max(sum(errors) / len(errors), 1e-12) / max(errors[0], 1e-12))
    return losses


def write_results(
    folder: Path, result: Fit, parser: ArgumentParser, settings: Namespace, simulation: Simulation
) -> None:
    """Write ``values.csv``, ``result.json``, ``scene.yaml`` and ``page.html``, named after two folders of its path."""
    write_table(folder / "values.csv", result.rows())
    failed, doubtful = result.doubts()
    told = {
        "values": result.rows(),
        "covariance_of_shares": result.covariance.tolist(),
        "verdict": result.verdict,
        "why": [*failed, *doubtful],
        "motion_explained": result.followed,
        **{name: getattr(result, name) for name in ("assumed", "background", "history", "seconds")},
    }
    write_json(folder / "result.json", told)
    write_text(folder / "scene.yaml", scene_text(result.values, parser, settings, simulation))
    name, shown = html.escape("/".join(folder.resolve().parts[-2:])), ""
    for path in [*sorted((folder / PICTURES).glob("*.mp4")), *sorted((folder / BEFORE).glob("*.png"))]:
        source = f'src="{quote(path.relative_to(folder).as_posix())}"'
        media = f"<video {source} autoplay loop muted controls></video>" if path.suffix == ".mp4" else f"<img {source}>"
        shown += f"<h3>{html.escape(path.stem)}</h3>{media}"
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title>'
    style = "<style>video, img { max-width: 100%; max-height: 85vh } pre { white-space: pre-wrap }</style>"
    slow = "<script>for (const film of document.querySelectorAll('video')) film.playbackRate = 0.5;</script>"
    text = f"{head}{style}<h1>{name}</h1><pre>{html.escape(result.text())}</pre>{shown}{slow}</html>\n"
    write_text(folder / "page.html", text)


def scene_text(values: Mapping[str, float], parser: ArgumentParser, settings: Namespace, simulation: Simulation) -> str:
    """The configuration of the base with the values that were found, as YAML for ``sim``."""
    found = settings.clone()
    if any(name in values for name in POLAR):
        found.wind.flow = flow_of(simulation.wind.flows[0].tolist(), values)  # type: ignore[index]
    in_settings(found, {name: value for name, value in of_simulation(values).items() if name not in POLAR})
    told = "".join(f"# {name}: {value:.6g}\n" for name, value in values.items())
    return "# Found by gaussian-swaying fit:\n" + told + f"frames: {settings.frames}\n" + config_text(parser, found)


def consequences(assumed: Sequence[str], values: Mapping[str, float], simulation: Simulation) -> list[str]:
    """Sentences on what follows for the values from what was only assumed, of ``length`` and ``mass``."""
    scene, speed = simulation.scene, values.get("wind.speed")
    longest = scene.size * scene.frame.metres_per_unit
    own = "" if speed is None else f" In its own lengths the speed is {speed / longest:.3g} a second."
    if any(simulation.model.value("solver.gravity")):
        own += " Gravity makes both depend on the length: measure one, and give it with --length."
    area = float(scene.points.mass.sum() / scene.patches.area.sum())
    told = {
        "length": f"No length is known: the longest side of what moves was taken as {longest:.3g} m. Metres a second "
        f"and pascals have no absolute value then, while angles do.{own}",
        "mass": f"The mass was taken as {area:.3g} kg/m². With twice the mass the speed is about 1.4 times and E twice "
        "as large: weigh it, and set material.density.",
    }
    return [sentence for name, sentence in told.items() if name in assumed]


def write_before(folder: Path, tracks: Sequence[Tracks]) -> list[Path]:
    """Write ``before/rest_CAMERA.png``, the scene at rest, and ``before/tracks_CAMERA.png``; return the files."""
    import imageio.v3 as iio

    cv2, found = opencv(), []
    (folder / BEFORE).mkdir(parents=True, exist_ok=True)
    for own in tracks:
        simulation, video, rest = own.simulation, own.video, own.simulation.scene.rest()
        painter, parts = simulation.painter, classify(simulation)
        colours = torch.tensor(STILL_TINT).repeat(len(parts.simulated), 1)
        colours[(parts.simulated | parts.carried).cpu()] = torch.tensor(MOVING)
        colours[parts.pinned.cpu()] = torch.tensor(HELD_TINT)
        roles = painter.draw(rest, colours.to(painter.device), video.cameras[0].to(painter.device))
        told = ("red: held, green: moves, grey: still", roles.color.detach().float().cpu().clamp(0, 1))
        still = side_by_side(video.images[0], picture_of(simulation, rest, video.cameras[0]), told)
        pale = (video.images[0].float() * 0.4 + 255 * 0.6).round().to(torch.uint8).numpy()
        for seen, way in zip(own.seen.T, own.position.transpose(0, 1), strict=True):
            places = way[seen].numpy().astype(np.int32)
            colour = (20, 90, 220) if bool(seen[-1]) else (220, 120, 0)
            cv2.polylines(pale, [places], False, colour, 1, cv2.LINE_AA)
            for place in places[:1]:
                cv2.circle(pale, place.tolist(), 2, colour, cv2.FILLED, cv2.LINE_AA)
        title = f"{own.position.shape[1]} points followed; orange: {int((~own.seen[-1]).sum())} lost"
        for name, picture in (("rest", still), ("tracks", titled([(title, torch.from_numpy(pale).float() / 255)]))):
            found.append(folder / BEFORE / f"{name}_{video.name}.png")
            iio.imwrite(found[-1], picture)
    return found


def side_by_side(frame: Tensor, shown: RenderOutput, *more: tuple[str, Tensor]) -> Any:
    """A frame, dtype uint8, (H, W, 3), the splat half over it, the splat, and more, as :func:`titled` joins them."""
    real, drawn = frame.float() / 255, shown.color.detach().float().cpu().clamp(0, 1)
    cover = 0.5 * shown.alpha.detach().float().cpu()
    both = real * (1 - cover) + drawn * cover
    return titled([("first frame", real), ("splat half over it", both), ("splat", drawn), *more])


def titled(panels: Sequence[tuple[str, Tensor]]) -> Any:
    """Pictures (H, W, 3) side by side, colours in [0, 1], as a NumPy array, with a title above each."""
    joined = torch.cat([panel for _, panel in panels], 1)
    height, width = joined.shape[:2]
    picture = Image.new("RGB", (width, height + BAND), (255, 255, 255))
    picture.paste(Image.fromarray((joined.clamp(0, 1) * 255).round().to(torch.uint8).numpy()), (0, BAND))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    for number, (title, _) in enumerate(panels):
        draw.text((number * width // len(panels) + 6, 3), title, fill=(0, 0, 0), font=font)
    return np.asarray(picture)
