"""Recordings that show nothing, and maps that hold next to nothing: every later step has an answer to them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import create_engine, text
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.geometry import pose_from, so3_exp
from semdb.geometry.volumes import volume_of
from semdb.localization.views import View
from semdb.recordings.synthetic import SyntheticOptions
from semdb.refinement.points.options import FusionOptions
from semdb.refinement.points.refined import refine_points
from semdb.types import Camera
from tests.rooms import render

FRAMES, WIDTH, HEIGHT = 6, 160, 120
DARK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
CAMERA = Camera(WIDTH, HEIGHT, 120.0, 120.0, 79.5, 59.5)
WHITE = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of a room."""
    options = SyntheticOptions(frames=FRAMES, width=WIDTH, height=HEIGHT, lap_frames=80)
    return render(tmp_path_factory.mktemp("nothing") / "walk", options)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in (("CACHE_DIR", "cache"), ("THREADS", "1"), ("DETECTOR", "recorded"), ("ENCODER", "gist")):
        monkeypatch.setenv(f"SEMDB_{name}", value)


def images(folder: Path) -> list[Path]:
    lines = (folder / "rgb.txt").read_text().splitlines()
    return [folder / line.split()[1] for line in lines if not line.startswith("#")]


def paint(picture: np.ndarray[Any, Any], frames: Sequence[int] = range(FRAMES)) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for index in frames:
            cv2.imwrite(str(images(folder)[index]), picture)

    return change


def blur(folder: Path) -> None:
    for path in images(folder):
        cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 25))


def no_depth(folder: Path) -> None:
    (folder / "depth.txt").unlink()


def empty_depth(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint16))


def no_objects(folder: Path) -> None:
    for path in (folder / "masks").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint16))


