"""A small world of random points with descriptors, seen by cameras: the truth behind the localization tests."""

from __future__ import annotations

import numpy as np

from semdb.geometry import invert_pose, pose_from, project, so3_exp, transform_points
from semdb.localization.views import ClassNumbers, KeyframeView, View, make_keyframe_view, make_view
from semdb.types import Camera, Features, FloatArray, Keypoints

CAMERA = Camera(640, 480, 520.0, 521.0, 318.0, 241.0)
DISTORTED = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))


class Scene:
    """`count` points in front of the origin (2 to 4 m), each with a unit descriptor and an object class."""

    def __init__(self, seed: int = 0, count: int = 400) -> None:
        self.random = np.random.default_rng(seed)
        self.points = self.random.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 4.0], (count, 3))
        descriptors = self.random.normal(size=(count, 64))
        self.descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
        self.objects = self.random.integers(-1, 3, count)
        self.categories = ("chair", "cup", "tv")

    def pose(self, metres: float, degrees: float) -> FloatArray:
        direction = self.random.normal(size=(2, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return pose_from(so3_exp(direction[0] * np.radians(degrees)), direction[1] * metres)

    def keypoints(
        self, world_from_camera: FloatArray, camera: Camera = CAMERA, pixel_noise: float = 0.0, depth_noise: float = 0.0
    ) -> Keypoints:
        """What a camera at `world_from_camera` sees, sorted by object with the background last."""
        local = transform_points(invert_pose(world_from_camera), self.points)
        xy = project(camera, local)
        inside = (local[:, 2] > 0.3) & (xy > 0).all(axis=1) & (xy < [camera.width - 1, camera.height - 1]).all(axis=1)
        order = sorted(np.flatnonzero(inside), key=lambda i: (self.objects[i] < 0, self.objects[i]))
        count = len(order)
        noise = self.random.normal(size=(count, 64)).astype(np.float32) * 0.02
        descriptors = self.descriptors[order] + noise
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        scale = 1 + self.random.normal(size=(count, 1)) * depth_noise
        features = Features(
            xy=(xy[order] + self.random.normal(size=(count, 2)) * pixel_noise).astype(np.float32),
            size=np.full(count, 15.0, np.float32),
            angle=np.zeros(count, np.float32),
            response=np.ones(count, np.float32),
            laplacian=np.ones(count, np.int8),
            descriptors=descriptors,
        )
        return Keypoints(features, self.objects[order].astype(np.int32), (local[order] * scale).astype(np.float32))

    def query(self, pose: FloatArray, numbers: ClassNumbers, camera: Camera = CAMERA, **noise: float) -> View:
        return make_view(camera, self.keypoints(pose, camera, **noise), self.categories, numbers)

    def keyframe(
        self, keyframe_id: int, pose: FloatArray, numbers: ClassNumbers, camera: Camera = CAMERA, **noise: float
    ) -> KeyframeView:
        keypoints = self.keypoints(pose, camera, **noise)
        return make_keyframe_view(keyframe_id, camera, pose, keypoints, self.categories, numbers)
