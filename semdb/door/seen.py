"""What was seen in an image that belongs to no map: objects and keypoints, and a picture of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from semdb.door.values import SeenObject, png_bytes, save_image
from semdb.shown import for_terminal
from semdb.types import ImageArray, Keypoints, ModelInfo


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """An image as a map's models, or those of the settings, describe it.

    `pixels` is RGB uint8 ``[H, W, 3]``. Objects have places in the frame of the camera where there is depth, and none
    in a map. `keypoints` are without descriptors (``[n, 0]``).
    """

    image: str  # its path, or the name that was given with the array
    pixels: ImageArray = field(repr=False)
    objects: tuple[SeenObject, ...]
    keypoints: Keypoints = field(repr=False)
    models: tuple[ModelInfo, ...]

    def picture(self) -> ImageArray:
        """The image with its objects, RGB uint8 ``[H, W, 3]``."""
        from semdb.pictures.drawing import description_facts, draw_image

        facts = description_facts(len(self.objects), self.keypoints, points=False)
        detections = [thing.detection() for thing in self.objects]
        return draw_image(self.pixels, detections, title=Path(self.image).name, facts=facts)

    def save(self, path: str | Path) -> Path:
        """Writes the picture as a PNG or JPEG file. Returns its path."""
        return save_image(self.picture(), path)

    def __repr__(self) -> str:
        names = ", ".join(f"{thing.category} {thing.score:.2f}" for thing in self.objects) or "no object"
        return for_terminal(f"<{self.image}: {names}; {len(self.keypoints)} keypoints>")

    def _repr_png_(self) -> bytes:
        return png_bytes(self.picture())
