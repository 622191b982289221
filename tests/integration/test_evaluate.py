"""`semdb evaluate` as a person runs it: what fails alone, splits, trajectories for evo, COLMAP, leftover schemas."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Engine, text
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.engine import make_engine
from semdb.evaluation.workspace import _in_use, drop_abandoned, new_name, this_host
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from tests.rooms import SMALL, semdb
from tests.unit.onnx_files import write_constant_model
from tests.unit.recording_miniatures import write_seven_scenes
from tests.unit.test_pose_regression import write_pooled_encoder

URL = "sqlite:///unused.sqlite3"
FEW = ("--keyframes", 8, "--max-queries", 4)


def evaluate(*arguments: object, cwd: Path, code: int = 0, **settings: str) -> str:
    """Runs the command in `cwd`, checks its exit code, and returns stderr."""
    done = semdb("evaluate", *arguments, url=URL, cwd=cwd, **settings)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def chair_everywhere(path: Path) -> str:
    """The spec of a detector that sees one chair in every image of 640x480."""
    masks = np.zeros((1, 1, 480, 640), np.float32)
    masks[:, :, 80:400, 120:520] = 1
    outputs = {
        "boxes": np.array([[120, 80, 519, 399]], np.float32),
        "labels": np.array([62], np.int64),
        "scores": np.array([0.9], np.float32),
        "masks": masks,
    }
    return f"onnx:{write_constant_model(path, outputs)}"


def test_one_recording_that_fails_costs_no_other_its_results(room: Path, tmp_path: Path) -> None:
    short = tmp_path / "short"
    shutil.copytree(room, short)
    for name in ("rgb.txt", "depth.txt"):
        lines = [line for line in (short / name).read_text().splitlines() if not line.startswith("#")]
        (short / name).write_text("\n".join(lines[:5]) + "\n")
    output = evaluate(
        *(short, room, tmp_path / "missing", *FEW, "--json", "all.json", "--report", "report"), cwd=tmp_path, code=1
    )
    [result] = read(tmp_path / "all.json")
    assert (result["recording"], result["keyframes"], result["queries"]) == (room.name, 8, 4)
    assert "not evaluated: short: " in output
    assert "8 keyframes were asked for, but only 5 frames can be used" in output
    assert f"not evaluated: {tmp_path / 'missing'}: no such folder or file" in output
    page = (tmp_path / "report" / "index.html").read_text()
    assert "<b>short</b> was not evaluated" in page
    assert page.count("data:image/jpeg") == 4  # all queries are among the ten to look at


def test_nothing_evaluated_is_the_error_itself_said_once(tmp_path: Path) -> None:
    missing, gone = tmp_path / "missing", tmp_path / "gone"
    assert evaluate(missing, cwd=tmp_path, code=1) == f"semdb: {missing}: no such folder or file\n"
    output = evaluate(missing, gone, "--json", "none.json", cwd=tmp_path, code=1)
    assert output == "".join(f"semdb: not evaluated: {path}: no such folder or file\n" for path in (missing, gone))
    assert not (tmp_path / "none.json").exists()


def test_what_cannot_be_right_or_written_is_said_before_anything_runs(room: Path, tmp_path: Path) -> None:
    """A sequence of the paper has its own number of keyframes, which must not hide one that makes no sense."""
    sequence = tmp_path / "rgbd_dataset_freiburg1_plant"
    sequence.symlink_to(room)  # its own name counts, not that of what it leads to
    output = evaluate(sequence, "--keyframes", 0, cwd=tmp_path, code=2)
    assert output == "semdb: --keyframes 0: at least one keyframe is needed\n"
    output = evaluate(room, *FEW, "--report", "/proc/self", cwd=tmp_path, code=2)
    assert output.startswith("semdb: --report /proc/self: nothing can be written there: ")


def test_two_recordings_of_one_name_keep_their_files(room: Path, tmp_path: Path) -> None:
    for place in ("monday", "friday"):
        shutil.copytree(room, tmp_path / place / "desk")
    evaluate(
        *("monday/desk", "friday/desk", "monday/desk/", "--keyframes", 8, "--max-queries", 2, "--json", "two.json"),
        *("--method", "sift-reference", "--trajectories", "poses"),
        cwd=tmp_path,
    )
    assert [result["recording"] for result in read(tmp_path / "two.json")] == ["monday-desk", "friday-desk"]
    assert sorted(path.name for path in (tmp_path / "poses").iterdir()) == [
        "friday-desk-sift-reference-8-truth.txt",
        "friday-desk-sift-reference-8.txt",
        "monday-desk-sift-reference-8-truth.txt",
        "monday-desk-sift-reference-8.txt",
    ]


@pytest.fixture(scope="module")
def second_visit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("again") / "second"
    options = {name: getattr(SMALL, name) for name in ("width", "height", "lap_frames")}
    write_synthetic_recording(folder, SyntheticOptions(frames=10, second_visit=True, **options))
    return folder


def test_a_second_visit_is_asked_about_the_first(room: Path, second_visit: Path, tmp_path: Path) -> None:
    evaluate(
        *("--map-from", room, "--query-from", second_visit, "--keyframes", 12, "--max-queries", 6),
        *("--method", "semdb", "--method", "semdb+depth", "--json", "split.json", "--trajectories", "poses"),
        cwd=tmp_path,
    )
    plain, deep = read(tmp_path / "split.json")
    assert (plain["protocol"], plain["recording"]) == ("split", "second")
    assert (plain["map_recordings"], plain["query_recordings"]) == ([room.name], ["second"])
    assert (plain["keyframes"], plain["queries"], plain["frames"]) == (12, 6, 34)
    assert {query["recording"] for query in plain["per_query"]} == {"second"}
    assert {query["candidate_recording"] for query in plain["per_query"]} <= {room.name, None}
    assert plain["localized"] >= 3
    assert plain["false_localizations"] == 0
    assert plain["median_translation_m"] < 0.05
    assert (plain["query_depth"], deep["query_depth"]) == (False, True)
    assert plain["retrieval"]["queries"] >= 3
    assert (tmp_path / "poses" / "second-semdb+depth-12.txt").is_file()


def test_evo_reads_the_trajectories_and_finds_the_same_error(room: Path, tmp_path: Path) -> None:
    evaluate(
        *(room, "--keyframes", 8, "--json", "r.json", "--trajectories", "poses", "--method", "sift-reference"),
        cwd=tmp_path,
    )
    result = read(tmp_path / "r.json")
    stem = f"{room.name}-sift-reference-8"
    evo = Path(sys.executable).with_name("evo_ape")
    command = [evo, "tum", f"poses/{stem}-truth.txt", f"poses/{stem}.txt"]
    environment = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLBACKEND": "agg"}
    for relation, mean, median in (
        ("trans_part", "mean_translation_m", "median_translation_m"),
        ("angle_deg", "mean_rotation_deg", "median_rotation_deg"),
    ):
        done = subprocess.run(
            [*command, "--pose_relation", relation], cwd=tmp_path, env=environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        rows = [line.split() for line in done.stdout.splitlines()]
        figures = {row[0]: float(row[1]) for row in rows if len(row) == 2 and row[0] in ("mean", "median")}
        assert figures["mean"] == pytest.approx(result[mean], abs=2e-6)
        assert figures["median"] == pytest.approx(result[median], abs=2e-6)


def test_a_scene_of_7_scenes_by_its_split_files(tmp_path: Path) -> None:
    for number in (1, 2):
        write_seven_scenes(tmp_path / "box" / f"seq-0{number}", n=3)
    (tmp_path / "box" / "TrainSplit.txt").write_text("sequence1\n")
    (tmp_path / "box" / "TestSplit.txt").write_text("sequence2\n")
    split = ("box", "--protocol", "split", "--method", "sift-reference", "--json", "box.json")
    evaluate(*split, cwd=tmp_path, SEMDB_ENCODER="gist", SEMDB_DETECTOR=chair_everywhere(tmp_path / "chair.onnx"))
    result = read(tmp_path / "box.json")
    assert (result["recording"], result["protocol"], result["queries"]) == ("box", "split", 3)
    assert (result["map_recordings"], result["query_recordings"]) == (["box-seq-01"], ["box-seq-02"])
    assert [query["frame_index"] for query in result["per_query"]] == [0, 4, 8]
    output = evaluate("box", cwd=tmp_path, code=2, SEMDB_ENCODER="gist", SEMDB_DETECTOR="recorded")
    assert "masks" in output  # the sequences are there, but `recorded` needs masks


def test_the_ablation_has_a_row_for_every_layer(room: Path, tmp_path: Path) -> None:
    output = evaluate(room, *FEW, "--ablation", "--json", "a.json", cwd=tmp_path)
    results = read(tmp_path / "a.json")
    assert [result["method"] for result in results] == [
        "cnn", "hard", "semdb", "semdb-counts", "semdb-no-confusion", "semdb-own-points",
        "cnn-objects", "hard-objects", "semdb-objects",
    ]  # fmt: skip
    assert {result["queries"] for result in results} == {4}
    assert "Ablation on" in output
    by_name = {result["method"]: result for result in results}
    assert by_name["cnn"]["ranked_share"] == 1.0
    assert set(by_name["cnn"]["stages"]) == {"all"}
    assert set(by_name["hard"]["stages"]) == {"filtered"}  # the hard filter has the last word


def test_networks_are_trained_by_a_command_found_by_an_evaluation_and_have_a_table_and_pictures(
    room: Path, tmp_path: Path
) -> None:
    encoder = write_pooled_encoder(tmp_path / "encoder.onnx")
    asked = (room, "--keyframes", 6, "--max-queries", 2, "--encoder", f"onnx:{encoder}", "--pose-steps", 3)
    networks = ("--method", "posenet", "--method", "posenet-keyframes")
    train = ("train", "pose", *asked, *networks, "--output", "networks")
    done = semdb(*train, url=URL, cwd=tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    files = [Path("networks") / f"{room.name}-{name}-6-2.pth" for name in ("posenet", "posenet-keyframes")]
    lines = done.stdout.splitlines()
    assert [line.partition(": ")[0] for line in lines] == [str(file) for file in files]
    assert lines[1].startswith(f"{files[1]}: 6 frames, loss ")
    kept = [(tmp_path / file).read_bytes() for file in files]

    evaluate(
        *(*asked, *networks, "--method", "mean-pose", "--pose-networks", "networks", "--json", "r.json"),
        *("--report", "report"),
        cwd=tmp_path,
    )
    found = read(tmp_path / "r.json")
    assert [(tmp_path / file).read_bytes() for file in files] == kept  # found, not trained
    assert [result["method"] for result in found] == ["posenet", "posenet-keyframes", "mean-pose"]
    assert [result["success_rate"] for result in found] == [1.0, 1.0, 1.0]
    assert found[1]["training_frames"] == 6 < found[0]["training_frames"]
    assert lines[0].startswith(f"{files[0]}: {found[0]['training_frames']} frames, loss ")
    assert found[2]["training_frames"] is None
    assert found[0]["models"]["encoder"]["name"] == "onnx:encoder.onnx"
    page = (tmp_path / "report" / "index.html").read_text()
    assert "Table 4 on the recordings of this run" in page
    assert (tmp_path / "report" / "training-1.png").is_file()


def test_training_a_network_goes_on_only_where_it_is_told_to(room: Path, tmp_path: Path) -> None:
    encoder = write_pooled_encoder(tmp_path / "encoder.onnx")

    def run(*more: str, method: str = "posenet-keyframes") -> tuple[int, str]:
        asked = [room, "--keyframes", "6", "--max-queries", "2", "--method", method, "--output", tmp_path / "networks"]
        given = [*map(str, asked), "--encoder", f"onnx:{encoder}", "--pose-steps", "1", *more]
        done = CliRunner().invoke(app, ["train", "pose", *given], env={"SEMDB_THREADS": "1"})
        return done.exit_code, done.output

    path = tmp_path / "networks" / f"{room.name}-posenet-keyframes-6-2.pth"
    code, said = run("--resume")
    assert (code, f"{path} is not there, so there is nothing to go on from" in said) == (2, True), said
    code, said = run()
    assert (code, f"{path}: 6 frames, loss " in said) == (0, True), said
    kept = path.read_bytes()
    code, said = run()
    assert (code, f"{path} is there already: go on with --resume" in said) == (2, True), said
    assert path.read_bytes() == kept
    code, said = run("--resume")
    assert (code, f"{path}: 6 frames, loss " in said) == (0, True), said
    code, said = run(method="semdb")
    assert (code, "--method semdb: networks that can be trained are posenet" in said) == (2, True), said


def test_colmap_and_both_truths(room: Path, tmp_path: Path) -> None:
    output = evaluate(
        *(room, "--keyframes", 10, "--max-queries", 4, "--method", "semdb", "--method", "colmap"),
        *("--truth", "both", "--json", "c.json"),
        cwd=tmp_path,
    )
    results = read(tmp_path / "c.json")
    assert [(result["method"], result["truth"]) for result in results] == [
        ("semdb", "given"), ("colmap", "given"), ("semdb", "refined"), ("colmap", "refined"),
    ]  # fmt: skip
    first = results[0]["disagreement"]
    assert first["frames"] == 14
    assert first["median_translation_m"] < 0.02  # the truth of a rendered room is exact: what is left is refinement's
    assert first["scale"] == pytest.approx(1.0, abs=0.02)
    for result in results[:2]:
        other = result["other_errors"]
        assert abs(other["median_translation_m"] - result["median_translation_m"]) < 0.02
    # the second run has another map: its answers are nearer to the poses that this map has
    assert results[2]["per_query"][0]["translation_m"] != results[0]["per_query"][0]["translation_m"]
    assert results[2]["per_query"][0]["other_translation_m"] != results[0]["per_query"][0]["translation_m"]
    colmap = results[1]
    assert colmap["localized"] >= 3
    assert colmap["median_translation_m"] < 0.02
    assert colmap["models"]["features"]["name"] == "colmap-sift"
    assert "Errors against both truths" in output


def test_schemas_that_killed_evaluations_left_behind_are_dropped(server_url: str) -> None:
    host = this_host()
    mine, foreign = f"semdb_evaluate_{host}_4194999_1700000000_abcdef", "semdb_evaluate_00000000_7_1700000000_abcdef"
    running = new_name()
    names = (mine, foreign, running)
    engine = make_engine(server_url)
    try:
        with engine.connect() as connection:
            for name in names:
                connection.execute(text(f"CREATE DATABASE {name}"))
        lines = drop_abandoned(server_url)
        with engine.connect() as connection:
            left = {row[0] for row in connection.execute(text("SHOW DATABASES"))}
        assert left.intersection(names) == {foreign, running}
        assert len(lines) == 2
        assert f"dropped {mine}" in lines[0] + lines[1]
        assert f"DROP DATABASE {foreign}" in lines[0] + lines[1]
    finally:
        with engine.connect() as connection:
            for name in names:
                connection.execute(text(f"DROP DATABASE IF EXISTS {name}"))
        engine.dispose()


def test_who_uses_a_schema_is_seen_while_images_are_sent(server_url: str) -> None:
    """A list of connections shows their statements, and MySQL fails to convert one that is no text."""
    engine = make_engine(server_url)
    image = bytes(range(255, 0, -1)) * 4
    stored = threading.Thread(target=lambda: _store_slowly(engine, image))
    try:
        with engine.begin() as connection:
            connection.execute(text("CREATE TABLE images (data LONGBLOB, slept INT)"))
        stored.start()
        with engine.connect() as connection:
            time.sleep(0.3)  # it takes a second
            assert stored.is_alive()
            assert str(engine.url.database) in _in_use(connection)
            assert connection.execute(text("SELECT 'text'")).scalar_one() == "text"
    finally:
        stored.join()
        engine.dispose()


def _store_slowly(engine: Engine, image: bytes) -> None:
    with engine.begin() as connection:
        connection.execute(text("INSERT INTO images SELECT :image, SLEEP(1)"), {"image": image})
