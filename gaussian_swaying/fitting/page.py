"""The page of a fit: the film beside the fit, the values, and what speaks against them, in one .html file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying._files import write_text
from gaussian_swaying.fitting.report import BEFORE, PICTURES, Result

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 70em; padding: 0 1em; color: #222; }
table { border-collapse: collapse; } td, th { padding: .2em .8em; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, .told { text-align: left; } .told { color: #666; }
video, img { max-width: 100%; border: 1px solid #ddd; }
video { max-height: 85vh; }
.good { color: #06752e; } .doubtful { color: #9a6200; } .failed { color: #b00020; }
"""
_MEANING = {
    "wind.speed": "speed of the wind",
    "wind.azimuth": "where it blows, from +x towards +y of the splat with z up",
    "wind.elevation": "where it blows, above the level",
    "material.E": "Young's modulus: stiffness",
    "material.density": "density",
    "film.start": "start of the motion, in the part of the film that is used",
}
_SLOW = "for (const film of document.querySelectorAll('video')) film.playbackRate = 0.5;"


def write_page(folder: Path, result: Result) -> None:
    """Write ``page.html``, named after the last two folders of its path.

    Args:
        folder: Where the pictures of the fit are; the page goes there.
        result: The fit.
    """
    name, own = "/".join(folder.resolve().parts[-2:]), [one.camera for one in result.shown]
    films = [folder / PICTURES / f"film_{camera}.mp4" for camera in own]
    looked = [folder / BEFORE / f"{kind}_{camera}.png" for kind in ("rest", "tracks") for camera in own]
    pictures = [*(folder / PICTURES / f"{camera}.png" for camera in own), *(path for path in looked if path.exists())]
    failed, doubtful = result.doubts()
    rows = "".join(
        f"<tr><td>{html.escape(row['name'])}</td><td class='told'>{html.escape(_MEANING.get(row['name'], ''))}</td>"
        f"<td>{row['value']:.5g}</td><td>± {row['standard_error']:.2g}</td>"
        f"<td>{html.escape(row['unit'])}</td><td>{row['low']:g} to {row['high']:g}</td></tr>"
        for row in result.rows()
    )
    shown = "".join(
        f'<video src="data:video/mp4;base64,{_packed(film.read_bytes())}" autoplay loop muted controls></video>'
        for film in films
    )
    below = "".join(f"<h3>{html.escape(_title(one))}</h3>{_picture(one)}" for one in pictures)
    text = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{html.escape(name)}</title><style>{_STYLE}</style>
<h1>{html.escape(name)}</h1>
<p class="{result.verdict}"><b>This fit {"has failed" if failed else f"is {result.verdict}"}.</b></p>
{_list([*failed, *doubtful])}
<table><tr><th></th><th></th><th>value</th><th>standard error</th><th></th><th>range</th></tr>{rows}</table>
{_list([*result.seen, *result.assumed])}
<h2>The film beside the fit</h2>
<p>At half speed. What is called predicted was not fitted.</p>
{shown}
<h2>Pictures</h2>
{below}
<script>{_SLOW}</script></html>
"""
    write_text(folder / "page.html", text)


def _list(sentences: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(one)}</li>" for one in sentences) + "</ul>" if sentences else ""


def _title(picture: Path) -> str:
    kind, _, camera = picture.stem.partition("_")
    titles = {"rest": "Before the fit: the scene at rest", "tracks": "Before the fit: points that are followed"}
    return f"{titles[kind]}, camera {camera}" if kind in titles else f"Film, fit and difference, camera {picture.stem}"


def _picture(path: Path) -> str:
    from PIL import Image

    data = io.BytesIO()
    Image.open(path).convert("RGB").save(data, format="JPEG", quality=88)
    return f'<img src="data:image/jpeg;base64,{_packed(data.getvalue())}" alt="{html.escape(path.stem)}">'


def _packed(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
