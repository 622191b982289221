"""Things of a map, what it covers and was asked, what viewers draw of it, and jobs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from semdb.client.problems import document_of, error_of
from semdb.client.reading import Reading, key_of, three
from semdb.client.transport import segment
from semdb.errors import NotFoundError, UsageError

if TYPE_CHECKING:
    from semdb.database.jobs import Job
    from semdb.database.landmark_reading import StoredLandmark, StoredRelation
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.query_log import LoggedQuery, QueryFilter
    from semdb.database.records import FailedItem, StoredImage
    from semdb.database.scene_reading import StoredSighting
    from semdb.localization.coverage import Coverage
    from semdb.pictures.cloud import Cloud

FORMATS = {"image/png": "png", "image/jpeg": "jpeg"}
MOST_QUERIES = 10_000


class Surveying(Reading):
    """Looks at what a map shows, covers and was asked."""

    def has_recording(self, name: str, map: str | None = None) -> bool:
        """Whether a map, or any, has a recording of that name. Raises NotFoundError for a map that is not there."""
        for where in [one.name for one in self.maps()] if map is None else [self.map(map).name]:
            path = f"/v1/maps/{segment(where)}/recordings/{segment(name)}"
            if self._transport.ask("GET", path, expected=(404,)).is_success:
                return True
        return False

    def check_keyframes(self, ids: Iterable[int]) -> None:
        """Raises NotFoundError, naming it, for a keyframe that is not there."""
        for keyframe_id in ids:
            self.keyframe(keyframe_id)

    def keyframe_files(self, keyframe_id: int) -> StoredImage:
        """The colour and depth files of a keyframe, bytes as recorded. Raises NotFoundError."""
        from semdb.database.records import StoredImage

        path = f"/v1/keyframes/{key_of(keyframe_id)}"
        colour = self._transport.ask("GET", f"{path}/image")
        depth = self._transport.ask("GET", f"{path}/depth", expected=(404,))
        known = (colour.content, FORMATS.get(colour.headers["content-type"], ""))
        if depth.is_success:
            scale, registration = depth.headers["semdb-depth-scale"], depth.headers.get("semdb-depth-registration", "")
            of_depth = (depth.content, FORMATS.get(depth.headers["content-type"], ""))
            return StoredImage(*known, *of_depth, float(scale), registration)
        if not str(document_of(depth).get("detail", "")).startswith("there is no depth of keyframe"):
            raise error_of(depth, self.url)
        return StoredImage(*known, None, "", None, "")

    def landmarks(
        self,
        map: str,
        *,
        category: str | None = None,
        state: str | None = None,
        after: int = 0,
        limit: int | None = None,
    ) -> list[StoredLandmark]:
        """The landmarks of a map by id, those of a class and state, `limit` of those after an id.

        Raises NotFoundError.
        """
        from semdb.client.things import landmark_of

        path = f"/v1/maps/{segment(map)}/landmarks"
        found = self._pages(path, limit, category=category, state=state, after=max(0, int(after)))
        return [landmark_of(one) for one in found]

    def relations(
        self,
        map: str,
        *,
        kind: str | None = None,
        landmark: int | None = None,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[StoredRelation]:
        """How the landmarks of a map stand to each other, or one to others, by both ids and kind.

        With `limit` so many of those after such a key. Raises NotFoundError.
        """
        from semdb.client.things import relation_of

        path = f"/v1/maps/{segment(map)}/relations"
        last = None if after is None else "-".join(str(part) for part in after)
        return [relation_of(one) for one in self._pages(path, limit, kind=kind, landmark=landmark, after=last)]

    def up(self, map: str) -> tuple[float, float, float] | None:
        """Which way is up in a map, a unit vector; None where nobody found out. Raises NotFoundError."""
        found = self._get(f"/v1/maps/{segment(map)}")["up"]
        return None if found is None else three(found)

    def coverage(self, map: str, position: Sequence[float] | None = None, *, radius_m: float = 2.0) -> Coverage:
        """How many keyframes are within `radius_m` of a place (X, Y, Z in metres), or at all, and where they look.

        Raises NotFoundError, UsageError for a place or radius that is none.
        """
        from semdb.client.things import coverage_of

        place = {} if position is None else dict(zip("xyz", three(position), strict=True))
        return coverage_of(self._get(f"/v1/maps/{segment(map)}/coverage", radius=float(radius_m), **place))

    def sightings(self, map: str, landmark: int) -> list[StoredSighting]:
        """The objects that show a landmark of a map, by time. Raises NotFoundError."""
        from semdb.client.things import sighting_of

        path = f"/v1/maps/{segment(map)}/landmarks/{_id(landmark, 'landmark')}/sightings"
        return [sighting_of(one) for one in self._pages(path, under="sightings")]

    def visits(self, map: str, landmark: int) -> list[LandmarkVisit]:
        """What each recording of a map says of a landmark: where it was, or that it was not there or not looked at.

        Raises NotFoundError.
        """
        from semdb.client.things import visit_of

        path = f"/v1/maps/{segment(map)}/landmarks/{_id(landmark, 'landmark')}/sightings"
        return [visit_of(one) for one in self._get(path, limit=1)["visits"]]

    def seen_in(self, keyframe_id: int) -> list[StoredSighting]:
        """The landmarks that a keyframe shows, with the objects that show them. Raises NotFoundError."""
        from semdb.client.things import sighting_of

        found = self._get(f"/v1/keyframes/{key_of(keyframe_id)}/landmarks")
        return [sighting_of(one) for one in found["sightings"]]

    def scene(self, map: str) -> dict[str, Any]:
        """All keyframes, landmarks and accepted links of a map, column by column. Raises NotFoundError."""
        found: dict[str, Any] = self._get(f"/v1/maps/{segment(map)}/scene")
        return found

    def cloud(self, map: str, points: int = 100_000) -> Cloud:
        """Up to so many coloured points of a map, in the steps of 1/65535 of its size that they are sent in.

        Raises NotFoundError, UsageError for a number that is none.
        """
        from semdb.pictures.cloud import Cloud

        found = self._transport.ask("GET", f"/v1/maps/{segment(map)}/points", params={"count": int(points)})
        return Cloud.unpacked(found.content)

    def queries(
        self, map: str, *, before: int | None = None, limit: int = 100, wanted: QueryFilter | None = None
    ) -> list[LoggedQuery]:
        """What was localized in a map, the newest first; `before` the id of the last one that is known already.

        With `wanted` only what it asks for. Folders of images are told to role admin only. Raises NotFoundError,
        UsageError for a limit that is none.
        """
        from semdb.client.things import query_of

        if not 1 <= limit <= MOST_QUERIES:
            raise UsageError(f"limit is between 1 and {MOST_QUERIES}, not {limit}")
        asked: dict[str, Any] = {} if wanted is None else {"verdict": wanted.verdict, "text": wanted.text}
        if wanted is not None:
            asked |= {"since": _moment(wanted.since), "until": _moment(wanted.until)}
        keyframe = None if wanted is None else wanted.keyframe_id
        path = f"/v1/maps/{segment(map)}/queries"
        return [query_of(one) for one in self._pages(path, limit, before=before, keyframe=keyframe, **asked)]

    def query(self, query_id: int) -> tuple[str, LoggedQuery]:
        """A logged localization, and the name of its map. Raises NotFoundError."""
        from semdb.client.things import query_of

        found = self._get(f"/v1/queries/{_id(query_id, 'query')}")
        return found["map"], query_of(found)

    def failures(self, recording: str, map: str) -> list[FailedItem]:
        """The keyframes of a recording that could not be stored, and why (role ingest). Raises NotFoundError."""
        from semdb.database.records import FailedItem

        path = f"/v1/maps/{segment(map)}/recordings/{segment(recording)}"
        found = list(self._pages(f"{path}/failures", under="failures"))
        known = self._get(path)["id"] if found else 0
        return [FailedItem(known, one["frame_index"], one["attempts"], one["error"]) for one in found]

    def job(self, job_id: int) -> Job:
        """What became of a job that a service was given (role ingest). Raises NotFoundError."""
        from semdb.client.things import job_of

        return job_of(self._get(f"/v1/jobs/{_id(job_id, 'job')}"))

    def jobs(self, map: str | None = None, *, before: int | None = None, limit: int = 100) -> list[Job]:
        """The newest jobs of whoever asks, of all for role admin; `before` the id of the last known one.

        What was asked is told by its `name` only, not by whom.
        """
        from semdb.client.things import job_of

        return [job_of(one) for one in self._pages("/v1/jobs", limit, map=map, before=before)]

    def pages(self, path: str, **parameters: Any) -> Iterator[Any]:
        """The items of a list of the service as JSON has them, page by page. Raises SemdbError."""
        return self._pages(path, **parameters)


def _moment(time: datetime | None) -> str | None:
    """A time as the library takes it: UTC where it does not say."""
    return None if time is None else time.isoformat() + ("" if time.tzinfo is not None else "Z")


def _id(value: int, what: str) -> int:
    number = int(value)
    if not 0 < number < 2**63:
        raise NotFoundError(f"there is no {what} {number}")
    return number
