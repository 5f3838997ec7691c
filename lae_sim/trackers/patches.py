"""Patches of a frame, and the features of their cells."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from lae_sim.trackers.protocol import Array, Image

CELL = 4  # pixels
ORDERS = 3  # of the Fourier series of a gradient histogram
BINS = 2 * ORDERS + 1


def crop(frame: Image, centre: Array, size: Sequence[float], side: int) -> Image:
    """What a box shows, whatever its size, as uint8 [side, side, 3].

    Args:
        frame: uint8 [H, W, 3]; beyond it, its edge is repeated.
        centre, size: ``x, y`` and ``w, h`` of the box, pixels.
        side: pixels of a side of the patch.
    """
    # warpAffine does not average: a small picture of a large box is made from a larger one
    finer = int(np.clip(np.ceil(max(size) / side / 1.5), 1, 4))
    pixels = side * finer
    sx, sy = pixels / size[0], pixels / size[1]
    left, top = centre[0] - size[0] / 2, centre[1] - size[1] / 2
    # the centres of the first pixels coincide
    matrix = np.array([[sx, 0, sx * (0.5 - left) - 0.5], [0, sy, sy * (0.5 - top) - 0.5]])
    patch = cv2.warpAffine(frame, matrix, (pixels, pixels), borderMode=cv2.BORDER_REPLICATE)
    if finer > 1:
        patch = cv2.resize(patch, (side, side), interpolation=cv2.INTER_AREA)
    return np.asarray(patch, np.uint8)


def features(patch: Image) -> Array:
    """Gradient histograms and mean colours of the cells, float32 [BINS + 3, H/CELL, W/CELL].

    A histogram of orientations is summed as its Fourier series (Liu et al., Rotation-Invariant HOG
    Descriptors Using Fourier Analysis in Polar and Spherical Coordinates, IJCV 2014): that takes no
    arctangent and no binning of pixels. It is then normalised and clipped (Dalal and Triggs,
    Histograms of Oriented Gradients for Human Detection, CVPR 2005).
    """
    cells = (patch.shape[1] // CELL, patch.shape[0] // CELL)
    ycc = cv2.cvtColor(patch, cv2.COLOR_BGR2YCrCb)  # Lab sets up its tables for 100 ms
    grey = np.ascontiguousarray(ycc[..., 0])
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1)
    magnitude = np.sqrt(dx * dx + dy * dy)  # cv2.magnitude depends on the alignment of memory
    # magnitude * (cos, sin) of 2 k angle, for opposite gradients are one orientation
    terms = [magnitude]
    inverse = 1.0 / (magnitude + 1e-6)
    cos, sin = (dx * dx - dy * dy) * inverse, 2.0 * dx * dy * inverse
    twice = 2.0 * cos * inverse
    before = magnitude, np.zeros_like(magnitude)
    for _ in range(ORDERS):
        terms += [cos, sin]
        before, (cos, sin) = (cos, sin), (twice * cos - before[0], twice * sin - before[1])
    series = np.stack([cv2.resize(t, cells, interpolation=cv2.INTER_AREA) for t in terms])
    histogram = np.maximum(_SERIES_TO_BINS @ series.reshape(len(series), -1), 0.0)
    histogram = histogram.reshape(BINS, cells[1], cells[0])
    energy = cv2.blur((histogram**2).sum(0), (3, 3))
    histogram = np.minimum(histogram / np.sqrt(energy + 0.5), 0.4)
    colour = cv2.resize(ycc, cells, interpolation=cv2.INTER_AREA).transpose(2, 0, 1) / 255.0 - 0.5
    return np.concatenate([histogram, 3.0 * colour]).astype(np.float32)


def _series_to_bins() -> Array:
    """The values of the series at the bins' orientations, smoothed as if bins were triangles."""
    order = np.arange(1, ORDERS + 1)[:, None]
    angle = 2 * order * np.arange(BINS) * np.pi / BINS
    weight = 2 * np.sinc(order / BINS) ** 2
    waves = np.stack([weight * np.cos(angle), weight * np.sin(angle)], 1).reshape(-1, BINS)
    return np.concatenate([np.ones((1, BINS)), waves]).T.astype(np.float32) / BINS


_SERIES_TO_BINS = _series_to_bins()
