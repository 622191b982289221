"""The one way from an image to a description, for keyframes and queries alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2

from semdb.errors import FrameError
from semdb.perception.box_masks import filled
from semdb.perception.detections import DetectionRules, Region, rules_of
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.lifting import lift
from semdb.perception.objects import assign_to_objects, object_geometry, sort_by_object
from semdb.perception.protocols import BatchDetector, BatchEncoder, Detector, Encoder, FeatureExtractor
from semdb.perception.quality import with_contrast
from semdb.settings import Settings
from semdb.types import (
    Camera,
    Description,
    Detection,
    Features,
    Float32Array,
    ImageArray,
    InstanceMasks,
    Keypoints,
    ModelInfo,
    ObjectGeometry,
    Sighting,
)

_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """An RGB `image` ``[H, W, 3]`` seen by `camera`, with what came with it.

    `depth` ``[H, W]`` is metres with NaN where missing, None where there is none: then all points are NaN. `instances`
    are the masks of a recording that brings them.
    """

    image: ImageArray
    depth: Float32Array | None
    camera: Camera
    instances: InstanceMasks | None = None


class Describer:
    """A detector, an encoder and a local feature that together describe images, one after the other or some at once.

    `rules` say what is made of the detections; without them they are taken as they come. `batch` is how many images
    `describe_batch` is best given at once: as told, or what is fastest where the networks run; 1 where neither network
    takes more.

    Each brings its own threads. The detector in a thread beside the others was measured: on two cores it saves 3 to
    8 % with SURF, and the times of the parts no longer add up to that of the whole.
    """

    def __init__(
        self,
        detector: Detector,
        encoder: Encoder,
        features: FeatureExtractor,
        rules: DetectionRules | None = None,
        batch: int | None = None,
    ) -> None:
        self.detector = detector
        self.encoder = encoder
        self.features = features
        self.rules = rules or DetectionRules(masks=None)
        self.batch = _images_at_once(detector, encoder, batch)

    @property
    def models(self) -> tuple[ModelInfo, ...]:
        """Provenance of what it makes: detector, encoder, features."""
        return self.rules.info(self.detector.info), self.encoder.info, self.features.info

    def describe(
        self,
        image: ImageArray,
        depth: Float32Array | None,
        camera: Camera,
        instances: InstanceMasks | None = None,
    ) -> Description:
        """All that can be said of an image; the arguments are those of `View`.

        ``timing_ms`` has the wall time of `detect`, `encode` and `features` (which includes objects and 3D points).
        Raises FrameError when sizes disagree, ModelError when a model fails, UsageError when the detector needs masks
        that the image does not bring.
        """
        return self.describe_batch([View(image, depth, camera, instances)])[0]

    def describe_batch(self, views: Sequence[View]) -> list[Description]:
        """What `describe` says of each of `views`, within rounding; networks that can take them all at once.

        So a GPU is kept busy: each image alone is too little work for it. On a CPU it brings nothing. Images of one
        size go through a network together; how many fit into the device's memory is for the caller to choose. Times of
        networks are equal shares of the whole. Raises what `describe` raises.
        """
        for view in views:
            _check_sizes(view.image, view.depth, view.camera)
        shown = [with_contrast(view.image) for view in views]
        stretches = [stretch for _, stretch in shown]
        views = [replace(view, image=image) for view, (image, _) in zip(views, shown, strict=True)]
        found, detect_ms = _timed(lambda: self._detect(views))
        vectors, encode_ms = _timed(lambda: self._encode([view.image for view in views]))
        shares = {"detect": detect_ms / max(1, len(views)), "encode": encode_ms / max(1, len(views))}
        return [self._finish(*each, shares) for each in zip(views, found, vectors, stretches, strict=True)]

    def _detect(self, views: Sequence[View]) -> list[tuple[Detection, ...]]:
        """What the detector finds, before the rules; boxes of detectors without masks are filled."""
        found = self._found(views)
        if not getattr(self.detector, "boxes_only", False):
            return found
        return [filled(own, view.depth, view.image.shape[:2]) for own, view in zip(found, views, strict=True)]

    def _found(self, views: Sequence[View]) -> list[tuple[Detection, ...]]:
        if isinstance(self.detector, BatchDetector):
            return self.detector.detect_batch([view.image for view in views])
        return [self.detector.detect(view.image, view.instances) for view in views]

    def _encode(self, images: Sequence[ImageArray]) -> Sequence[Float32Array]:
        if isinstance(self.encoder, BatchEncoder) and len(images):
            return list(self.encoder.encode_batch(images))
        return [self.encoder.encode(image) for image in images]

    def _finish(
        self,
        view: View,
        found: tuple[Detection, ...],
        vector: Float32Array,
        stretch: tuple[float, float] | None,
        timing_ms: dict[str, float],
    ) -> Description:
        (regions, sightings), rules_ms = _timed(lambda: self._judge(found, view.image.shape[0]))
        detections = tuple(region.detection for region in regions)
        grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        features, extract_ms = _timed(lambda: self.features.extract(grey, self.rules.still(detections)))
        (keypoints, geometry), lift_ms = _timed(
            lambda: _join(view.camera, view.depth, regions, features, self.rules.depth_gap)
        )
        return Description(
            camera=view.camera,
            detections=detections,
            geometry=geometry,
            keypoints=keypoints,
            cnn_vector=vector,
            models=self.models,
            dynamic=frozenset(self.rules.dynamic),
            sightings=sightings,
            timing_ms={
                "detect": timing_ms["detect"] + rules_ms,
                "encode": timing_ms["encode"],
                "features": extract_ms + lift_ms,
            },
            grey=grey,
            depth=view.depth,
            stretch=stretch,
        )

    def _judge(self, found: tuple[Detection, ...], height: int) -> tuple[tuple[Region, ...], tuple[Sighting, ...]]:
        """What is kept as objects, and all that was seen, of the classes that count."""
        counted = [d for d in found if self.rules.classes is None or d.category in self.rules.classes]
        sightings = tuple(d.sighting(height) for d in counted)
        return self.rules.regions([d for d in found if not d.weak]), sightings


def describer_from_specs(detector: str, encoder: str, features: str, settings: Settings) -> Describer:
    """The describer of three concrete specs (``auto`` is resolved before).

    Raises UsageError for a spec that is none, ModelError when a model's file is missing or is not what it should be.
    """
    from semdb.perception.features import load_features

    found = load_detector(detector, settings)
    batch = None if settings.batch == "auto" else settings.batch
    return Describer(
        found, load_encoder(encoder, settings), load_features(features, settings), rules_of(settings, found), batch
    )


def _images_at_once(detector: Detector, encoder: Encoder, wanted: int | None) -> int:
    best = [detector.best_batch] if isinstance(detector, BatchDetector) else []
    best += [encoder.best_batch] if isinstance(encoder, BatchEncoder) else []
    return (wanted or max(best)) if best else 1


def _join(
    camera: Camera,
    depth: Float32Array | None,
    regions: tuple[Region, ...],
    features: Features,
    depth_gap: float,
) -> tuple[Keypoints, tuple[ObjectGeometry, ...]]:
    masks, areas = [region.detection.mask for region in regions], [region.area for region in regions]
    ordered, object_index = sort_by_object(features, assign_to_objects(features.xy, masks, areas))
    geometry = tuple(object_geometry(camera, depth, r.detection, depth_gap, r.window) for r in regions)
    return Keypoints(ordered, object_index, lift(camera, depth, ordered.xy)), geometry


def _timed(work: Callable[[], _Result]) -> tuple[_Result, float]:
    start = time.perf_counter()
    result = work()
    return result, 1000 * (time.perf_counter() - start)


def _check_sizes(image: ImageArray, depth: Float32Array | None, camera: Camera) -> None:
    height, width = image.shape[:2]
    if (camera.width, camera.height) != (width, height):
        raise FrameError(
            f"the image is {width}x{height} but its camera is {camera.width}x{camera.height}: "
            "give the camera of this image (--camera fx,fy,cx,cy)"
        )
    if depth is not None and depth.shape != (height, width):
        raise FrameError(
            f"the depth image is {depth.shape[1]}x{depth.shape[0]} but the image is {width}x{height}: "
            "depth must be registered to the image and of its size"
        )
