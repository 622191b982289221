"""A map of one walk and queries of another: what a second visit, other light, another camera cost, cause by cause.

    python -m bench.visits [--room N]... [RECORDING...] [--keyframes 12] [--queries 20] [--work DIR] [--json FILE]

Of each rendered room a map is made of one walk (48 frames once around, with the noise of a sensor); the queries are of
walks of their own, each with one thing changed and the last with all of them. Of a recording one half of its frames
makes the map and the other half asks, once each way, as they are and as a telephone would have taken them. Nobody
gives depth with a query. *Seen* are queries of which a keyframe sees at least 0.3: the others are not counted. Rooms,
maps and answers are kept in ``--work`` and ``--json``, so that a run goes on where it ended.

Networks are those of SEMDB_DETECTOR and SEMDB_ENCODER; rendered rooms have exact masks and gist.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.trust.images import Picture
from semdb.cli.options import load_settings
from semdb.database.store import open_store
from semdb.geometry import back_project, invert_pose, pixels_to_normalized, pose_error, project, transform_points
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings
from semdb.types import Camera, Float32Array, FloatArray, InstanceMasks, Verdict

FALSE, WITHIN = (0.25, 5.0), (0.05, 5.0)  # metres, degrees
SEEN = 0.3  # of the query, by one keyframe
STEP = 16  # pixels between the points of a query that are looked for
SAME_DEPTH = 0.1  # share
LAP = 48  # frames of the walk that a map is made of
FIRST_ROOM = 700  # seed of room 0: none that anything was chosen on
PHONE = "phone lens"
PHONE_WIDTH, PHONE_FOCAL = 960, 0.76  # pixels; over the width: 66 degrees
PHONE_LENS = (0.09, -0.18, 0.0005, -0.0004, 0.0)  # k1, k2, p1, p2, k3
RENDERED_FOR_PHONE = {"width": 1200, "height": 900, "focal": 0.62}  # what its image is made of
CROP = 0.8  # and of a recorded one so much remains
CAUSES: dict[str, dict[str, Any]] = {
    "another walk": {},
    "the other way round": {"backwards": True},
    "other light": {"lighting": 0.6},
    "furniture moved": {"second_visit": True},
    "0.9 m high": {"eye_height": 0.9},
    "1.7 m high": {"eye_height": 1.7},
    PHONE: RENDERED_FOR_PHONE,
    "all of it": {"backwards": True, "lighting": 0.6, "second_visit": True, "eye_height": 1.7, **RENDERED_FOR_PHONE},
}
SAME = "the same walk"


@dataclass(frozen=True, slots=True)
class Answer:
    """One query. `seen` is the share that the best keyframe sees; errors are infinite without a pose."""

    place: str
    cause: str
    frame: int
    seen: float
    verdict: str
    metres: float
    degrees: float
    confidence: float
    reason: str

    @property
    def is_localized(self) -> bool:
        return self.verdict == Verdict.LOCALIZED

    def within(self, limit: tuple[float, float]) -> bool:
        return self.metres <= limit[0] and self.degrees <= limit[1]


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """Frames that ask about a map; with `phone` as a telephone takes them."""

    cause: str
    recording: Recording
    entries: tuple[FrameEntry, ...]
    phone: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A map to be made of `keyframes`, and who asks about it."""

    name: str
    recording: Recording
    keyframes: tuple[FrameEntry, ...]
    visits: tuple[Visit, ...]


def phone_camera(width: int = PHONE_WIDTH, focal: float = PHONE_FOCAL) -> Camera:
    """One with a longer lens that bends lines."""
    height = round(width * 0.75)
    return Camera(width, height, focal * width, focal * width, (width - 1) / 2 + 4, (height - 1) / 2 - 3, PHONE_LENS)


