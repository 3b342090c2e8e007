"""Checks of the messages that browsers send to the live page."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    import viser

LARGEST_UPLOAD = 1 << 30  # bytes, of all files that are under way
MOST_UPLOADS = 8  # at a time
LEAST_PART = 64 << 10  # bytes; viser sends 512 KiB
LARGEST_STROKE = 16 << 10  # bytes of a message about a brush
MOST_CORNERS = 64  # of a path in it
MOST_PIXELS = 32_768  # of a side of a browser's window


class Incoming:
    """Lets through what the controls of the page can have sent, and drops the rest.

    viser takes any message, sets any attribute that one names and believes the announced size of a file. Here a
    message passes if it is a camera, a click, a drag, a part of a file, or the value of a control within its range.

    Args:
        tell: Shows a sentence on the page.

    Attributes:
        server: The server; everything is dropped until it is set.
        reach: The largest coordinate to which a handle may be dragged [scene units].
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.server: viser.ViserServer | None = None
        self.reach = 0.0
        self._tell = tell
        self._refused: str | None = None  # the control whose value was refused last
        self._checks: dict[str, Callable[[Any], bool]] = {
            "ViewerCameraMessage": _good_camera,
            "ScenePointerMessage": _good_click,
            "TransformControlsDragStartMessage": lambda _: True,
            "TransformControlsDragEndMessage": lambda _: True,
            "TransformControlsUpdateMessage": self._good_drag,
            "GuiUpdateMessage": self._good_value,
            "FileTransferStartUpload": self._good_upload,
            "FileTransferPart": self._good_part,
        }

    def takes(self, raw: bytes | str) -> bool:
        """True if a raw message is valid and may be processed."""
        from viser._messages import Message

        if self.server is None:
            return False
        try:
            message = Message.deserialize(raw)  # type: ignore[arg-type]
            return self._checks.get(type(message).__name__, lambda _: False)(message)
        except Exception:  # whatever is wrong with it, viser would fail, too
            return False

    def guarded(self, handler: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """The handler of a connection, which sees only messages that pass."""

        async def handle(connection: Any) -> None:
            receive = connection.recv

            async def receive_good() -> Any:
                while True:
                    await asyncio.sleep(0)  # until viser has dealt with the message before, such as a file's beginning
                    if self.takes(raw := await receive()):
                        return raw

            connection.recv = receive_good
            await handler(connection)

        return handle

    def _refuse(self, why: str) -> bool:
        self._tell(why)
        return False

    def _good_drag(self, message: Any) -> bool:
        if not (_numbers(message.position, 3) and _numbers(message.wxyz, 4)):
            return False
        return max(map(abs, message.position)) <= self.reach or self._refuse("Nothing can be dragged that far.")

    # ---- values of controls

    def _good_value(self, message: Any) -> bool:
        assert self.server is not None
        handle = self.server.gui._gui_input_handle_from_uuid.get(message.uuid)
        if handle is None or list(message.updates) != ["value"] or getattr(handle, "disabled", True):
            return False
        wrong = what_is_wrong(handle, message.updates["value"])
        if wrong is not None:
            self._refused = message.uuid
            return self._refuse(wrong)
        if self._refused == message.uuid:  # such as a number that was typed to its end
            self._refused = None
            self._tell("")
        return True

    # ---- files

    def _arrived(self) -> int:
        assert self.server is not None
        gui = self.server.gui
        kept = [getattr(handle.value, "content", b"") for handle in list(gui._gui_input_handle_from_uuid.values())]
        return sum(map(len, kept)) + sum(s["transferred_bytes"] for s in gui._current_file_upload_states.values())

    def _good_upload(self, message: Any) -> bool:
        from viser import GuiUploadButtonHandle

        assert self.server is not None
        gui = self.server.gui
        under_way = gui._current_file_upload_states
        button = gui._gui_input_handle_from_uuid.get(message.source_component_uuid)
        if not isinstance(button, GuiUploadButtonHandle) or message.transfer_uuid in under_way:
            return False
        if button.disabled or len(under_way) >= MOST_UPLOADS:
            return self._refuse("Another file is being loaded: try again when it is there.")
        if message.size_bytes == 0:
            return self._refuse("The file is empty.")
        if message.size_bytes > LARGEST_UPLOAD:
            return self._refuse(TOO_LARGE)
        return 0 < message.part_count <= 1 + message.size_bytes // LEAST_PART

    def _good_part(self, message: Any) -> bool:
        assert self.server is not None
        under_way = self.server.gui._current_file_upload_states
        state = under_way.get(message.transfer_uuid)
        if state is None or not isinstance(message.content, bytes):
            return False
        if state["transferred_bytes"] + len(message.content) > state["total_bytes"]:
            del under_way[message.transfer_uuid]
            return self._refuse("A file was larger than was announced, and was dropped.")
        if self._arrived() + len(message.content) > LARGEST_UPLOAD:
            del under_way[message.transfer_uuid]
            return self._refuse(TOO_LARGE)
        return True


@dataclass(frozen=True)
class BrushMove:
    """A message of a browser about its brush.

    Attributes:
        kind: ``stroke`` for a piece of a stroke, ``part`` for a double click.
        first: Whether a stroke begins with this piece.
        path: Corners of its path in the window [pixels].
        size: Width and height of the window [pixels].
        fov: Vertical field of view [rad].
        near: Nearest depth that is drawn, in the units of the scene.
        matrix: From the axes of the browser's camera, y up and z backwards, to those of its scene, row by row.
    """

    kind: str
    first: bool
    path: list[list[float]]
    size: tuple[int, int]
    fov: float
    near: float
    matrix: list[list[float]]


def brush_move(raw: Any) -> BrushMove | None:
    """The message of a browser about its brush, or None if its program cannot have sent it."""
    if not isinstance(raw, str) or len(raw) > LARGEST_STROKE:
        return None
    try:
        told = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    if not isinstance(told, dict) or set(told) != {"kind", "first", "path", "size", "fov", "near", "matrix"}:
        return None
    path, size, fov, near = told["path"], told["size"], told["fov"], told["near"]
    if not (
        told["kind"] in ("stroke", "part")
        and isinstance(told["first"], bool)
        and isinstance(path, list)
        and 1 <= len(path) <= MOST_CORNERS
        and all(_numbers(corner, 2) and max(map(abs, corner)) <= MOST_PIXELS for corner in path)
        and _numbers(size, 2)
        and all(1 <= side <= MOST_PIXELS for side in size)
        and _numbers([fov, near], 2)
        and 0 < fov < 180
        and near > 0
        and _numbers(told["matrix"], 16)
    ):
        return None
    matrix = torch.tensor(told["matrix"], dtype=torch.float64).reshape(4, 4).T  # as WebGL has it
    turn = matrix[:3, :3]
    if not torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-3) or torch.det(turn) < 0:
        return None
    width, height = (round(side) for side in size)
    return BrushMove(told["kind"], told["first"], path, (width, height), math.radians(fov), near, matrix.tolist())


