"""Images to what is seen in them, without asking where they were taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from semdb.api.localizing import Localizing
from semdb.door.seen import Seen
from semdb.door.values import SeenObject
from semdb.errors import FrameError, NotFoundError, SchemaError

if TYPE_CHECKING:
    from semdb.localization.query_image import Depth, Image, PathText, QueryImage
    from semdb.perception.describe import Describer
    from semdb.recordings.arrays import CameraLike
    from semdb.types import Description


class Describing(Localizing):
    """Says what is to be seen in images."""

    def describe(
        self,
        image: Image,
        *,
        map: str | None = None,
        depth: Depth | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        name: str | None = None,
    ) -> Seen:
        """The objects and keypoints of an image, as they would be described for a query; arguments as of `localize`.

        The models are those of the `map`, without one those of the first map that can be asked, and where there is
        none those of the settings. Without `depth` no camera is needed. Raises FrameError, NotFoundError for a map
        that is not there, UsageError where no detector is at hand, ModelError, DatabaseError.
        """
        depths = None if depth is None else [depth]
        names = None if name is None else [name]
        return next(
            self.describe_each(
                [image], map=map, depth=depths, camera=camera, depth_scale=depth_scale, like=like, names=names
            )
        )

    def describe_each(
        self,
        images: Sequence[Image],
        *,
        map: str | None = None,
        depth: Sequence[Depth | None] | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        names: Sequence[str | None] | None = None,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Seen]:
        """As `describe`, one by one. An image that cannot be read is told to `unreadable`, where that is given."""
        from semdb.localization.query_image import QueryReader
        from semdb.recordings.arrays import as_camera

        try:
            maps = self._here.maps().asked(map, "sql")
        except (SchemaError, NotFoundError):
            if map is not None:
                raise
            maps = []  # no database yet, or an empty one
        reader = QueryReader(
            camera=None if camera is None else as_camera(camera),
            like=None if like is None else self._like(maps, str(like)),
            known=lambda: self._here.maps().cameras(maps) if maps else [],
            used=lambda: self._here.maps().used_cameras(maps) if maps else [],
            depth_scale=depth_scale,
            on_disk=self._here.on_disk(),
            say=self._say,
            nominal=True,
        )
        describer = maps[0].describer if maps else None
        if len(maps) > 1 and map is None:
            self._say(f"described by the models of map {maps[0].head.name!r}; --map names another")
        for number, image in enumerate(images):
            name = None if names is None else names[number]
            try:
                query = reader.read(image, depth[number] if depth else None, name, number if len(images) > 1 else None)
                describer = describer or self._own_describer(query)
                description = describer.describe(query.image, query.depth, query.camera, query.instances)
            except FrameError as error:
                if unreadable is None:
                    raise
                unreadable(error)
                continue
            yield _seen(query, description)

    def _own_describer(self, query: QueryImage) -> Describer:
        """The models of the settings, as an ingest would choose them."""
        from semdb.perception.describe import describer_from_specs
        from semdb.perception.model_choice import specs_for_ingest

        specs = specs_for_ingest(self.settings, (), has_masks=query.instances is not None)
        for note in specs.notes:
            if note.startswith("SEMDB_DETECTOR"):  # of the place vector nothing is seen
                self._say(note)
        return describer_from_specs(specs.detector, specs.encoder, specs.features, self.settings)


def _seen(query: QueryImage, description: Description) -> Seen:
    objects = tuple(
        SeenObject.of(
            thing.category,
            thing.score,
            thing.box,
            thing.mask,
            centroid=shape.centroid,
            extent=shape.extent,
            world_from_camera=np.eye(4),
        )
        for thing, shape in zip(description.detections, description.geometry, strict=True)
    )
    features = description.keypoints.features
    light = replace(features, descriptors=np.empty((len(features), 0), np.float32))
    keypoints = replace(description.keypoints, features=light)
    return Seen(query.name, query.image, objects, keypoints, description.models)
