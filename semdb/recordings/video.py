"""Frames of a video by their number, exactly: they are decoded in order, since seeking lands beside where it should."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np

from semdb.errors import FrameError
from semdb.files import UnusableFileError, check_place
from semdb.recordings.headers import MOST_PIXELS
from semdb.types import ImageArray


class Video:
    """One video file. Asking for frames in ascending order decodes it once; going back begins anew.

    A mark that says how to turn the pictures is not applied: intrinsics belong to the pixels as stored.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._capture: cv2.VideoCapture | None = None
        self._next = 0

    def frame(self, number: int) -> ImageArray:
        """The picture ``[H, W, 3]`` RGB. Raises FrameError for a video that cannot be decoded or ends before it."""
        with self._lock:
            if self._capture is None or number < self._next:
                self._open()
            capture = self._capture
            assert capture is not None
            while self._next < number:
                if not capture.grab():
                    raise FrameError(f"{self._path}: ends after {self._next} frames; frame {number} is not there")
                self._next += 1
            done, picture = capture.read()
            if not done or picture is None:
                raise FrameError(f"{self._path}: frame {number} cannot be decoded, or the video ends before it")
            self._next += 1
        return np.ascontiguousarray(picture[..., ::-1])

    @property
    def size(self) -> tuple[int, int]:
        """Width and height. Raises FrameError for a video that cannot be opened."""
        with self._lock:
            if self._capture is None:
                self._open()
            assert self._capture is not None
            width, height = (int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width <= 0 or height <= 0:
            raise FrameError(f"{self._path}: is no video that can be decoded")
        return width, height

    def _open(self) -> None:
        if self._capture is not None:
            self._capture.release()
        if not self._path.is_file():
            raise FrameError(f"{self._path}: the file is missing")
        try:
            check_place(self._path)
        except UnusableFileError as error:
            raise FrameError(error.at(self._path)) from error
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below says it all
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            raise FrameError(f"{self._path}: is no video that can be decoded")
        if capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT) > MOST_PIXELS:
            raise FrameError(
                f"{self._path}: its pictures are too large: at most {MOST_PIXELS / 1e6:.0f} million pixels"
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._capture, self._next = capture, 0