TOO_LARGE = (
    f"Files of more than {LARGEST_UPLOAD >> 20:,} MiB, together with those that others load now, cannot be loaded "
    "here: give the file on the command line."
)


def what_is_wrong(handle: Any, value: Any) -> str | None:
    """Return the reason why a control cannot have a value, or None if it can."""
    import viser

    name = handle.label
    if isinstance(handle, (viser.GuiButtonHandle, viser.GuiCheckboxHandle)):
        return None if isinstance(value, bool) else f"{name}: expected true or false, but got {value!r:.40}."
    if isinstance(handle, viser.GuiDropdownHandle):
        return None if value in handle.options else f"{name}: there is no {value!r:.40}."
    if not isinstance(handle, (viser.GuiSliderHandle, viser.GuiMultiSliderHandle, viser.GuiNumberHandle)):
        return f"{name} has no value that could be set."
    least = -math.inf if handle.min is None else handle.min
    most = math.inf if handle.max is None else handle.max
    values = value if isinstance(handle, viser.GuiMultiSliderHandle) else [value]
    count = len(handle.value) if isinstance(handle, viser.GuiMultiSliderHandle) else 1
    if _numbers(values, count) and all(least <= x <= most for x in values):
        return None
    return f"{name} goes from {least:g} to {most:g}: {value!r:.40} was refused."


def _numbers(values: Any, count: int) -> bool:
    return (
        isinstance(values, (list, tuple))
        and len(values) == count
        and all(isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < 1e12 for x in values)
    )


def _good_camera(message: Any) -> bool:
    places = (message.position, message.look_at, message.up_direction)
    return (
        all(_numbers(place, 3) for place in places)
        and _numbers(message.wxyz, 4)
        and sum(x * x for x in message.wxyz) > 1e-6
        and _numbers([message.near, message.far, message.image_width, message.image_height], 4)
        and min(message.image_width, message.image_height) >= 0
        and 0 < message.fov < math.pi
    )


def _good_click(message: Any) -> bool:
    return (
        message.event_type == "click"
        and _numbers(message.ray_origin, 3)
        and _numbers(message.ray_direction, 3)
        and any(message.ray_direction)
        and len(message.screen_pos) > 0
    )