def as_by_phone(picture: Picture, camera: Camera) -> Picture:
    """`picture` as `camera` would show it, with more contrast and as a JPEG; what it does not show is black."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = pixels_to_normalized(camera, np.column_stack([u.ravel(), v.ravel()]))
    points = np.column_stack([np.nan_to_num(rays, nan=1e3), np.ones(len(rays))])
    at = np.asarray(project(picture.camera, points), np.float32).reshape(camera.height, camera.width, 2)
    seen = np.asarray(cv2.remap(picture.image, at[..., 0], at[..., 1], cv2.INTER_AREA), np.uint8)
    curve = np.clip(np.rint(128 + 1.15 * (np.arange(256) - 122.0)), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", np.ascontiguousarray(curve[seen][..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    image = np.ascontiguousarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1])
    masks = picture.instances
    if masks is not None:
        labels = cv2.remap(masks.labels, at[..., 0], at[..., 1], cv2.INTER_NEAREST)
        masks = InstanceMasks(np.asarray(labels, masks.labels.dtype), masks.categories)
    return Picture(image, camera, masks)


def room(work: Path, number: int, keyframes: int, queries: int) -> Place:
    """A rendered room with all its visits, kept in `work`."""
    own = SyntheticOptions(frames=LAP, lap_frames=LAP, seed=number, room_seed=FIRST_ROOM + number, noise=True)
    name = f"room{number}"
    first = rendered(work / name, own)
    chosen = tuple(select_keyframes(first, count=keyframes))
    rest = [entry for entry in first.entries if entry not in chosen]
    visits = [Visit(SAME, first, tuple(evenly(rest, queries)))]
    for count, (cause, change) in enumerate(CAUSES.items()):
        options = replace(own, frames=queries, lap_frames=queries, seed=1000 + number, **change)
        recording = rendered(work / f"{name}-{count}-{queries}", options)
        visits.append(Visit(cause, recording, recording.entries, phone="focal" in change))
    return Place(f"{name}-{keyframes}", first, chosen, tuple(visits))


def rendered(folder: Path, options: SyntheticOptions) -> Recording:
    if not folder.exists():
        print(f"rendering {folder.name}", file=sys.stderr, flush=True)
        write_synthetic_recording(folder, options)
    return open_recordings(folder)[0]


def halves(recording: Recording, keyframes: int, queries: int) -> Iterator[Place]:
    """Two maps, of the first and of the second half of a recording; each is asked by the other half."""
    posed = [entry for entry in recording.entries if entry.world_from_camera is not None]
    parts = posed[: len(posed) // 2], posed[len(posed) // 2 :]
    for number, (own, other) in enumerate((parts, parts[::-1])):
        chosen = tuple(select_keyframes(replace(recording, entries=tuple(own)), count=keyframes))
        rest = tuple(evenly([entry for entry in own if entry not in chosen], queries))
        asked = tuple(evenly(other, queries))
        visits = (
            Visit(SAME, recording, rest),
            Visit("the other half", recording, asked),
            Visit(PHONE, recording, rest, phone=True),
        )
        yield Place(f"{recording.name}-half{number + 1}-{keyframes}", recording, chosen, visits)


def evenly(entries: Sequence[FrameEntry], count: int) -> list[FrameEntry]:
    if len(entries) <= count:
        return list(entries)
    return [entries[round(at)] for at in np.linspace(0, len(entries) - 1, count)]


def picture_of(visit: Visit, entry: FrameEntry) -> Picture:
    recording = visit.recording
    picture = Picture(recording.read_image(entry), recording.camera, recording.read_instances(entry))
    if not visit.phone:
        return picture
    if picture.camera.width > PHONE_WIDTH:  # rendered for it
        return as_by_phone(picture, phone_camera())
    # of what was recorded the middle, so that the lens sees nothing that is not there
    return as_by_phone(picture, phone_camera(focal=picture.camera.fx / picture.camera.width / CROP))


class Shown:
    """Which share of a query a keyframe of the map sees at most."""

    def __init__(self, recording: Recording, keyframes: Sequence[FrameEntry]) -> None:
        self._camera = recording.camera
        self._views = [(_pose(entry), recording.read_depth(entry)) for entry in keyframes]

    def share(self, recording: Recording, entry: FrameEntry) -> float:
        depth = recording.read_depth(entry)
        if depth is None:
            return 0.0
        v, u = np.mgrid[STEP // 2 : depth.shape[0] : STEP, STEP // 2 : depth.shape[1] : STEP]
        z = depth[v, u].ravel()
        known = np.isfinite(z) & (z > 0)
        if not known.any():
            return 0.0
        pixels = np.column_stack([u.ravel(), v.ravel()])[known]
        points = transform_points(_pose(entry), back_project(recording.camera, pixels, z[known]))
        return max(self._seen(pose, own, points) for pose, own in self._views if own is not None)

    def _seen(self, pose: FloatArray, depth: Float32Array, points: FloatArray) -> float:
        local = transform_points(invert_pose(pose), points)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.nan_to_num(np.asarray(project(self._camera, local)), nan=-1.0, posinf=-1.0, neginf=-1.0)
        inside = (local[:, 2] > 0.1) & (pixels >= 0).all(axis=1)
        inside &= (pixels < [self._camera.width - 1, self._camera.height - 1]).all(axis=1)
        at = np.rint(pixels[inside]).astype(int)
        z = local[inside, 2]
        return float(np.count_nonzero(np.abs(depth[at[:, 1], at[:, 0]] - z) < SAME_DEPTH * z) / len(points))


def _pose(entry: FrameEntry) -> FloatArray:
    assert entry.world_from_camera is not None
    return entry.world_from_camera


def answers(
    place: Place, settings: Settings, work: Path, done: set[tuple[str, str]], causes: Sequence[str] = ()
) -> Iterator[list[Answer]]:
    """Those of each visit that is not `done`, one after the other; the map is made where it is not in `work`."""
    waiting = [v for v in place.visits if (place.name, v.cause) not in done and (not causes or v.cause in causes)]
    if not waiting:
        return
    specs = specs_for_ingest(settings, (), has_masks=place.recording.categories is not None)
    describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
    path = work / f"{place.name}.sqlite3"
    if not path.exists():
        make_map(path, place, describer)
    shown = Shown(place.recording, place.keyframes)
    with open_store(f"sqlite:///{path}") as store:
        localizer = make_localizer(store, store.find_map("m"), "sql", settings=settings)
        for visit in waiting:
            made = []
            for entry in visit.entries:
                seen = shown.share(visit.recording, entry)
                if seen < SEEN:
                    continue
                picture = picture_of(visit, entry)
                description = describer.describe(picture.image, None, picture.camera, picture.instances)
                found = localizer.localize(description)
                error = (float("inf"), float("inf"))
                if found.world_from_camera is not None:
                    error = pose_error(found.world_from_camera, _pose(entry))
                made.append(
                    Answer(
                        place.name, visit.cause, entry.index, seen, str(found.verdict), *error,
                        found.confidence, found.reason,
                    )
                )  # fmt: skip
            yield made


def make_map(path: Path, place: Place, describer: Describer) -> None:
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    with open_store(f"sqlite:///{new}", create=True) as store:
        ingest_recording(place.recording, store, describer, IngestOptions(map_name="m"), entries=list(place.keyframes))
        refine_map(store, store.find_map("m"), kinds=FOR_LOCALIZATION)
    new.rename(path)


def show(found: Sequence[Answer]) -> None:
    """As a table of Markdown, by cause."""
    print(
        "| | seen | localized | false | median | within 5 cm, 5° | right pose, whatever the verdict |\n|" + "---|" * 7
    )
    for cause in dict.fromkeys(answer.cause for answer in found):
        own = [answer for answer in found if answer.cause == cause]
        sure = [answer for answer in own if answer.is_localized]
        middle = "-"
        if sure:
            metres, degrees = (
                float(np.median(values)) for values in zip(*((a.metres, a.degrees) for a in sure), strict=True)
            )
            middle = f"{metres:.4f} m, {degrees:.2f}°"
        false = sum(not answer.within(FALSE) for answer in sure)
        close = sum(answer.within(WITHIN) for answer in sure) / len(own)
        right = sum(answer.within(FALSE) for answer in own) / len(own)
        print(f"| {cause} | {len(own)} | {len(sure) / len(own):.1%} | {false} | {middle} | {close:.1%} | {right:.1%} |")


def started(parser: argparse.ArgumentParser, given: Sequence[str] | None) -> tuple[argparse.Namespace, list[Answer]]:
    """The arguments, with those of every bench of answers, and the answers that `--json` holds already."""
    parser.add_argument("--keyframes", type=int, default=12)
    parser.add_argument("--work", type=Path, help="rooms and maps are kept here and found again")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(given)
    cv2.setNumThreads(1)
    known = arguments.json is not None and arguments.json.exists()
    return arguments, [Answer(**values) for values in json.loads(arguments.json.read_text())] if known else []


def save(found: Sequence[Answer], file: Path | None) -> None:
    """Writes the answers, where a file is named."""
    if file is not None:
        file.write_text(json.dumps([asdict(answer) for answer in found], indent=1) + "\n")


def main(given: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--room", type=int, action="append", default=[], help="a rendered room, by number")
    parser.add_argument("--queries", type=int, default=20, help="of each walk")
    parser.add_argument("--causes", help="only these, separated by semicolons")
    arguments, found = started(parser, given)
    with tempfile.TemporaryDirectory() as folder:
        work = arguments.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        settings = load_settings()
        of_rooms = settings.model_copy(update={"detector": "recorded", "encoder": "gist"})
        places = [(room(work, n, arguments.keyframes, arguments.queries), of_rooms) for n in arguments.room]
        for path in arguments.recordings:
            for recording in open_recordings(path):
                places += [(place, settings) for place in halves(recording, arguments.keyframes, arguments.queries)]
        done = {(answer.place, answer.cause) for answer in found}
        causes = arguments.causes.split(";") if arguments.causes else []
        for place, own in places:
            for some in answers(place, own, work, done, causes):
                found += some
                save(found, arguments.json)
        asked = {place.name for place, _ in places}
    show([answer for answer in found if answer.place in asked])


if __name__ == "__main__":
    main()
