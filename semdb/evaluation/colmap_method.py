"""Method `colmap`: the peer COLMAP on the same keyframes, matched exhaustively and triangulated with known poses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, UsageError
from semdb.evaluation.colmap import (
    HALF_PIXEL,
    SEED,
    PosedImages,
    SiftExtractor,
    SiftImage,
    colmap_camera,
    image_points,
    load_pycolmap,
    verified_matches,
)
from semdb.geometry import invert_pose, pose_from
from semdb.types import Camera, Candidate, FloatArray, Frame, IntArray, Localization, ModelInfo, Verdict

STAGE_EXHAUSTIVE = "exhaustive"
MIN_INLIERS = 12  # as sift-reference


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    recording: str
    index: int
    camera: Camera
    sift: SiftImage
    point_of: IntArray  # [n] row of `points` per keypoint, -1 without a 3D point
    points: FloatArray  # [m, 3] world


@dataclass(slots=True, eq=False)
class _Pairs:
    """2D-3D pairs of one query with all keyframes."""

    query: list[IntArray]
    keypoint: list[IntArray]
    points: list[FloatArray]
    owner: list[IntArray]
    matched: npt.NDArray[np.int64]  # [keyframes] verified matches, with or without a 3D point


class ColmapReference:
    """SIFT over the keyframes, exhaustive matching, triangulation with the known poses; queries by 2D-3D pairs.

    Depth is not used: 3D points come from the images alone, as COLMAP has it. The number of pairs grows with the
    square of the number of keyframes. `keyframes` are (name of the recording, frame), and may be lazy.
    Raises ModelError without pycolmap, FrameError for a keyframe without a pose, UsageError for none at all.
    """

    models: tuple[ModelInfo, ...]

    def __init__(
        self,
        keyframes: Iterable[tuple[str, Frame]],
        *,
        map_name: str = "",
        progress: Callable[[str, int, int], None] | None = None,
    ) -> None:
        pycolmap = load_pycolmap()
        config = f'{{"colmap":"{pycolmap.COLMAP_version}","max_num_features":8192,"ratio":0.8}}'
        self.models = (ModelInfo("features", "colmap-sift", "", config),)
        self._map_name = map_name
        self._extractor = SiftExtractor()
        self._progress = progress
        names, frames, described = [], [], []
        total = len(keyframes) if isinstance(keyframes, Sequence) else 0
        for number, (name, frame) in enumerate(keyframes, start=1):
            if frame.world_from_camera is None:
                raise FrameError(f"{frame.name}: a keyframe of colmap needs a pose, and this frame has none")
            names.append((name, frame.index, frame.camera))
            frames.append(frame.world_from_camera)
            described.append(self._extractor.extract(frame.image))
            self._tell("SIFT of keyframes", number, max(number, total))
        if not names:
            raise UsageError("colmap needs at least one keyframe")
        self.poses: FloatArray = np.stack(frames)
        self._keyframes = self._triangulate(names, described)
        self._cameras: dict[Camera, object] = {}

    def __len__(self) -> int:
        """How many keyframes it has."""
        return len(self._keyframes)

    @property
    def names(self) -> list[tuple[str, int]]:
        """Recording and frame index of every keyframe."""
        return [(keyframe.recording, keyframe.index) for keyframe in self._keyframes]

    def localize(self, frame: Frame) -> Localization:
        """The pose of `frame`, or verdict `failed` below 12 inliers. There is no confidence (NaN) or covariance.

        Candidates are all keyframes with a verified match, most matches first; their ids are positions.
        """
        started = time.perf_counter()
        sift = self._extractor.extract(frame.image)
        described = time.perf_counter()
        pairs = self._match(frame.camera, sift)
        matched = time.perf_counter()
        rows, owner = np.concatenate(pairs.query), np.concatenate(pairs.owner)
        pose, inliers = self._solve(frame.camera, sift.xy[rows], np.concatenate(pairs.points))
        solved = time.perf_counter()
        counts = np.bincount(owner[inliers], minlength=len(self._keyframes))
        found = pose is not None and int(inliers.sum()) >= MIN_INLIERS
        best = int(np.argmax(counts)) if found else None
        shown = inliers & (owner == best) if found else np.zeros(len(rows), dtype=np.bool_)
        keyframe_rows = np.concatenate(pairs.keypoint)[shown]
        return Localization(
            verdict=Verdict.LOCALIZED if found else Verdict.FAILED,
            map_name=self._map_name,
            world_from_camera=pose if found else None,
            covariance=None,
            confidence=float("nan"),
            inliers=int(inliers.sum()),
            stage=STAGE_EXHAUSTIVE,
            candidates=self._candidates(pairs.matched, counts),
            ranked_share=0.0,
            keyframes_matched=len(self._keyframes),
            reason=f"{int(inliers.sum())} inliers of {len(rows)} 2D-3D pairs; {MIN_INLIERS} are needed",
            timing_ms={
                "features": 1e3 * (described - started),
                "match": 1e3 * (matched - described),
                "pose": 1e3 * (solved - matched),
                "total": 1e3 * (solved - started),
            },
            best_keyframe_id=best,
            query_xy=(sift.xy[rows][shown] - HALF_PIXEL).astype(np.float32) if found else None,
            keyframe_xy=None
            if best is None
            else (self._keyframes[best].sift.xy[keyframe_rows] - HALF_PIXEL).astype(np.float32),
        )

    def _triangulate(self, names: Sequence[tuple[str, int, Camera]], described: Sequence[SiftImage]) -> list[_Keyframe]:
        posed = PosedImages([camera for _, _, camera in names], described)
        pairs = [(a, b) for a in range(len(names)) for b in range(a + 1, len(names))]
        posed.match(pairs, lambda done, total: self._tell("matching pairs of keyframes", done, total))
        model = posed.triangulate(self.poses) if posed.geometries else None
        keyframes = []
        for i, ((name, index, camera), sift) in enumerate(zip(names, described, strict=True), start=1):
            point_of = np.full(len(sift.xy), -1, dtype=np.int32)
            points = np.empty((0, 3))
            if model is not None:
                rows, points = image_points(model, i)
                point_of[rows] = np.arange(len(rows))
            keyframes.append(_Keyframe(name, index, camera, sift, point_of, points))
        return keyframes

    def _match(self, camera: Camera, sift: SiftImage) -> _Pairs:
        none = np.empty(0, dtype=np.int32)
        pairs = _Pairs([none], [none], [np.empty((0, 3))], [none], np.zeros(len(self._keyframes), dtype=np.int64))
        own = self._camera(camera)
        for i, keyframe in enumerate(self._keyframes):
            found, _ = verified_matches(own, sift, keyframe.sift, self._camera(keyframe.camera))
            pairs.matched[i] = len(found)
            row = keyframe.point_of[found[:, 1]]
            has = row >= 0
            pairs.query.append(found[has, 0].astype(np.int32))
            pairs.keypoint.append(found[has, 1].astype(np.int32))
            pairs.points.append(keyframe.points[row[has]])
            pairs.owner.append(np.full(int(has.sum()), i, dtype=np.int32))
        return pairs

    def _solve(
        self, camera: Camera, xy: FloatArray, points: FloatArray
    ) -> tuple[FloatArray | None, npt.NDArray[np.bool_]]:
        """LO-RANSAC and refinement over distinct pairs; a point that several keyframes see counts once."""
        pycolmap = load_pycolmap()
        inliers = np.zeros(len(xy), dtype=np.bool_)
        if len(xy) < 4:
            return None, inliers
        distinct, back = np.unique(np.column_stack([xy, points]), axis=0, return_inverse=True)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.random_seed = SEED
        answer = pycolmap.estimate_and_refine_absolute_pose(
            distinct[:, :2], distinct[:, 2:], self._camera(camera), options
        )
        if answer is None:
            return None, inliers
        inliers = np.asarray(answer["inlier_mask"], dtype=np.bool_)[np.ravel(back)]
        matrix = np.asarray(answer["cam_from_world"].matrix())
        return invert_pose(pose_from(matrix[:, :3], matrix[:, 3])), inliers

    def _candidates(self, matched: npt.NDArray[np.int64], counts: npt.NDArray[np.intp]) -> tuple[Candidate, ...]:
        order = [int(i) for i in np.argsort(-matched, kind="stable") if matched[i] > 0]
        nan = float("nan")
        return tuple(
            Candidate(i, self._keyframes[i].recording, self._keyframes[i].index, nan, nan, int(counts[i]))
            for i in order
        )

    def _camera(self, camera: Camera) -> object:
        if camera not in self._cameras:
            self._cameras[camera] = colmap_camera(camera)
        return self._cameras[camera]

    def _tell(self, what: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(what, done, total)
