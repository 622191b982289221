"""The sequences of the paper by the names of their folders, splits, trajectories, and what they ask to be run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError, UsageError
from semdb.evaluation.methods import ABLATION, METHODS, method_named
from semdb.evaluation.metrics import QueryResult, summarise
from semdb.evaluation.published import PAPER_SEQUENCES, counts_like, sequence_of
from semdb.evaluation.runner import EvaluateOptions, check_options
from semdb.evaluation.splits import folder_plan, paper_plans, scene_plan, split_lines, tell_apart
from semdb.evaluation.tasks import PaperPlan, Plan, _proportional
from semdb.evaluation.trajectories import trajectory_text, write_trajectories
from semdb.evaluation.workspace import Workspace, is_abandoned, new_name, parse_name, this_host
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings import open_recording
from semdb.types import Verdict
from tests.unit.recording_miniatures import SMALL, pose, write_icl, write_seven_scenes, write_tum

NAMES = [
    ("rgbd_dataset_freiburg1_plant", "TUM freiburg1_plant"),
    ("rgbd_dataset_freiburg1_room", "TUM freiburg1_room"),
    ("rgbd_dataset_freiburg2_360_hemisphere", "TUM freiburg2_360_hemisphere"),
    ("rgbd_dataset_freiburg2_flowerbouquet", "TUM freiburg2_flowerbouquet"),
    ("rgbd_dataset_freiburg2_pioneer_slam3", "TUM freiburg2_pioneer_slam3"),
    ("rgbd_dataset_freiburg3_long_office_household", "TUM freiburg3_long_office_household"),
    ("fr1_plant", "TUM freiburg1_plant"),
    ("tum/fr1/room", "TUM freiburg1_room"),
    ("tum_rgbd_dataset_freiburg1_plant", "TUM freiburg1_plant"),
    ("freiburg1_plant", "TUM freiburg1_plant"),
    ("rgbd_dataset_freiburg3_long_office_household_validation", None),
    ("rgbd_dataset_freiburg1_rpy", None),
    *((f"living_room_traj{n}_frei_png", f"ICL-NUIM living room kt{n}") for n in range(4)),
    *((f"traj{n}_frei_png", f"ICL-NUIM office room kt{n}") for n in range(4)),
    ("living_room_traj2n_frei_png", "ICL-NUIM living room kt2"),
    ("traj3n_frei_png", "ICL-NUIM office room kt3"),
    ("lr kt0", "ICL-NUIM living room kt0"),
    ("lr_kt1", "ICL-NUIM living room kt1"),
    ("of_kt3", "ICL-NUIM office room kt3"),
    ("office_room/kt0", "ICL-NUIM office room kt0"),
    ("living_room/traj2_frei_png", "ICL-NUIM living room kt2"),
    ("icl_nuim_office_kt1", "ICL-NUIM office room kt1"),
    ("living_room_traj4_frei_png", None),
    ("room", None),
    ("office", None),
]


@pytest.mark.parametrize(("name", "sequence"), NAMES)
def test_sequences_are_known_by_folder(tmp_path: Path, name: str, sequence: str | None) -> None:
    found = sequence_of(tmp_path / name)
    assert (None if found is None else found.sequence) == sequence


def test_all_14_sequences_are_known_by_some_name() -> None:
    assert {sequence for _, sequence in NAMES if sequence} == set(PAPER_SEQUENCES)
    assert len(PAPER_SEQUENCES) == 14


def test_counts_are_those_of_table_1_or_in_proportion() -> None:
    row = PAPER_SEQUENCES["TUM freiburg1_plant"]
    whole = counts_like(row, 1126)
    assert (whole.keyframes, whole.queries) == (171, 800)
    assert "171 keyframes and 800 queries as in its Table 1" in whole.note
    sixth = counts_like(row, 187)
    assert (sixth.keyframes, sixth.queries) == (29, 134)
    assert "187 of its 1120 frames" in sixth.note
    overlapping = counts_like(PAPER_SEQUENCES["TUM freiburg2_360_hemisphere"], 2647)
    assert (overlapping.keyframes, overlapping.queries) == (800, 2000)
    assert overlapping.note.endswith("2000 queries as in its Table 1, of which 1847 are no keyframes and are asked")


def test_a_link_may_have_the_name_of_a_sequence(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "fr1_plant").symlink_to(tmp_path / "data")
    found = sequence_of(tmp_path / "fr1_plant")
    assert found is not None
    assert found.sequence == "TUM freiburg1_plant"


@pytest.mark.parametrize(
    ("name", "sequence", "write"),
    [
        ("rgbd_dataset_freiburg1_plant", "TUM freiburg1_plant", write_tum),
        ("living_room_traj0_frei_png", "ICL-NUIM living room kt0", write_icl),
    ],
)
def test_a_miniature_of_a_sequence_takes_its_numbers(tmp_path: Path, name: str, sequence: str, write: object) -> None:
    folder = write(tmp_path / name)  # type: ignore[operator]
    said: list[str] = []
    plan = PaperPlan(open_recording(folder, SMALL))
    task = plan.choose(None, None, None, said.append)
    frames = len(plan.recording.entries)
    assert task.sequence == sequence
    assert len(task.keyframes[0].entries) == 1  # 6 of 1120 frames, 171 keyframes in proportion
    row = PAPER_SEQUENCES[sequence]
    assert row.raw_frames is not None
    assert row.test_frames is not None
    assert task.query_count == round(frames / row.raw_frames * row.test_frames)
    assert task.keyframes_asked is None
    assert sequence in said[0]
    own = plan.choose(2, 3, None, said.append)
    assert (len(own.keyframes[0].entries), own.query_count, own.keyframes_asked) == (2, min(3, frames - 2), 2)
    assert len(said) == 1
    half = plan.choose(2, None, None, said.append)
    assert len(half.keyframes[0].entries) == 2
    assert "but for --keyframes 2" in said[1]


def scene(folder: Path) -> Path:
    for n in (1, 2, 3):
        write_seven_scenes(folder / f"seq-0{n}", n=3)
    (folder / "TrainSplit.txt").write_text("sequence1\nsequence3\n")
    (folder / "TestSplit.txt").write_text("sequence2\n")
    return folder


def test_a_scene_of_7_scenes_is_split_as_its_files_say(tmp_path: Path) -> None:
    plan = scene_plan(scene(tmp_path / "stairs"))
    assert plan.name == "stairs"
    assert [recording.name for recording in plan.map_recordings] == ["stairs-seq-01", "stairs-seq-03"]
    assert [recording.name for recording in plan.query_recordings] == ["stairs-seq-02"]
    task = plan.choose(3, None, None, None)
    assert sum(len(part.entries) for part in task.keyframes) == 3
    assert [(part.recording.name, len(part.entries)) for part in task.queries] == [("stairs-seq-02", 3)]
    assert task.frames == 9
    assert {part.recording.name for part in task.keyframes} <= {"stairs-seq-01", "stairs-seq-03"}
    # the two sequences of the map show the same views: no view is chosen twice
    poses = [entry.world_from_camera for part in task.keyframes for entry in part.entries]
    assert len({tuple(np.round(found[:3, 3], 6)) for found in poses if found is not None}) == 3
    assert plan.choose(None, 2, None, None).query_count == 2


def test_split_files_say_what_is_wrong_with_them(tmp_path: Path) -> None:
    folder = scene(tmp_path / "stairs")
    (folder / "TestSplit.txt").write_text("sequence2\n\nfour\n")
    with pytest.raises(RecordingError, match=r"TestSplit\.txt, line 3: 'four'"):
        scene_plan(folder)
    (folder / "TestSplit.txt").write_text("seq-02\nsequence 04\n")
    assert split_lines(folder / "TestSplit.txt") == [2, 4]
    with pytest.raises(RecordingError, match=r"TestSplit\.txt: names sequence4, but there is no folder .*seq-04"):
        scene_plan(folder)
    (folder / "TestSplit.txt").write_text("sequence1\n")
    with pytest.raises(RecordingError, match=r"sequence1 is in TrainSplit\.txt and in TestSplit\.txt"):
        scene_plan(folder)
    (folder / "TestSplit.txt").write_text("\n")
    with pytest.raises(RecordingError, match="names no sequence"):
        scene_plan(folder)
    (folder / "TestSplit.txt").unlink()
    with pytest.raises(UsageError, match=r"needs TestSplit\.txt there .* or say --map-from"):
        scene_plan(folder)


def test_folders_by_name_for_a_split(tmp_path: Path) -> None:
    first, second = write_tum(tmp_path / "a" / "visit"), write_tum(tmp_path / "b" / "visit")
    plan = folder_plan([first], [second])
    assert [recording.name for recording in plan.recordings] == ["a-visit", "b-visit"]
    assert plan.name == "b-visit"
    with pytest.raises(UsageError, match="use --protocol paper"):
        folder_plan([first], [second, first])


def test_a_split_needs_true_poses_of_its_queries(tmp_path: Path) -> None:
    known, unknown = write_tum(tmp_path / "known"), write_tum(tmp_path / "unknown")
    (unknown / "groundtruth.txt").unlink()
    with pytest.raises(RecordingError, match="unknown: no frame has a pose, so no answer could be compared"):
        folder_plan([known], [unknown]).choose(2, None, None, None)


def test_recordings_of_one_name_are_told_apart_and_one_that_comes_twice_is_one(tmp_path: Path) -> None:
    for place in ("living_room", "office_room"):
        write_tum(tmp_path / place / "kt0")
    paths = [tmp_path / "living_room" / "kt0", tmp_path / "office_room" / "kt0", tmp_path / "living_room" / "kt0"]
    plans = tell_apart([plan for path in paths for plan in paper_plans(path, SMALL)])
    assert [plan.name for plan in plans] == ["living_room-kt0", "office_room-kt0"]
    scenes = [scene(tmp_path / place / "redkitchen") for place in ("a", "b")]
    splits: list[Plan] = [scene_plan(path) for path in scenes]
    assert [plan.name for plan in tell_apart(splits)] == ["redkitchen", "redkitchen-2"]


def test_keyframes_are_shared_out_in_proportion() -> None:
    assert _proportional([10, 10], None) == [None, None]
    assert _proportional([30, 10], 8) == [6, 2]
    assert _proportional([1000, 10], 5) == [4, 1]
    assert _proportional([10, 10, 10], 10) == [4, 3, 3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (EvaluateOptions(protocol="magic"), "--protocol magic: known are paper, split"),
        (EvaluateOptions(truth="guess"), "--truth guess: known are given, refined, both"),
        (EvaluateOptions(methods=("semdb+magic",)), "with query depth NAME"),
        (EvaluateOptions(methods=("colmap+depth",)), "colmap has no use for the depth"),
        (EvaluateOptions(map_from=(Path("a"),)), "not both"),
        (EvaluateOptions(keyframes=(25, 0)), "--keyframes 0: at least one keyframe is needed"),
        (EvaluateOptions(max_queries=0), "--max-queries 0: at least one query is needed"),
    ],
)
def test_options_that_make_no_sense(options: EvaluateOptions, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_options([Path("room")], options)
    with pytest.raises(UsageError, match="name the folder"):
        check_options([], EvaluateOptions())
    with pytest.raises(UsageError, match="--query-from needs --map-from too"):
        check_options([], EvaluateOptions(query_from=(Path("a"),)))


def test_every_row_of_the_ablation_is_a_method() -> None:
    assert {name for _, _, name in ABLATION} <= set(METHODS)
    assert len({(filter_name, keypoints) for filter_name, keypoints, _ in ABLATION}) == 9
    budgets = {
        name: sum((*options.filtered_batches, *options.soft_batches * options.cascade,
                   *options.all_batches * options.cascade))
        for _, _, name in ABLATION
        for options in (METHODS[name].options.coarse,)
    }  # fmt: skip
    assert set(budgets.values()) == {10}, budgets
    deep = method_named("semdb+depth")
    assert (deep.name, deep.query_depth, deep.options) == ("semdb+depth", True, METHODS["semdb"].options)


def test_chen_knows_no_classes() -> None:
    """Pairs of keypoints on objects of different classes pass the same ratio test as all others."""
    options = METHODS["chen"].options
    assert options.pose.matching.contradiction_ratio == options.pose.matching.ratio == 0.85
    assert not options.coarse.use_classes
    assert METHODS["cnn"].options.pose.matching.contradiction_ratio == 0.75  # as semdb but for the coarse step


def answered(index: int, time_ns: int | None, verdict: Verdict = Verdict.LOCALIZED) -> QueryResult:
    estimate = None if verdict is Verdict.FAILED else pose(index)
    return QueryResult(
        f"{index}.png", index, verdict, 0.01, 0.1, 3, 10, 0.9, "all", 1.0, 3, recording="seq/1", timestamp_ns=time_ns,
        world_from_camera=estimate, true_world_from_camera=pose(index + 1),
    )  # fmt: skip


def test_trajectories_are_tum_lines_in_order_of_time(tmp_path: Path) -> None:
    queries = [answered(7, 1_305_031_229_926_248_123), answered(3, 1_305_031_102_000_000_000),
               answered(9, 1_305_031_230_000_000_000, Verdict.FAILED),
               answered(10, 1_305_031_231_000_000_000, Verdict.AMBIGUOUS)]  # fmt: skip
    result = summarise(
        queries, recording="room", protocol="paper", method="semdb+depth", models=(), frames=9, keyframes=3
    )
    estimated, true = write_trajectories(tmp_path / "new", [result])
    assert (estimated.name, true.name) == ("seq_1-semdb+depth-3.txt", "seq_1-semdb+depth-3-truth.txt")
    rows = [line.split() for line in estimated.read_text().splitlines() if not line.startswith("#")]
    assert [row[0] for row in rows] == ["1305031102.000000000", "1305031229.926248123"]
    x, y, z, qx, qy, qz, qw = map(float, rows[1][1:])
    assert np.abs(pose_from(rotation_from_quat_wxyz([qw, qx, qy, qz]), [x, y, z]) - pose(7)).max() < 1e-8
    assert sum(not line.startswith("#") for line in true.read_text().splitlines()) == 4


def test_frames_without_times_get_their_index() -> None:
    text = trajectory_text([answered(7, None), answered(3, None)], estimated=False)
    assert "# frames have no time stamps: the first column is the frame index" in text
    assert [line.split()[0] for line in text.splitlines() if not line.startswith("#")] == ["3.000000000", "7.000000000"]


def test_only_what_a_dead_process_of_this_machine_left_is_abandoned() -> None:
    name = new_name()
    made = parse_name(name)
    assert made is not None
    assert made.host == this_host()
    assert parse_name("semdb_evaluate_0123456789ab") is None
    assert parse_name("semdb") is None
    old = Workspace("semdb_evaluate_x", made.host, 7, 1000)

    def abandoned(
        found: Workspace, *, in_use: tuple[str, ...] = (), running: bool = False, now: float = 5000.0
    ) -> bool:
        return is_abandoned(found, now_s=now, host=made.host, in_use=in_use, is_running=lambda pid: running)

    assert abandoned(old)
    assert not abandoned(old, running=True)
    assert not abandoned(old, in_use=("semdb_evaluate_x",))
    assert not abandoned(old, now=1030.0)  # just made
    assert not abandoned(Workspace("semdb_evaluate_x", "00000000", 7, 1000))  # another machine
