"""The controls that pull and hold: a click, boxes for pins."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml

from gaussian_swaying._devices import in_double
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.viewer.pictures import under_cursor
from gaussian_swaying.viewer.screen import Panel

if TYPE_CHECKING:
    import viser


class Holding:
    """Grabs the object where it is clicked, and pins the material in a box.

    Args:
        controls: The panel; a folder of it is open.
    """

    def __init__(self, controls: Panel) -> None:
        self._controls, self.page = controls, controls.page
        self.session, self.server = controls.session, controls.server
        self._pin: Any = None
        self._handle: Any = None
        self._grabbed = False  # whether what the handle pulls is held by now
        gui = self.server.gui
        gui.add_markdown("Click on the object to take hold of it, then drag the axes that appear.")
        self.release = gui.add_button("Let go of it", disabled=True)
        self.new_pin = gui.add_button("New pin box", hint="Drag it over what should be held, at rest")
        self.pin_size = gui.add_slider("Size of the box [% of the object]", 2, 100, 1, 15)
        self.hold = gui.add_button("Hold what is in the box", disabled=True)
        self.free = gui.add_button("Let go of all pins")
        controls.on(self.release.on_click, self.let_go)
        controls.on(self.new_pin.on_click, self._place_pin)
        controls.on(self.pin_size.on_update, self._size_pin)
        controls.on(self.hold.on_click, self._hold_box)
        controls.on(self.free.on_click, lambda: self.session.change({"solver.boundaries": []}))
        controls.on(self.server.scene.on_click(), self._clicked, tell_event=True)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with self.session.lock:
            place = under_cursor(self.session.snapshot, event.ray_origin, event.ray_direction)
        if place is None:
            return
        self.let_go()
        self.session.grab(place)
        size = self.session.simulation.scene.size
        self._handle = self.server.scene.add_transform_controls(
            "/pull", scale=0.25 * size, disable_rotations=True, depth_test=False, position=np.array(place)
        )
        self._controls.on(self._handle.on_update, self._dragged)
        self.release.disabled = False

    def _dragged(self) -> None:
        if self._handle is not None:
            self.session.drag([float(x) for x in self._handle.position])

    def let_go(self) -> None:
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.remove()
        self.release.disabled = True
        self.session.let_go()

    def _place_pin(self) -> None:
        scene = self.session.simulation.scene
        place = tuple(scene.center.tolist())
        if self._pin is not None:
            place = self._pin.position
        self._pin = self.server.scene.add_transform_controls(
            "/pin", scale=0.2 * scene.size, disable_rotations=True, depth_test=False, position=place
        )
        self._size_pin()
        self.hold.disabled = False

    def _size_pin(self) -> None:
        if self._pin is not None:
            size = (self._pin_side(),) * 3
            self.server.scene.add_box("/pin/box", (220, 120, 40), size, wireframe=True)

    def _pin_side(self) -> float:
        return self.session.simulation.scene.size * self.pin_size.value / 100

    def _hold_box(self) -> None:
        if self.session.settings.normalisation is not None:
            self.page.tell("Pins of this configuration are in normalised coordinates: write them into its file.")
            return
        centre, half = np.array(self._pin.position), 0.5 * self._pin_side()
        box = {"min": [float(f"{x:.6g}") for x in centre - half], "max": [float(f"{x:.6g}") for x in centre + half]}
        pin = {
            "class_path": "PinnedRegion",
            "init_args": {"kind": None, "region": {"class_path": "Box", "init_args": box}},
        }
        known = yaml.safe_load(self.session.yaml())["solver"].get("boundaries") or []
        self.session.change({"solver.boundaries": [*known, pin]})

    def follow(self) -> None:
        """Remove the handle of the mouse if the session has released the material."""
        if self._handle is not None and self._grabbed and not self.session.pulls:
            self.let_go()
        self._grabbed = self._handle is not None and self.session.pulls

    def forget_box(self) -> None:
        """Remove the box for pins, as there is another scene."""
        if self._pin is not None:
            self._pin.remove()
            self._pin = None
            self.hold.disabled = True

    def places(self) -> np.ndarray:
        """Places at rest of the material points that pins and handles hold [scene units], shape (N, 3)."""
        with self.session.lock:  # a change binds the solver anew
            scene, solver = self.session.simulation.scene, self.session.simulation.solver
        held = torch.zeros(scene.points.count, dtype=torch.bool, device=scene.points.position.device)
        for boundary in solver.framed(scene.frame):
            if isinstance(boundary, PinnedRegion):
                held |= boundary.particle_mask(scene.points.position)
        return scene.frame.point_to_scene(in_double(scene.points.position[held])).cpu().numpy()
