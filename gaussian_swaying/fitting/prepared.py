"""Films as a fit takes them: with the camera of each frame, and with one exposure and white balance.

The still background of the splat is the judge of both. A film that shows none stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

from gaussian_swaying.fitting.background import Background
from gaussian_swaying.fitting.exposure import gains, with_gains
from gaussian_swaying.fitting.handheld import follow_camera, moves_by, stands_still
from gaussian_swaying.fitting.tracks import STILL
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.simulation.simulation import Simulation

MANY = 0.2
"""Share of the frames without background above which a fit is doubtful."""


@dataclass(frozen=True)
class Judged:
    """The judgement of the background on the film of a camera.

    Attributes:
        camera: Name of the camera.
        frames: Number of its frames.
        moved: Distance that the background goes in the film of a camera that is said to stand still [pixels].
        hand_held: Whether the camera of each frame was found.
        residual: Median distance of points of the background from where these cameras see them [pixels].
        unseen: Number of frames that show too little of the background; they have the camera of their neighbours.
        gains: Smallest and largest gain of red, green and blue, shape (2, 3); empty if it is not known.
    """

    camera: str
    frames: int
    moved: float = 0.0
    hand_held: bool = False
    residual: float = 0.0
    unseen: int = 0
    gains: tuple[tuple[float, ...], ...] = ()

    def sentences(self) -> list[str]:
        found = []
        if self.hand_held:
            found.append(
                f"camera {self.camera}: held in a hand; its background goes {self.moved:.3g} pixels. The camera of "
                f"each frame was found, {self.residual:.2f} pixels off"
                + (f"; {self.unseen} of {self.frames} frames have that of their neighbours." if self.unseen else ".")
            )
        if self.gains:
            low, high = self.gains
            told = ", ".join(
                f"{name} {a:.2f} to {b:.2f}" for name, a, b in zip(("red", "green", "blue"), low, high, strict=True)
            )
            found.append(f"camera {self.camera}: as bright as the splat now; the frames were divided by {told}.")
        return found

    def doubts(self) -> list[str]:
        if self.unseen <= MANY * self.frames:
            return []
        return [
            f"camera {self.camera}: {self.unseen} of {self.frames} frames show too little of what stands still, and "
            "have the camera of their neighbours: film more of it, or from a tripod."
        ]


def prepared(
    simulation: Simulation,
    videos: Sequence[Footage],
    hand_held: bool | None = None,
    also_moves: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> tuple[list[Footage], list[Judged]]:
    """Find the camera of each frame of films from a hand, and take drifts of exposure and white balance off all films.

    Args:
        simulation: The scene.
        videos: The films.
        hand_held: Whether their cameras move otherwise than they are said to. None: those whose frames all have one
            camera, but whose background moves by more than half a pixel.
        also_moves: Names of parts of the splat that move in the films, though the simulation does not move them.
        say: Called with a line for each thing that is done.

    Returns:
        The films, and what the background says of each; nothing if the splat has none.
    """
    background = Background(simulation, also_moves)
    if not background.exists:
        if hand_held:
            raise ValueError(
                "`hand_held` needs something that stands still in the splat, but all of it moves: stand the camera on "
                "a tripod, or have something still and textured, too, in the film and in the splat."
            )
        return list(videos), []
    if not hand_held and find_spec("cv2") is None:
        say("Without OpenCV nothing says whether a camera moves, or its exposure drifts.")
        return list(videos), []
    found, judged = [], []
    for video in videos:
        one = Judged(video.name, len(video.times))
        if hand_held is not False and stands_still(video):
            one = replace(one, moved=moves_by(video, background))
        if hand_held or (one.moved > STILL and hand_held is None):
            motion = follow_camera(video, background)
            video = replace(video, cameras=motion.cameras, itself=motion.itself)
            one = replace(one, hand_held=True, residual=motion.residual, unseen=len(motion.unseen))
        bright = gains(video, background)
        if bright is not None:
            video = replace(video, images=with_gains(video.images, bright[0]))
            ends = bright[0].amin(0), bright[0].amax(0)
            one = replace(one, gains=tuple(tuple(end.tolist()) for end in ends))
        for line in one.sentences():
            say(line)
        found.append(video)
        judged.append(one)
    return found, judged