def first(frames: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        lines = (folder / "rgb.txt").read_text().splitlines()
        heads = [line for line in lines if line.startswith("#")]
        (folder / "rgb.txt").write_text("\n".join([*heads, *lines[len(heads) :][:frames]]) + "\n")

    return change


def copy(walk: Path, name: str, *changes: Callable[[Path], None]) -> Path:
    folder = Path(name).absolute()
    shutil.copytree(walk, folder)
    for change in changes:
        change(folder)
    return folder


def run(*arguments: object, code: int = 0) -> Any:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == code, f"{done.exit_code}: {done.output!r} {done.exception!r}"
    return done


def keypoints() -> list[int]:
    rows = json.loads(
        run("sql", "SELECT keypoints FROM keypoint_counts ORDER BY frame_index", "--format", "json").stdout
    )
    return [row["keypoints"] for row in rows]


CASES: dict[str, tuple[Callable[[Path], None], ...]] = {
    "lens cap": (paint(DARK),),
    "white wall": (paint(WHITE),),
    "out of focus": (blur,),
    "first of two is dark": (first(2), paint(DARK, [0])),
    "some are dark": (paint(DARK, [0, 2, 3]),),
    "no depth": (no_depth,),
    "depth of nothing": (empty_depth,),
    "no objects": (no_objects,),
    "nothing at all": (paint(DARK), no_objects, no_depth),
    "one frame": (first(1),),
    "one dark frame": (first(1), paint(DARK, [0])),
}
BLANK = {  # keyframes without a keypoint
    "lens cap": 6, "white wall": 6, "out of focus": 6, "first of two is dark": 1, "some are dark": 3,
    "nothing at all": 6, "one dark frame": 1,
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_every_step_has_an_answer(name: str, walk: Path) -> None:
    room = copy(walk, "room", *CASES[name])
    ingested = run("ingest", room, "--stride", 1, "--map", "m")
    blank = BLANK.get(name, 0)
    assert keypoints().count(0) == blank
    assert (f"{blank} without a keypoint" in ingested.stdout) == bool(blank)
    rows = {item["step"]: item["rows"] for item in json.loads(run("refine", "--json").stdout)}
    assert set(rows) >= {"classes", "points"}
    if blank == len(images(room)) or name in ("one frame", "nothing at all"):
        assert rows["points"] == 0  # no pair, no row
    if name in ("no objects", "nothing at all", "one frame"):
        assert rows["classes"] == 0
    assert set(json.loads(run("status", "--json").stdout)[0]["refinements"].values()) == {"current"}
    queries = [images(copy(walk, "dark", paint(DARK)))[0], images(walk)[0]]
    for coarse in ("sql", "index"):
        answers = json.loads(run("localize", *queries, "--like", walk, "--coarse", coarse, "--json").stdout)
        assert (answers[0]["verdict"], answers[0]["pose"], answers[0]["inliers"]) == ("failed", None, 0)
        if blank == len(images(room)):
            assert (answers[1]["verdict"], answers[1]["inliers"]) == ("failed", 0)
    assert run("localize", *queries, "--like", walk, "--plot", "pictures").stderr.count("wrote ") == 2
    for view in ("keyframe_objects", "category_counts", "recording_summary", "covisible_objects"):
        run("sql", f"SELECT * FROM {view}")
    assert len(run("keypoints", 1, "--csv").stdout.splitlines()) == 1 + keypoints()[0]
    run("models", "list")
    run("delete", "map", "m", "--yes")


@pytest.mark.parametrize("features", ["sift", "orb"])
def test_other_features_of_nothing(features: str, walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMDB_FEATURES", features)
    run("ingest", copy(walk, "room", paint(DARK, [0, 1])), "--stride", 1, "--map", "m")
    assert keypoints()[:2] == [0, 0]
    assert min(keypoints()[2:]) > 0
    run("refine")
    dark = images(copy(walk, "dark", paint(DARK)))[0]
    assert json.loads(run("localize", dark, "--like", walk, "--json").stdout)[0]["verdict"] == "failed"


METHODS = ("semdb", "cnn", "paper", "chen", "sift-reference", "oracle", "semdb+depth")


def test_an_evaluation_of_nothing_keeps_none_of_the_others(walk: Path) -> None:
    nothing = copy(walk, "cap", paint(DARK), no_objects)
    chosen = [word for method in METHODS for word in ("--method", method)]
    few = ("--keyframes", 3, "--max-queries", 1)
    run("evaluate", nothing, walk, *few, *chosen, "--json", "x.json", "--trajectories", "trajectories")
    results = json.loads(Path("x.json").read_text())
    assert {(item["recording"], item["method"]) for item in results} == {
        (recording, method) for recording in ("cap", "walk") for method in METHODS
    }
    for cap in (item for item in results if item["recording"] == "cap"):
        assert (cap["queries"], cap["localized"], cap["success_rate"], cap["median_translation_m"]) == (1, 0, 0.0, None)
        assert cap["recall"] == {"5cm_5deg": 0.0, "0.25m_2deg": 0.0, "0.3m": 0.0, "2.5deg": 0.0}
        lines = Path(f"trajectories/cap-{cap['method']}-3.txt").read_text().splitlines()
        assert [line for line in lines if not line.startswith("#")] == []
    run("evaluate", nothing, *few, "--report", "report")
    assert "0.0 %" in Path("report/index.html").read_text()


def test_one_map_of_nothing_or_of_wrong_rows_keeps_none_of_the_others(walk: Path) -> None:
    run("ingest", copy(walk, "cap", paint(DARK)), "--stride", 1, "--map", "a cap")
    run("ingest", copy(walk, "broken"), "--stride", 1, "--map", "b broken")
    run("ingest", walk, "--stride", 1, "--map", "c room")
    engine = create_engine("sqlite:///semdb.sqlite3")
    with engine.begin() as connection:
        connection.execute(
            text(
                "UPDATE keypoints SET data = 'nothing' WHERE keyframe_id IN (SELECT k.id FROM keyframes k "
                "JOIN recordings r ON r.id = k.recording_id WHERE r.name = 'broken')"
            )
        )
    engine.dispose()
    done = run("refine", "--json")
    results = {(item["map"], item["step"]): item for item in json.loads(done.stdout)}
    assert results["a cap", "points"]["rows"] == 0
    assert results["c room", "points"]["rows"] > 0
    assert "is left out: keypoints.data of keyframe" in done.stderr
    assert results["b broken", "points"]["rows"] == 0


def _view(count: int, seed: int, depth: bool) -> View:
    random = np.random.default_rng(seed)
    descriptors = random.normal(size=(count, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True) if count else 1
    xy = random.uniform(-0.4, 0.4, (count, 2))
    z = random.uniform(1, 4, (count, 1)) if depth else np.full((count, 1), np.nan)
    return View(
        camera=CAMERA,
        seen_xy=(xy * 120 + [79.5, 59.5]).astype(np.float32),
        xy=xy,
        size=np.full(count, 9, np.float32),
        descriptors=descriptors,
        classes=random.integers(-1, 3, count).astype(np.int32),
        signs=random.choice([-1, 1], count).astype(np.int8),
        points=(np.column_stack([xy, np.ones(count)]) * z).astype(np.float32),
        source=np.arange(count, dtype=np.int32),
    )


@given(
    st.lists(st.tuples(st.integers(0, 12), st.booleans()), min_size=1, max_size=6),
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_points_of_views_with_few_or_no_keypoints(
    kinds: list[tuple[int, bool]], seed: int, block: int, same: bool
) -> None:
    random = np.random.default_rng(seed)
    views = [_view(count, 7 if same else seed % 1000 + i, depth) for i, (count, depth) in enumerate(kinds)]
    poses = [pose_from(so3_exp(random.normal(size=3) * 0.02), random.normal(size=3) * 0.05) for _ in views]
    volumes = [volume_of(CAMERA, pose, view.seen_xy, view.points) for view, pose in zip(views, poses, strict=True)]
    for number, found in refine_points(volumes, views.__getitem__, FusionOptions(block=block)):
        assert len(found.keypoints) == len(found.points) == found.fused + found.triangulated > 0
        assert found.keypoints.max() < len(views[number])
        assert np.isfinite(found.points).all()
