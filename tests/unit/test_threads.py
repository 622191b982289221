"""Keyframes side by side give what one after the other gives."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pose import estimate_pose, match_views
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import ClassNumbers
from semdb.threads import MOST, cores, each
from tests.unit.localization_scene import Scene


def test_results_are_in_order_and_items_run_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=20)

    def work(item: int) -> tuple[int, int]:
        if item < 2:
            both.wait()  # never passed by one thread alone
        return item * item, threading.get_ident()

    found = each(work, range(5), 2)
    assert [square for square, _ in found] == [0, 1, 4, 9, 16]
    assert found[0][1] == threading.get_ident()
    assert len({thread for _, thread in found}) == 2


@pytest.mark.parametrize("threads", [0, 1])
def test_one_thread_is_the_calling_one(threads: int) -> None:
    assert set(each(lambda item: threading.get_ident(), range(3), threads)) == {threading.get_ident()}
    assert each(lambda item: threading.get_ident(), [1], 4) == [threading.get_ident()]
    assert each(lambda item: item, [], 4) == []


def test_the_first_error_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        each(lambda item: 1 // item, [2, 1, 0], 2)


def test_a_forked_process_has_threads_of_its_own() -> None:
    assert each(lambda item: item + 1, range(3), 2) == [1, 2, 3]
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:  # would wait for ever for threads that it does not have
        signal.alarm(20)
        os.write(writing, bytes(each(lambda item: item + 1, range(3), 2)))
        os._exit(0)
    os.close(writing)
    assert os.waitpid(child, 0)[1] == 0
    assert os.read(reading, 10) == bytes([1, 2, 3])
    os.close(reading)


def test_a_localizer_has_the_threads_that_it_is_told() -> None:
    given = LocalizerOptions(neighbours=1)
    told = given.with_threads(3)
    assert told.pose.threads == 3
    assert told == replace(given, pose=replace(given.pose, threads=3))  # and nothing else is changed


def test_a_pose_does_not_depend_on_threads() -> None:
    assert 1 <= cores() <= MOST
    scene, numbers = Scene(), ClassNumbers()
    query = scene.query(scene.pose(0.2, 5.0), numbers, pixel_noise=0.5)
    keyframes = [scene.keyframe(n, scene.pose(0.1, 3.0), numbers) for n in range(4)]
    poses = []
    for threads in (1, 3):
        options = replace(PoseOptions(), threads=threads)
        matches = match_views(query, keyframes, options)
        assert [len(found) for found in matches] == [len(found) for found in match_views(query, keyframes, options)]
        estimate = estimate_pose(query, keyframes, matches, options)
        assert estimate is not None
        poses.append(estimate.world_from_camera)
    np.testing.assert_array_equal(poses[0], poses[1])
