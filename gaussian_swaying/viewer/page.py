"""The page of a live wind tunnel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gaussian_swaying.viewer.controls import Controls
from gaussian_swaying.viewer.screen import Screen
from gaussian_swaying.viewer.session import Session

if TYPE_CHECKING:
    import viser


class Page(Screen):
    """A screen with controls.

    Attributes:
        controls: The panel, from :meth:`show` on.
    """

    controls: Controls

    def show(self, session: Session) -> Page:
        """Show a session, and the controls; returns the page."""
        self.session = session
        self.controls = Controls(self)
        super().show(session)
        return self

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        """Stop the video that is being recorded, and send it to a browser."""
        self.controls.files.stop_recording(client)

    def tell_figures(self) -> None:
        """Write the figures in the corner; the controls follow the session."""
        self.controls.tell()
