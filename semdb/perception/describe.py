"""The one way from an image to a description, for keyframes and queries alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import cv2

from semdb.errors import FrameError
from semdb.perception.detections import DetectionRules, rules_of
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.lifting import lift
from semdb.perception.objects import assign_to_objects, object_geometry, sort_by_object
from semdb.perception.protocols import Detector, Encoder, FeatureExtractor
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


class Describer:
    """A detector, an encoder and a local feature that together describe images, one after the other.

    `rules` say what is made of the detections; without them they are taken as they come.

    Each brings its own threads. The detector in a thread beside the others was measured: on two cores it saves 3 to
    8 % with SURF, and the times of the parts no longer add up to that of the whole.
    """

    def __init__(
        self,
        detector: Detector,
        encoder: Encoder,
        features: FeatureExtractor,
        rules: DetectionRules | None = None,
    ) -> None:
        self.detector = detector
        self.encoder = encoder
        self.features = features
        self.rules = rules or DetectionRules(masks=None)

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
        """All that can be said of an RGB `image` ``[H, W, 3]`` seen by `camera`.

        `depth` ``[H, W]`` is metres with NaN where missing, or None: then all points are NaN. ``timing_ms`` has the
        wall time of `detect`, `encode` and `features` (which includes objects and 3D points). Raises FrameError
        when sizes disagree, ModelError when a model fails, UsageError when the detector needs masks that the image
        does not bring.
        """
        _check_sizes(image, depth, camera)
        (detections, sightings), detect_ms = _timed(lambda: self._detect(image, instances))
        vector, encode_ms = _timed(lambda: self.encoder.encode(image))
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found, extract_ms = _timed(lambda: self.features.extract(grey, self.rules.still(detections)))
        (keypoints, geometry), lift_ms = _timed(lambda: _join(camera, depth, detections, found, self.rules.depth_gap))
        return Description(
            camera=camera,
            detections=detections,
            geometry=geometry,
            keypoints=keypoints,
            cnn_vector=vector,
            models=self.models,
            dynamic=frozenset(self.rules.dynamic),
            sightings=sightings,
            timing_ms={"detect": detect_ms, "encode": encode_ms, "features": extract_ms + lift_ms},
            grey=grey,
        )

    def _detect(
        self, image: ImageArray, instances: InstanceMasks | None
    ) -> tuple[tuple[Detection, ...], tuple[Sighting, ...]]:
        """What is kept as objects, and all that was seen, of the classes that count."""
        found = self.detector.detect(image, instances)
        counted = [d for d in found if self.rules.classes is None or d.category in self.rules.classes]
        sightings = tuple(d.sighting(image.shape[0]) for d in counted)
        return self.rules.apply([d for d in found if not d.weak]), sightings


def describer_from_specs(detector: str, encoder: str, features: str, settings: Settings) -> Describer:
    """The describer of three concrete specs (``auto`` is resolved before).

    Raises UsageError for a spec that is none, ModelError when a model's file is missing or is not what it should be.
    """
    from semdb.perception.features import load_features

    found = load_detector(detector, settings)
    return Describer(
        found, load_encoder(encoder, settings), load_features(features, settings), rules_of(settings, found)
    )


def _join(
    camera: Camera,
    depth: Float32Array | None,
    detections: tuple[Detection, ...],
    features: Features,
    depth_gap: float,
) -> tuple[Keypoints, tuple[ObjectGeometry, ...]]:
    owner = assign_to_objects(features.xy, [detection.mask for detection in detections])
    ordered, object_index = sort_by_object(features, owner)
    geometry = tuple(object_geometry(camera, depth, detection, depth_gap) for detection in detections)
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
