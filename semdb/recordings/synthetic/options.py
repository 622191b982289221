"""What a synthetic recording is made of."""

from __future__ import annotations

from dataclasses import dataclass

from semdb.errors import UsageError
from semdb.types import Camera

FOCAL_PER_WIDTH = 0.82  # fx / width: 62.7 degrees from left to right, as the sensors of TUM RGB-D and 7-Scenes
EYE_HEIGHT_M = 1.4  # of the camera above the floor, about which it goes up and down
DEPTH_SCALE = 5000.0
FRAME_RATE_HZ = 30.0
BETWEEN_ROOMS_M = 20.0  # from the middle of one room of a building to that of the next


@dataclass(frozen=True, slots=True)
class SyntheticOptions:
    """Options of `write_synthetic_recording`. Equal options make equal files.

    `room_seed` chooses furniture, layout and textures; `seed` the walk through the room, the noise and the lighting
    change. `lap_frames` is the number of frames in which the camera turns once around itself.
    `blur` is the share of the time between two frames during which the shutter is open. `lighting` scales a change
    of gain, colour and direction of the light (1 is strong). `second_visit` walks another way, some objects moved,
    and a share `taken` of the small ones taken away.
    With `person` somebody walks to and fro before the camera.
    Rooms to be confused with others: `furniture_seed` puts the furniture of another seed into the room, `alike` mirrors
    every texture (same shapes, same colours, another room), `desks` furnishes it with so many equal workplaces.
    `plain` paints everything in one colour each but for one picture on a wall: hardly any texture. `bare`
    besides leaves out all small things and gives the colours little contrast.
    Other cameras: `focal` is the focal length over the width, `eye_height` the metres of the camera above the floor,
    and `backwards` the walk of the same seed the other way round.
    `place` numbers the rooms of a building: each next one lies 20 m further along x in the world of the poses.
    Masks as a real detector's: of the instances of every frame a share `missed` is not there, and a share `confused`
    goes by the name of a class that detectors take it for.
    """

    frames: int = 120
    width: int = 640
    height: int = 480
    seed: int = 0
    room_seed: int = 0
    noise: bool = False
    blur: float = 0.0
    lighting: float = 0.0
    second_visit: bool = False
    taken: float = 0.0
    lap_frames: int = 120
    furniture_seed: int | None = None
    alike: bool = False
    plain: bool = False
    bare: bool = False
    desks: int = 0
    person: bool = False
    place: int = 0
    missed: float = 0.0
    confused: float = 0.0
    focal: float = FOCAL_PER_WIDTH
    eye_height: float = EYE_HEIGHT_M
    backwards: bool = False

    def __post_init__(self) -> None:
        """Raises UsageError naming the option that makes no sense."""
        limits: tuple[tuple[str, float, float], ...] = (
            ("frames", 1, 1_000_000),
            ("width", 16, 4096),
            ("height", 16, 4096),
            ("seed", 0, 2**32 - 1),
            ("room_seed", 0, 2**32 - 1),
            ("blur", 0.0, 1.0),
            ("lighting", 0.0, 1.0),
            ("taken", 0.0, 1.0),
            ("lap_frames", 8, 1_000_000),
            ("furniture_seed", 0, 2**32 - 1),
            ("desks", 0, 8),
            ("place", 0, 100_000),
            ("missed", 0.0, 1.0),
            ("confused", 0.0, 1.0),
            ("focal", 0.2, 3.0),
            ("eye_height", 0.3, 2.0),
        )
        for name, low, high in limits:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise UsageError(f"synthetic recording: {name} = {value} is outside {low:g} to {high:g}")

    @property
    def camera(self) -> Camera:
        """The pinhole camera that the recording is rendered with."""
        focal = self.focal * self.width
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)
