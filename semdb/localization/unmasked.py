"""Queries without masks in maps whose objects are masks that their recordings brought.

Such a map's detector finds nothing in an image by itself. The image is localized all the same: without objects no
keyframe is filtered by class, all of them are ranked by their vectors, and keypoints are matched over the whole image.
Ingest and `Describer` go on refusing such images: a keyframe without objects would be a lie.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semdb.localization.query_image import QueryImage
from semdb.perception.describe import Describer
from semdb.types import Description, InstanceMasks, Localization

REASON = "the image has no masks of its own: nothing is filtered by class"


def lacks_masks(describer: Describer, query: QueryImage) -> bool:
    """Whether the map's objects come with recordings, and none with this image."""
    return query.instances is None and getattr(describer.detector, "needs_masks", False)


def describe_query(describer: Describer, query: QueryImage) -> Description:
    """The description of a query; one without objects where the image lacks masks. Raises what `describe` raises."""
    instances = query.instances
    if lacks_masks(describer, query):
        instances = InstanceMasks(np.zeros(query.image.shape[:2], np.uint16), {})
    return describer.describe(query.image, query.depth, query.camera, instances)


def with_reason(found: Localization) -> Localization:
    """The same, and its reason says that nothing was filtered by class."""
    return replace(found, reason="; ".join(filter(None, (found.reason, REASON))))


def said_of(map_name: str) -> str:
    """What is said to whoever asks, once."""
    return (
        f"objects of map {map_name!r} are masks that its recordings brought; an image without masks is localized "
        "without objects: nothing is filtered by class"
    )
