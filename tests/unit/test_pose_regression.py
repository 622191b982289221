"""Networks that regress poses: what they learn from, that they learn, and that a run goes on exactly."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from semdb.errors import ModelError, TrainingError, UsageError
from semdb.evaluation.methods import NETWORKS, method_named
from semdb.evaluation.regression import always, check_torch, fixed_pose, training_parts
from semdb.geometry import pose_error, pose_from
from semdb.geometry.stacks import so3_exps
from semdb.settings import Settings
from semdb.training.pose import PoseData, PoseRegressor, load, rate_at, train
from semdb.training.pose_inputs import FrozenInputs, PixelInputs, depth_plane, make_inputs
from semdb.training.pose_network import build, single
from semdb.training.pose_options import PoseOptions
from semdb.training.pose_targets import PoseScale, mean_pose
from semdb.types import FloatArray, Verdict
from tests.unit.onnx_files import write_mean_embedding_model

SETTINGS = Settings(threads=1, device="cpu")
SMALL = PoseOptions(steps=60, filter_steps=20, batch=8, width=16, window=3, rate=5e-3, dropout=0.0)


def some_poses(count: int, turn: float = 0.4) -> FloatArray:
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = so3_exps(rng.normal(0, turn, (count, 3)))
    poses[:, :3, 3] = rng.normal(0, 1, (count, 3)) + np.array([5, 0, 2])
    return poses


def some_data(frames: int = 24, window: int = 1) -> PoseData:
    """Maps that a pose can be read from: its targets are mixed into the channels."""
    poses = some_poses(frames)
    targets = PoseScale.of(poses).targets(poses)
    mix = np.random.default_rng(4).normal(size=(6, 12))
    inputs = np.repeat((targets @ mix)[:, :, None, None], 2, axis=2).repeat(2, axis=3).astype(np.float16)
    windows = np.stack([np.maximum(0, np.arange(frames) - back) for back in reversed(range(window))], axis=1)
    return PoseData(inputs, windows.astype(np.int32), poses, tuple(f"room:{k}" for k in range(frames)))


def test_targets_are_half_angles_around_the_mean_and_come_back() -> None:
    poses = some_poses(9, turn=0.9)
    scale = PoseScale.of(poses)
    assert np.allclose(scale.poses(scale.targets(poses)), poses, atol=1e-9)
    turned = pose_from(so3_exps(np.array([[0.0, 0.0, 1.0]]))[0], np.zeros(3))
    assert PoseScale(np.eye(4), np.ones(6)).targets(turned[None])[0] == pytest.approx([0, 0, 0, 0, 0, 0.5])
    assert mean_pose(poses)[:3, 3] == pytest.approx(poses[:, :3, 3].mean(axis=0))


@pytest.mark.parametrize("kind", ["posenet", "cnn-lstm"])
def test_the_loss_falls_and_the_poses_are_learnt(kind: str) -> None:
    options = replace(SMALL, kind=kind)
    data = some_data(window=options.frames)
    seen: list[tuple[int, int]] = []
    found = train(options, data, SETTINGS, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (options.total_steps, options.total_steps)
    assert np.mean(found.losses[55:60]) < np.mean(found.losses[:5]) - 1.0
    errors = [pose_error(found.predict(data.inputs[w]), p) for w, p in zip(data.windows, data.poses, strict=True)]
    trivial = [pose_error(mean_pose(data.poses), pose) for pose in data.poses]
    assert np.median([metres for metres, _ in errors]) < 0.4 * np.median([metres for metres, _ in trivial])
    assert np.median([angle for _, angle in errors]) < 0.75 * np.median([angle for _, angle in trivial])


CUT = replace(SMALL, kind="cnn-lstm", dropout=0.5, steps=12, filter_steps=6)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[PoseRegressor, Path]:
    """A run that nothing cut off."""
    path = tmp_path_factory.mktemp("whole") / "a.pth"
    return train(CUT, some_data(window=3), SETTINGS, checkpoint=path), path


def test_equal_options_and_frames_make_an_equal_network(whole: tuple[PoseRegressor, Path], tmp_path: Path) -> None:
    again = train(CUT, some_data(window=3), SETTINGS, checkpoint=tmp_path / "b.pth")
    assert again.losses == whole[0].losses
    assert_same_weights(whole[1], tmp_path / "b.pth")


@pytest.mark.parametrize("stop", [5, 12, 15])
def test_a_run_that_was_cut_off_ends_as_if_it_had_not_been(
    whole: tuple[PoseRegressor, Path], tmp_path: Path, stop: int
) -> None:
    data, path = some_data(window=3), tmp_path / "c.pth"
    train(CUT, data, SETTINGS, checkpoint=path, stop_after=stop)
    with pytest.raises(TrainingError, match=f"{stop} of 18 steps"):
        load(path, data, CUT, SETTINGS)
    torch.manual_seed(stop)
    done = train(CUT, data, SETTINGS, checkpoint=path, resume=True)
    assert done.losses == whole[0].losses
    assert_same_weights(whole[1], path)
    read = load(path, data, CUT, SETTINGS)
    assert np.array_equal(read.predict(data.inputs[:3]), whole[0].predict(data.inputs[:3]))


def assert_same_weights(one: Path, other: Path) -> None:
    a, b = (torch.load(path, weights_only=True)["model"] for path in (one, other))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_checkpoints_of_something_else_are_refused(tmp_path: Path) -> None:
    path, data = tmp_path / "net.pth", some_data()
    train(replace(SMALL, steps=2), data, SETTINGS, checkpoint=path)
    with pytest.raises(UsageError, match="is there already"):
        train(SMALL, data, SETTINGS, checkpoint=path)
    with pytest.raises(TrainingError, match="other options"):
        train(SMALL, data, SETTINGS, checkpoint=path, resume=True)
    with pytest.raises(TrainingError, match="other frames"):
        load(path, some_data(23), SMALL, SETTINGS)
    with pytest.raises(TrainingError, match="is posenet on frozen, not cnn-lstm"):
        load(path, data, replace(SMALL, kind="cnn-lstm"), SETTINGS)
    with pytest.raises(UsageError, match="nothing to go on from"):
        train(SMALL, data, SETTINGS, checkpoint=tmp_path / "none.pth", resume=True)
    with pytest.raises(TrainingError, match="maps of another encoder"):
        load(path, replace(data, encoder="0" * 64), SMALL, SETTINGS)
    content = torch.load(path, weights_only=True)
    narrow = replace(data, inputs=data.inputs[:, :6])
    with pytest.raises(
        ModelError, match=r"no checkpoint of posenet on these inputs: trunk.0.weight is \[32, 12, 1, 1\]"
    ):
        load(path, narrow, SMALL, SETTINGS)
    for broken in ({"step": None}, {"losses": None}, {"options": 3}, {"options": {"kind": []}}):
        torch.save(content | broken, path)
        with pytest.raises(TrainingError, match="is a damaged checkpoint"):
            load(path, data, SMALL, SETTINGS)
    torch.save({"weights": torch.ones(1)}, path)
    with pytest.raises(TrainingError, match="no checkpoint of semdb train pose"):
        load(path, data, SMALL, SETTINGS)
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file/net.pth cannot be written"):
        train(SMALL, data, SETTINGS, checkpoint=tmp_path / "file" / "net.pth")


def test_the_first_convolution_is_widened_by_the_mean_of_its_colours(tmp_path: Path) -> None:
    import torchvision

    torch.manual_seed(1)
    published = torchvision.models.resnet34(weights=None)
    torch.save(published.state_dict(), tmp_path / "resnet34.pth")
    options = PoseOptions(kind="posenet-4d", backbone="resnet34", weights=tmp_path / "resnet34.pth", width=8)
    network = build(options, (4, 224, 224))
    first = network.trunk.conv1.weight
    assert first.shape == (64, 4, 7, 7)
    assert torch.equal(first[:, :3], published.conv1.weight)
    assert torch.allclose(first[:, 3], published.conv1.weight.mean(dim=1))
    with pytest.raises(ModelError, match="no checkpoint of mobilenet_v2"):
        build(replace(options, backbone="mobilenet_v2"), (4, 224, 224))


@pytest.mark.parametrize("backbone", ["resnet34", "mobilenet_v2"])
def test_whole_networks_take_a_step_from_random_weights(backbone: str) -> None:
    options = PoseOptions(kind="posenet-4d", backbone=backbone, steps=1, batch=2, width=8)
    inputs = np.random.default_rng(0).integers(0, 255, (2, 4, 64, 64), dtype=np.uint8)
    data = PoseData(inputs, np.arange(2, dtype=np.int32)[:, None], some_poses(2), ("a", "b"))
    found = train(options, data, SETTINGS)
    assert np.isfinite(found.losses).all()
    assert np.isfinite(found.predict(inputs[:1])).all()


def test_a_filter_sees_nothing_after_the_frame() -> None:
    data = some_data(window=3)
    found = train(replace(SMALL, kind="cnn-lstm", steps=2, filter_steps=2), data, SETTINGS)
    with torch.no_grad():
        alone = single(found._network, torch.from_numpy(data.inputs[:5]).float())[1]
    assert alone.shape == (5, 6)
    assert found.predict(data.inputs[:3]).shape == (4, 4)
    moved = data.inputs[[2, 1, 0]]
    assert not np.array_equal(found.predict(moved), found.predict(data.inputs[[1, 2, 0]]))  # it does look back


def test_depth_is_in_units_of_four_metres_and_holes_are_nothing() -> None:
    depth = np.full((8, 8), 2.0, dtype=np.float32)
    depth[:4] = np.nan
    assert np.array_equal(depth_plane(depth, 2, 2), [[0.0, 0.0], [0.5, 0.5]])
    planes = PixelInputs(True)(np.zeros((8, 8, 3), np.uint8), depth)
    assert planes.shape == (4, 224, 224)
    assert planes[3, -1, 0] == 64
    assert PixelInputs(False)(np.zeros((8, 8, 3), np.uint8), None).shape == (3, 224, 224)


def write_pooled_encoder(path: Path) -> Path:
    """An encoder whose embedding is the mean of a map of cells of 32 pixels, each their mean colour times two."""
    weight = np.zeros((3, 3, 32, 32), dtype=np.float32)
    for k in range(3):
        weight[k, k] = 2 / 32**2
    nodes = [
        onnx.helper.make_node("Conv", ["image", "w"], ["map"], strides=[32, 32]),
        onnx.helper.make_node("GlobalAveragePool", ["map"], ["pooled"]),
        onnx.helper.make_node("Flatten", ["pooled"], ["embedding"]),
    ]
    floats = onnx.TensorProto.FLOAT
    graph = onnx.helper.make_graph(
        nodes,
        "encoder",
        [onnx.helper.make_tensor_value_info("image", floats, ["B", 3, 224, 224])],
        [onnx.helper.make_tensor_value_info("embedding", floats, ["B", 3])],
        [onnx.numpy_helper.from_array(weight, "w")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
    return path


def test_frozen_features_are_the_map_that_the_embedding_is_the_mean_of(tmp_path: Path) -> None:
    path = write_pooled_encoder(tmp_path / "encoder.onnx")
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image[:, 320:, 0] = 255
    said: list[str] = []
    found = make_inputs(PoseOptions(), f"onnx:{path}", SETTINGS, said.append)(image, None)
    assert (found.shape, found.dtype, said) == ((3, 7, 7), np.float16, [])
    assert found[0, 0].astype(float) == pytest.approx([0, 0, 0, 1, 2, 2, 2], abs=0.02)
    assert not found[1:].any()
    depth = np.full((480, 640), 2.0, dtype=np.float32)
    deep = FrozenInputs(path, True, SETTINGS)(image, depth)
    assert deep.shape == (19, 7, 7)
    assert (deep[3:] == 0.5).all()
    plain = write_mean_embedding_model(tmp_path / "plain.onnx")
    assert make_inputs(PoseOptions(), f"onnx:{plain}", SETTINGS, said.append)(image, None).shape == (3, 1, 1)
    assert "no mean of a map" in said[0]


@dataclass(frozen=True, eq=False)
class _Room:
    name: str
    entries: tuple[Any, ...]


def task(total: int, asked: list[int], keyframes: list[int]) -> Any:
    entries = tuple(SimpleNamespace(index=10 * k, world_from_camera=np.eye(4)) for k in range(total))
    recording = _Room("room", entries)
    key, query = (
        (SimpleNamespace(recording=recording, entries=tuple(entries[k] for k in chosen)),)
        for chosen in (keyframes, asked)
    )
    return SimpleNamespace(name="room", keyframes=key, queries=query, truth="given")


def test_frames_within_two_of_a_query_are_not_learnt_from() -> None:
    [part] = training_parts(task(12, [4], [0, 5, 11]), keyframes_only=False)
    assert [entry.index // 10 for entry in part.entries] == [0, 1, 7, 8, 9, 10, 11]
    [part] = training_parts(task(12, [4], [0, 5, 11]), keyframes_only=True)
    assert [entry.index // 10 for entry in part.entries] == [0, 5, 11]
    with pytest.raises(UsageError, match="ask fewer with --max-queries"):
        training_parts(task(4, [1, 2], [0, 3]), keyframes_only=False)
    with pytest.raises(UsageError, match="--truth given"):
        training_parts(SimpleNamespace(**{**vars(task(12, [4], [0])), "truth": "refined"}), keyframes_only=False)  # type: ignore[arg-type]


def test_trivial_answers_and_how_they_count() -> None:
    poses = some_poses(5)
    assert np.array_equal(fixed_pose(method_named("middle-keyframe"), poses), poses[2])
    answer = always(fixed_pose(method_named("mean-pose"), poses), "fixed", "", 0.0)
    assert answer.verdict is Verdict.LOCALIZED
    assert np.isnan(answer.confidence)
    assert answer.covariance is None


def test_methods_and_options_that_make_no_sense() -> None:
    assert tuple(f"{k}{on}" for k in ("posenet", "posenet-4d", "cnn-lstm") for on in ("", "-keyframes")) == NETWORKS
    assert method_named("posenet-4d").query_depth
    with pytest.raises(UsageError, match="takes it by itself"):
        method_named("posenet+depth")
    with pytest.raises(UsageError, match="--pose-backbone vgg"):
        PoseOptions(backbone="vgg")
    with pytest.raises(UsageError, match="frozen features have the weights"):
        PoseOptions(weights=Path("a.pth"))
    with pytest.raises(UsageError, match="set SEMDB_ENCODER"):
        make_inputs(PoseOptions(), "torchvision:resnet50", SETTINGS)
    assert rate_at(PoseOptions(), 0) == 5e-4
    assert rate_at(PoseOptions(backbone="resnet34"), 800) == 1e-4


def test_without_torch_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ModelError, match=r"--method posenet learns with torch.*pip install 'semdb\[torch\]'"):
        check_torch(method_named("posenet"))
    check_torch(method_named("semdb"))
