"""Maps exported and read back: by semdb's own readers, by pycolmap, evo's format, and by another database."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from semdb import open as semdb_open
from semdb.database import schema, tables
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.errors import RecordingError, SchemaError, UsageError
from semdb.exchange import ply
from semdb.exchange.formats import FORMATS, export_map
from semdb.exchange.ply import voxels
from semdb.exchange.source import ExportOptions, MapSource, folder_names
from semdb.exchange.tracks import View, find_tracks, matches
from semdb.exchange.whole import MANIFEST, ROWS, import_whole
from semdb.geometry import pose_error, pose_from, project, so3_exp
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import decode_depth, open_recording
from semdb.recordings.association import read_trajectory
from semdb.settings import Settings
from semdb.types import Camera
from tests.rooms import semdb, semdb_json

KEYFRAMES = 6


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", threads=1)


@pytest.fixture(scope="module")
def map_url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    url = f"sqlite:///{tmp_path_factory.mktemp('exchange') / 'm.sqlite3'}"
    ingest_recordings([room], settings(url), IngestOptions(map_name="m", keyframes=KEYFRAMES))
    return url


def heads(store: Store, name: str = "m"):  # type: ignore[no-untyped-def]
    return sorted(store.keyframe_heads(map_id=store.find_map(name).id), key=lambda head: head.frame_index)


def test_tum(map_url: str, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        assert export_map(store, "tum", "m", tmp_path / "t.txt") == f"{KEYFRAMES} poses"
        expected = heads(store)
    found, notes = read_trajectory(tmp_path / "t.txt")
    assert notes == []
    assert found.time_ns.tolist() == [head.timestamp_ns for head in expected]
    np.testing.assert_allclose(found.translation, [head.world_from_camera[:3, 3] for head in expected], atol=1e-8)


@pytest.mark.parametrize("form", ["kapture", "mcap", "colmap"])
def test_a_map_that_is_exported_is_the_same_recording(map_url: str, tmp_path: Path, form: str) -> None:
    """The same images bit for bit, the same poses and depth within rounding."""
    out = tmp_path / ("out.mcap" if form == "mcap" else "out")
    with open_store(map_url) as store:
        export_map(store, form, "m", out)
        expected = heads(store)
        images = [store.load_image(head.id) for head in expected]
    recording = open_recording(out)
    assert len(recording.entries) == KEYFRAMES
    for frame, head, image in zip(recording.frames(), expected, images, strict=True):
        assert frame.image_bytes == image.rgb
        assert frame.world_from_camera is not None
        assert max(pose_error(frame.world_from_camera, head.world_from_camera)) < 1e-5
        np.testing.assert_allclose(
            [frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy],
            [head.camera.fx, head.camera.fy, head.camera.cx, head.camera.cy],
            atol=1e-9,
        )
        if form == "colmap":
            assert frame.depth is None
            continue
        assert frame.depth is not None
        depth = decode_depth(image.depth or b"", "d", image.depth_scale or 0, (head.camera.width, head.camera.height))
        assert np.nanmax(np.abs(frame.depth - depth)) <= (6e-4 if form == "mcap" else 1.1e-4)
        assert (np.isfinite(frame.depth) == np.isfinite(depth)).all()
        if form == "mcap":
            assert frame.timestamp_ns == head.timestamp_ns


def test_images_are_localized_alike_in_an_imported_map(map_url: str, room: Path, tmp_path: Path) -> None:
    other = f"sqlite:///{tmp_path / 'o.sqlite3'}"
    with open_store(map_url) as store:
        export_map(store, "semdb", "m", tmp_path / "out")
    with open_store(other, create=True) as store:
        import_whole(tmp_path / "out", store)
    images = [entry.image_path for entry in open_recording(room).entries[::8]]
    found = []
    for url in (map_url, other):
        with semdb_open(url, detector="recorded", encoder="gist", threads=1) as database:
            found.append(list(database.localize(images, map="m")))
    for one, two in zip(*found, strict=True):
        assert (one.verdict, one.inliers, one.confidence) == (two.verdict, two.inliers, two.confidence)
        assert one.world_from_camera is not None
        np.testing.assert_array_equal(one.world_from_camera, two.world_from_camera)


def test_images_are_localized_alike_in_maps_of_what_was_exported(
    room: Path, tmp_path: Path, networks: dict[str, str]
) -> None:
    """A recording, exported in the formats that keep depth, ingested again: the same keypoints, the same answers."""
    url = f"sqlite:///{tmp_path / 'm.sqlite3'}"
    own = Settings(database_url=url, threads=1, check_recordings=False, **networks)  # type: ignore[arg-type]
    ingest_recordings([room], own, IngestOptions(map_name="m", keyframes=KEYFRAMES))
    forms = ("kapture", "mcap")
    for form in forms:
        with open_store(url) as store:
            export_map(store, form, "m", tmp_path / f"out.{form}")
        ingest_recordings([tmp_path / f"out.{form}"], own, IngestOptions(map_name=form, stride=1))
    recording = open_recording(room)
    images = [entry.image_path for entry in recording.entries[1::8]]
    with semdb_open(url, threads=1, **networks) as database:
        answers = {name: list(database.localize(images, map=name, like=room)) for name in ("m", *forms)}
    assert all(answer.verdict == "localized" for answer in answers["m"])
    for form in forms:
        for one, two in zip(answers["m"], answers[form], strict=True):
            assert two.verdict == one.verdict
            assert one.world_from_camera is not None
            assert two.world_from_camera is not None
            metres, degrees = pose_error(one.world_from_camera, two.world_from_camera)
            assert metres < 1e-3  # depth of mcap is in millimetres
            assert degrees < 0.02
            assert abs(one.inliers - two.inliers) <= 0.02 * one.inliers


def test_colmap_is_read_by_pycolmap_and_points_fit_their_pixels(map_url: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    with open_store(map_url) as store:
        about = export_map(store, "colmap", "m", tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.num_images() == KEYFRAMES
    assert model.num_points3D() > 100, about
    assert model.compute_mean_reprojection_error() < 1.5
    # our own errors are those that pycolmap computes anew
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1.5
    image = next(iter(model.images.values()))
    assert (tmp_path / "out" / "images" / image.name).is_file()


def test_an_image_is_localized_by_pycolmap_against_the_exported_points(
    map_url: str, room: Path, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    with open_store(map_url) as store:
        export_map(store, "colmap", "m", tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    image = max(model.images.values(), key=lambda item: item.num_points3D)
    seen = [point for point in image.points2D if point.has_point3D()]
    pixels = np.array([point.xy for point in seen])
    points = np.array([model.points3D[point.point3D_id].xyz for point in seen])
    answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, model.cameras[image.camera_id])
    assert answer is not None
    off = answer["cam_from_world"].matrix() - image.cam_from_world().matrix()
    assert np.abs(off).max() < 0.02


def test_ply(map_url: str, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        about = export_map(store, "ply", "m", tmp_path / "c.ply", ExportOptions(voxel_m=0.05))
    data = (tmp_path / "c.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    assert about.startswith(f"{count} points, one in 5 cm")
    rows = np.frombuffer(body, np.dtype([("p", "<f4", 3), ("c", "u1", 3)]))
    assert len(rows) == count > 500
    assert len(np.unique(voxels(rows["p"].astype(float), 0.05))) == count
    assert rows["c"].std() > 10


def rows_of_rrd(path: Path) -> dict[str, dict[int, object]]:
    """The first value of each component by entity and name, by keyframe (-1: all of them)."""
    chunk = pytest.importorskip("rerun.chunk")
    found: dict[str, dict[int, object]] = {}
    for part in chunk.RrdReader(str(path)).stream():
        batch = part.to_record_batch().to_pydict()
        assert "log_time" not in batch
        for name, values in batch.items():
            for row, value in enumerate(values):
                if ":" in name and value:
                    number = batch["keyframe"][row] if "keyframe" in batch else -1
                    found.setdefault(f"{part.entity_path}:{name}", {})[number] = value[0]
                    if "time" in batch:
                        found.setdefault(f"{part.entity_path}:time", {})[number] = batch["time"][row]
    return found


def test_numbers_that_were_there_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "LATE", 40)
    rng, seen, known = np.random.default_rng(0), ply._Seen(), set[int]()
    for _ in range(60):
        keys = np.unique(rng.integers(0, 2000, 100).astype(np.uint64))
        assert seen.add(keys).tolist() == [key not in known for key in keys.tolist()]
        known |= set(keys.tolist())


def test_rrd_is_read_back_by_rerun(map_url: str, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        about = export_map(store, "rrd", "m", tmp_path / "m.rrd")
        expected = heads(store)
        images = [store.load_image(head.id) for head in expected]
    assert about == f"{KEYFRAMES} cameras, {KEYFRAMES} with depth"
    rows = rows_of_rrd(tmp_path / "m.rrd")
    camera = "/map/room/camera"
    for number, (head, image) in enumerate(zip(expected, images, strict=True)):
        place = rows[f"{camera}:Transform3D:translation"][number]
        np.testing.assert_allclose(place, head.world_from_camera[:3, 3], atol=1e-6)
        turn = np.reshape(rows[f"{camera}:Transform3D:mat3x3"][number], (3, 3)).T  # column by column
        np.testing.assert_allclose(turn, head.world_from_camera[:3, :3], atol=1e-6)
        matrix = np.reshape(rows[f"{camera}:Pinhole:image_from_camera"][number], (3, 3)).T
        np.testing.assert_allclose([matrix[0, 0], matrix[1, 2]], [head.camera.fx, head.camera.cy], rtol=1e-6)
        assert bytes(rows[f"{camera}/image:EncodedImage:blob"][number]) == image.rgb  # type: ignore[arg-type]
        assert bytes(rows[f"{camera}/depth:EncodedDepthImage:blob"][number]) == image.depth  # type: ignore[arg-type]
        assert rows[f"{camera}/depth:EncodedDepthImage:meter"][number] == image.depth_scale
        assert np.datetime64(rows[f"{camera}:time"][number], "us") == np.datetime64(
            head.timestamp_ns or 0, "ns"
        ).astype(  # type: ignore[call-overload]
            "datetime64[us]"
        )
    way = rows["/map/room/path:LineStrips3D:strips"][-1]
    np.testing.assert_allclose(way, [head.world_from_camera[:3, 3] for head in expected], atol=1e-6)


def test_rrd_needs_its_extra_and_rerun_to_be_on(map_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_store(map_url) as store:
        monkeypatch.setitem(sys.modules, "rerun", None)
        with pytest.raises(UsageError, match=r"needs the rerun extra: pip install 'semdb\[rerun\]'"):
            export_map(store, "rrd", "m", tmp_path / "m.rrd")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported(map_url: str, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        with pytest.raises(UsageError, match="there is no format 'obj'; there are tum, colmap"):
            export_map(store, "obj", "m", tmp_path / "x")
        for form in FORMATS:
            (tmp_path / form).mkdir()
            (tmp_path / form / "mine").write_text("keep")
            with pytest.raises(UsageError, match="is there already"):
                export_map(store, form, "m", tmp_path / form)
            assert [file.name for file in (tmp_path / form).iterdir()] == ["mine"]
        for wrong in (
            {"voxel_m": np.nan},
            {"voxel_m": 0.0},
            {"voxel_m": 1e-9},
            {"max_depth_m": np.nan},
            {"max_depth_m": -1.0},
        ):
            with pytest.raises(UsageError, match=r"--voxel must be 0\.001 metres or more|--max-depth must be positive"):
                export_map(store, "ply", "m", tmp_path / "m.ply", ExportOptions(**wrong))
        with pytest.raises(UsageError, match="there is no such folder"):
            export_map(store, "tum", "m", tmp_path / "no" / "t.txt")


@pytest.mark.parametrize("form", ["colmap", "kapture", "semdb"])
def test_a_folder_that_was_empty_is_so_again_when_an_export_fails(
    map_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    def stop(self: MapSource, what: str, done: int, total: int | None = None) -> None:
        assert any(tmp_path.iterdir())
        raise KeyboardInterrupt

    monkeypatch.setattr(MapSource, "tell", stop)
    with open_store(map_url) as store, pytest.raises(KeyboardInterrupt):
        export_map(store, form, "m", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_rerun_cannot_write_is_named(map_url: str) -> None:
    pytest.importorskip("rerun")
    with open_store(map_url) as store, pytest.raises(UsageError, match=r"^/proc/m\.rrd: cannot be written: "):
        export_map(store, "rrd", "m", Path("/proc/m.rrd"))


def rows_of(url: str, name: str) -> dict[str, list[tuple[object, ...]]]:
    """All rows of a map without ids and times, by table."""
    with open_store(url) as store, store.engine.connect() as connection:
        found: dict[str, list[tuple[object, ...]]] = {}
        for table in tables.metadata.sorted_tables:
            if table.name in (
                "maps",
                "queries",
                "keyframe_changes",
                "refinements",
                "map_completions",
                "landmark_parts",
            ):
                continue
            columns = [
                c for c in table.columns if not c.foreign_keys and c.name not in ("id", "created_at", "finished_at")
            ]
            rows = [tuple(row) for row in connection.execute(select(*columns))] if columns else []
            found[table.name] = sorted(rows, key=repr)
        return found


def test_a_whole_map_travels_between_servers(map_url: str, empty_url: str, tmp_path: Path) -> None:
    """Every row is there, blobs bit for bit; again it adds nothing; refinements stay current."""
    from semdb.refinement.run import refine_map

    with open_store(map_url) as store:
        refine_map(store, store.find_map("m"))
        export_map(store, "semdb", "m", tmp_path / "out")
    engine = make_engine(empty_url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(empty_url) as store:
        done = import_whole(tmp_path / "out", store)
        assert (done.map, done.recordings, done.keyframes, done.skipped) == ("m", 1, KEYFRAMES, 0)
        again = import_whole(tmp_path / "out", store)
        assert (again.recordings, again.keyframes, again.skipped) == (0, 0, KEYFRAMES)
        assert len(store.changes_since(store.find_map("m").id, 0)) == KEYFRAMES
        assert [refinement.current for refinement in store.refinements()] == [True] * 4
    assert rows_of(empty_url, "m") == rows_of(map_url, "m")


def test_damaged_and_foreign_folders_are_not_imported(map_url: str, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        export_map(store, "semdb", "m", tmp_path / "out")
    url = f"sqlite:///{tmp_path / 'n.sqlite3'}"
    with open_store(url, create=True) as store:
        with pytest.raises(RecordingError, match=r"is no map that `semdb export semdb` wrote"):
            import_whole(tmp_path, store)
        file = tmp_path / "out" / ROWS
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
        with pytest.raises(RecordingError, match="is not as it was exported"):
            import_whole(tmp_path / "out", store)
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
        manifest = json.loads((tmp_path / "out" / MANIFEST).read_text())
        (tmp_path / "out" / MANIFEST).write_text(json.dumps(manifest | {"revision": "9999"}))
        with pytest.raises(SchemaError, match="has schema revision 9999"):
            import_whole(tmp_path / "out", store)
        assert store.maps() == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("DELETE FROM maps", "holds 0 maps, but an export has one"),
        (
            "DROP TABLE alembic_version",
            "is no map that `semdb export semdb` wrote: there is no semdb schema in map.sqlite3",
        ),
    ],
)
def test_exports_with_other_rows_and_their_checksum(map_url: str, tmp_path: Path, change: str, message: str) -> None:
    with open_store(map_url) as store:
        export_map(store, "semdb", "m", tmp_path / "out")
    file, manifest = tmp_path / "out" / ROWS, tmp_path / "out" / MANIFEST
    with contextlib.closing(sqlite3.connect(file)) as connection, connection:
        connection.execute(change)
    said = json.loads(manifest.read_text()) | {"sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    manifest.write_text(json.dumps(said))
    with open_store(f"sqlite:///{tmp_path / 'n.sqlite3'}", create=True) as store:
        with pytest.raises(RecordingError, match=message) as caught:
            import_whole(tmp_path / "out", store)
        assert str(file) in str(caught.value)
        assert store.maps() == []


def test_a_map_of_the_name_with_another_recording_is_not_added_to(map_url: str, room: Path, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        export_map(store, "semdb", "m", tmp_path / "out")
    shutil.copytree(room, tmp_path / "office")
    url = f"sqlite:///{tmp_path / 'n.sqlite3'}"
    ingest_recordings([tmp_path / "office"], settings(url), IngestOptions(map_name="m", keyframes=3))
    with open_store(url) as store:
        with pytest.raises(UsageError, match="has another recording 'office' already"):
            import_whole(tmp_path / "out", store)
        assert [info.keyframes for info in store.maps()] == [3]


def test_another_recording_of_the_name_is_not_mixed_in(map_url: str, room: Path, tmp_path: Path) -> None:
    with open_store(map_url) as store:
        export_map(store, "semdb", "m", tmp_path / "out")
    url = f"sqlite:///{tmp_path / 'n.sqlite3'}"
    ingest_recordings([room], settings(url), IngestOptions(map_name="m", keyframes=3))
    with open_store(url) as store:
        with pytest.raises(UsageError, match=r"has another recording 'room' already: .* with --map"):
            import_whole(tmp_path / "out", store)
        for name in ("", "a\nb", "x" * 256):
            with pytest.raises(UsageError, match="cannot be the name of a map"):
                import_whole(tmp_path / "out", store, name)
        assert import_whole(tmp_path / "out", store, "caf\\udce9").map == "caf\\udce9"  # as it is written, once
        done = import_whole(tmp_path / "out", store, "other")
        assert (done.map, done.keyframes) == ("other", KEYFRAMES)
        assert sorted(info.keyframes for info in store.maps()) == [3, KEYFRAMES, KEYFRAMES]


def test_commands(map_url: str, tmp_path: Path) -> None:
    written = semdb("export", "tum", "m", tmp_path / "t.txt", url=map_url)
    assert written.stdout == f"wrote {tmp_path / 't.txt'}: {KEYFRAMES} poses\n"
    semdb_json("export", "semdb", "m", tmp_path / "out", "--json", url=map_url)
    there = f"sqlite:///{tmp_path / 'n.sqlite3'}"
    assert semdb_json("import", tmp_path / "out", "--map", "copy", "--json", url=there) == {
        "map": "copy",
        "recordings": 1,
        "keyframes": KEYFRAMES,
        "skipped": 0,
    }
    assert semdb("export", "tum", "n", tmp_path / "u.txt", url=map_url).returncode == 1


def test_folder_names_are_of_letters_and_all_different() -> None:
    assert folder_names(["a/b", "a_b", "A_B", "..", "ä"]) == {
        "a/b": "a_b",
        "a_b": "a_b-2",
        "A_B": "A_B-3",
        "..": "recording",
        "ä": "ä",
    }
    assert folder_names(["室" * 100, "室" * 101]) == {"室" * 100: "室" * 33, "室" * 101: "室" * 33 + "-2"}


def test_tracks_find_points_again_through_noise_of_depth() -> None:
    rng = np.random.default_rng(3)
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    world = rng.uniform((-1, -1, 2), (1, 1, 4), (120, 3))
    described = rng.normal(size=(120, 16)).astype(np.float32)
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    poses = [pose_from(so3_exp([0, 0.05 * i, 0]), [0.1 * i, 0.02 * i, 0]) for i in range(4)]
    views = []
    for pose in poses:
        inverse = np.linalg.inv(pose)
        places = project(camera, world @ inverse[:3, :3].T + inverse[:3, 3])
        noisy = world + rng.normal(scale=0.01, size=world.shape)
        noisy[rng.random(120) < 0.2] = np.nan
        views.append(View(camera, pose, places + rng.normal(scale=0.2, size=places.shape), described, noisy))
    here, there = matches(views[0], views[1])
    assert (here == there).all()
    assert len(here) > 80
    tracks = find_tracks(np.stack(poses), [120] * 4, lambda i: views[i], lambda done: None)
    assert len(tracks.points) > 90
    truth = world[[int(tracks.keypoint[np.flatnonzero(tracks.point == t)[0]]) for t in range(len(tracks.points))]]
    assert np.median(np.linalg.norm(tracks.points - truth, axis=1)) < 0.02
    assert tracks.error.mean() < 0.5
