"""GIST: the spatial envelope of a scene, without training (Oliva and Torralba, IJCV 42(3), 2001)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import scipy.fft

from semdb.perception.model_files import canonical_json
from semdb.types import Float32Array, ImageArray, ModelInfo

SIDE = 128  # the image is resized to SIDE x SIDE
PADDING = 32  # reflected on each side, so that the border has no edge of its own
WINDOW = 96  # samples of a filter's response across the padded image
SCALES = 4
ORIENTATIONS = 8
GRID = 4
COLOUR_WEIGHT = 0.5


class GistEncoder:
    """Energies of oriented band-pass filters on a 4x4 grid, and the layout of colours; 560 numbers."""

    def __init__(self) -> None:
        config = {
            "colour_weight": COLOUR_WEIGHT,
            "grid": GRID,
            "orientations": ORIENTATIONS,
            "padding": PADDING,
            "scales": SCALES,
            "side": SIDE,
            "version": 1,
        }
        self.info = ModelInfo("encoder", "gist", "", canonical_json(config))
        self._index, self._gain = _filters(SIDE + 2 * PADDING, WINDOW)

    def encode(self, image: ImageArray) -> Float32Array:
        """The L2-normalised descriptor float32 ``[560]`` of an RGB `image` ``[H, W, 3]``.

        An image of one plain colour has no envelope; its vector is the constant one.
        """
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        texture = self._texture(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
        vector = np.concatenate([_unit(texture), COLOUR_WEIGHT * _unit(_colours(small))])
        norm = float(np.linalg.norm(vector))
        if norm == 0:
            return np.full(len(vector), 1 / np.sqrt(len(vector)), dtype=np.float32)
        return (vector / norm).astype(np.float32)

    def _texture(self, grey: ImageArray) -> npt.NDArray[np.float64]:
        padded = cv2.copyMakeBorder(grey, PADDING, PADDING, PADDING, PADDING, cv2.BORDER_REFLECT_101)
        spectrum = scipy.fft.fft2(_even_contrast(padded)).astype(np.complex64)
        bands = spectrum.ravel()[self._index] * self._gain
        response = np.abs(scipy.fft.ifft2(bands, overwrite_x=True))
        margin = PADDING * WINDOW // (SIDE + 2 * PADDING)
        inner = response[:, margin:-margin, margin:-margin]
        cell = inner.shape[1] // GRID
        energies = inner.reshape(len(inner), GRID, cell, GRID, cell).mean(axis=(2, 4), dtype=np.float64)
        # Less its mean and scaled, each scale counts alike; as they are, coarse energy makes all images look alike.
        by_scale = energies.reshape(SCALES, -1)
        return np.concatenate([_unit(scale - scale.mean()) for scale in by_scale])


def _even_contrast(grey: ImageArray) -> Float32Array:
    """`grey` without slow changes of brightness and with its local contrast evened out."""
    logarithm = np.log1p(grey.astype(np.float32))
    sigma = SIDE / 16
    detail = logarithm - cv2.GaussianBlur(logarithm, (0, 0), sigma)
    deviation = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), sigma))
    evened: Float32Array = detail / (np.float32(0.1) + deviation)
    return evened


def _colours(small: ImageArray) -> npt.NDArray[np.float64]:
    """Mean lightness and colour of each cell, less their means over the image, ``[3 * GRID * GRID]``."""
    lab = cv2.cvtColor(cv2.resize(small, (GRID, GRID), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB)
    cells = lab.reshape(-1, 3).astype(np.float64)
    return np.asarray((cells - cells.mean(axis=0)).T.ravel())


def _unit(block: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    norm = float(np.linalg.norm(block))
    return block / norm if norm > 1e-6 else np.zeros_like(block)


def _filters(size: int, window: int) -> tuple[npt.NDArray[np.intp], Float32Array]:
    """Gabor-like filters in the frequency domain: where each takes its `window` of the spectrum, and its gains.

    Each filter is one-sided, a Gaussian in radius about its frequency and in angle about its orientation, so the
    magnitude of its response is the local energy. Moving a band to frequency zero does not change that magnitude,
    hence a window about the centre of the band is enough: the response comes out on a coarser grid, at less cost.
    """
    offsets = scipy.fft.fftfreq(window, 1 / window)
    index, gain = [], []
    for scale in range(SCALES):
        centre = 0.3 / 1.85**scale * size  # cycles across the padded image
        for orientation in range(ORIENTATIONS):
            angle = np.pi * orientation / ORIENTATIONS
            u = np.rint(centre * np.cos(angle)) + offsets[None, :]
            v = np.rint(centre * np.sin(angle)) + offsets[:, None]
            radius = np.hypot(u, v) / centre
            turn = np.angle(np.exp(1j * (np.arctan2(v, u) - angle)))
            response = np.exp(-3.5 * (radius - 1) ** 2 - (turn * ORIENTATIONS / np.pi) ** 2 * 0.8)
            # Frequencies beyond the image's sampling would wrap round to others.
            response = np.where((np.abs(u) < size / 2) & (np.abs(v) < size / 2) & (radius > 0), response, 0)
            index.append((np.mod(v, size) * size + np.mod(u, size)).astype(np.intp))
            gain.append(response.astype(np.float32))
    return np.stack(index), np.stack(gain)
