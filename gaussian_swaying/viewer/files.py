"""The controls for files: videos, configurations and splats."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from gaussian_swaying._checks import one_line
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.formats import READERS
from gaussian_swaying.viewer.film_strip import FilmStrip
from gaussian_swaying.viewer.scenes import settings_of_splat
from gaussian_swaying.viewer.screen import Panel

if TYPE_CHECKING:
    import viser
    from jsonargparse import Namespace


Folder = tempfile.TemporaryDirectory[str]
UPLOADS = [suffix for suffix in READERS if suffix not in (".json", ".gltf")]  # with files beside them
RECORD = "Record a video (simulated time)"


class Files:
    """Saves videos and configurations, and loads configurations and splats.

    Args:
        controls: The panel; a folder of it is open.
        loaded: Called when another scene is there.
        as_saved: Changes the text of a configuration before it is saved.
    """

    def __init__(self, controls: Panel, loaded: Callable[[], None], as_saved: Callable[[str], str]) -> None:
        self._loaded, self._as_saved, self.page, self.session = loaded, as_saved, controls.page, controls.session
        self._upload: Folder | None = None  # where the splat lies that was loaded
        gui, elsewhere = controls.server.gui, self.page.door.token is not None
        self.record = gui.add_button(
            RECORD, hint="The video shows real time: if the simulation is slower, it takes longer to record"
        )
        self.save = gui.add_button("Save the configuration", hint="A YAML file that `gaussian-swaying sim` runs")
        self.load_settings = gui.add_upload_button(
            "Load a configuration (.yaml)",
            mime_type=".yaml,.yml",
            disabled=elsewhere,  # a configuration can name files of this computer
            hint="Only on a page that other computers cannot open" if elsewhere else "Such as one that was saved here",
        )
        kinds = ",".join(UPLOADS)
        self.load = gui.add_upload_button("Load a splat", mime_type=kinds, hint=f"One of {kinds}")
        controls.on(self.record.on_click, self._toggle_recording, tell_event=True)
        controls.on(self.save.on_click, self._save, tell_event=True)
        controls.on(self.load.on_upload, lambda: self._load(self.load, self._splat))
        controls.on(self.load_settings.on_upload, lambda: self._load(self.load_settings, self._configuration))

    def _toggle_recording(self, event: viser.GuiEvent) -> None:
        if self.page.recording is None:
            self.page.recorder = event.client_id
            self.page.recording = FilmStrip()
            self.record.label = "Stop recording"
        else:
            self.stop_recording(event.client)

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        film, self.page.recording = self.page.recording, None
        self.record.label = RECORD
        if film is None:
            return
        try:
            content = film.finish()
        except (ValueError, OSError) as error:
            self.page.tell(str(error))
            return
        if film.full:
            self.page.tell(f"The video has the greatest length, {film.seconds:.0f} s, and was saved.")
        if client is not None:
            client.send_file_download("wind.mp4", content, save_immediately=True)

    def _save(self, event: viser.GuiEvent) -> None:
        text = self._as_saved(self.session.yaml())
        if self._upload is not None and self._upload.name in text:  # it goes away with the program
            text = "# Give the splat that you loaded: --scene.ply PATH\n" + text.replace(self._upload.name + "/", "")
        if event.client is not None:
            event.client.send_file_download("live.yaml", text.encode(), save_immediately=True)

    def _load(self, button: viser.GuiUploadButtonHandle, read: Callable[[bytes, str, Folder], Namespace]) -> None:
        self.load.disabled = self.load_settings.disabled = True
        threading.Thread(target=self._read, args=(button, read), name="load", daemon=True).start()

    def _read(self, button: viser.GuiUploadButtonHandle, read: Callable[[bytes, str, Folder], Namespace]) -> None:
        """Load an uploaded file; of its name, only the ending is used."""
        folder = Folder()
        try:
            try:
                settings = read(button.value.content, Path(button.value.name).suffix.lower(), folder)
            finally:  # before another file may come
                button._impl.value = replace(button.value, content=b"")
            self.page.progress(0.8, "Making the simulation")
            self.session.load(settings, partial(self._there, folder), self._ended)
        except Exception as error:
            self.page.tell(one_line(error))
            self._ended()
            folder.cleanup()

    def _ended(self) -> None:
        self.page.progress(None)
        self.load.disabled, self.load_settings.disabled = False, self.page.door.token is not None

    def _splat(self, content: bytes, suffix: str, folder: Folder) -> Namespace:
        path = Path(folder.name) / f"scene{suffix if suffix in UPLOADS else '.ply'}"
        path.write_bytes(content)
        device = self.session.simulation.device
        quick = device.type == "cpu"  # no trial looks for a grid
        return settings_of_splat(self.session.parser, path, device, path.parent, tell=self.page.progress, quick=quick)

    def _configuration(self, content: bytes, suffix: str, folder: Folder) -> Namespace:
        """The settings in a configuration file; if its splat is not on this computer, they get the present one."""
        self.page.progress(0.1, "Reading the configuration")
        try:
            text = content.decode()
        except UnicodeDecodeError:
            raise ValueError("The configuration is not UTF-8 text: save it as UTF-8.") from None
        settings = parse_text(self.session.parser, text, ["--device", self.session.simulation.device.type])
        splat = self.session.settings.scene.ply
        if settings.scene.ply is not None and not Path(settings.scene.ply).exists():
            if splat is None:
                raise ValueError(f"The configuration is for {settings.scene.ply}, which is not here: load it first.")
            settings.scene.ply = splat
        return settings

    def _there(self, folder: Folder) -> None:
        """Adapt to another scene; called in the thread of the session."""
        if str(self.session.settings.scene.ply).startswith(folder.name):
            self._upload = folder  # and the one before goes
        self.page.turns.ask("loaded", self._loaded)
