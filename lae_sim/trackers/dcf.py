"""A discriminative correlation filter: the tracker that needs no weights.

The position comes from a filter on gradient and colour channels [1] that is confined to the target
[2, 3] and kept close to the filter before [4]; the size from a filter over scales [5]. The score is
the peak-to-sidelobe ratio [6], and a frame with a low one is not learnt from.

[1] Henriques et al., High-Speed Tracking with Kernelized Correlation Filters, TPAMI 2015.
[2] Kiani Galoogahi et al., Learning Background-Aware Correlation Filters, ICCV 2017.
[3] Lukezic et al., Discriminative Correlation Filter with Channel and Spatial Reliability, CVPR
    2017.
[4] Li et al., Learning Spatial-Temporal Regularized Correlation Filters, CVPR 2018.
[5] Danelljan et al., Discriminative Scale Space Tracking, TPAMI 2017.
[6] Bolme et al., Visual Object Tracking using Adaptive Correlation Filters, CVPR 2010.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from lae_sim.errors import LaeError
from lae_sim.trackers.protocol import Array, Image, checked_box, checked_frame, checked_search
from lae_sim.trackers.stages import stage

CELLS = 32  # of the search window, whose side is CELL * CELLS pixels whatever the target's size
SCALE_SIDE = 32  # pixels of a patch of the scale filter
SMALLEST = 32.0  # side of the search window, pixels of the frame

# With the mean energy of the channels as unit: the penalty that ties the filter to the one before,
# the step size of ADMM and its growth, the ridge.
TEMPORAL, STEP, GROWTH, RIDGE = 15.0, 0.01, 4.0, 0.01
ITERATIONS = 2

SCALE_RATE, PSR_RATE = 0.025, 0.05  # of running averages


class Dcf:
    """A discriminative correlation filter on the CPU, or with its transforms on a GPU.

    Args:
        device: ``"cpu"`` (NumPy), or a device of torch: ``"cuda:0"``, ``"torch:cpu"``.
        padding: side of the search window over the target's ``sqrt(w * h)``.
        scales: number of scales that are compared; 1 keeps the size.
        scale_step: ratio of one scale to the next.
        min_psr: share of its mean below which the peak-to-sidelobe ratio means that the target is
            not seen: the box stays, and the frame is not learnt from.

    Raises:
        LaeError: if the device cannot be used, or a setting is out of range.
    """

    def __init__(
        self,
        device: str = "cpu",
        padding: float = 4.0,
        scales: int = 17,
        scale_step: float = 1.03,
        min_psr: float = 0.3,
    ) -> None:
        if not (padding > 1 and scales >= 1 and scales % 2 and 1 < scale_step < 2):
            raise LaeError("dcf: padding must exceed 1, scales be odd, scale_step within 1..2")
        self._settings = {
            "device": device,
            "padding": padding,
            "scales": scales,
            "scale_step": scale_step,
            "min_psr": min_psr,
        }
        self._padding, self._min_psr = padding, min_psr
        self._torch, self._device = _torch(device)
        self._fft: Any = self._torch.fft if self._torch else np.fft
        window = np.hanning(CELLS + 2)[1:-1]
        self._window = np.outer(window, window).astype(np.float32)
        # a Gaussian of a sixteenth of the target's size [2], in cells
        wanted = _gaussian(CELLS, CELLS / padding / 16)
        self._wanted = self._to(np.fft.rfft2(np.outer(wanted, wanted)).real.astype(np.float32))
        self._scale_step = scale_step
        self._steps = scale_step ** (np.arange(scales) - scales // 2.0)
        self._scale_window = np.hanning(scales + 2)[1:-1, None].astype(np.float32)
        self._wanted_scale = np.fft.rfft(_gaussian(scales, scales / 16))
        self._filter: Any = None  # complex64 [C, CELLS, CELLS/2 + 1]
        self._started = False

    def init(self, frame: Image, box: Sequence[float]) -> None:
        """Learn the target in its first frame.

        Raises:
            LaeError: if the frame is no image, or the box no box.
        """
        frame = checked_frame(frame)
        x, y, w, h = checked_box(box)
        self._size = np.array([w, h])
        self._centre = np.array([x + w / 2, y + h / 2])  # of pixel edges: 0 is the image's corner
        self._keep_inside(frame)
        self._mean_psr = 0.0
        half_cells = self._size / self._side() * CELLS / 2
        columns, rows = (abs(np.arange(CELLS) - CELLS // 2) <= half + 0.5 for half in half_cells)
        self._mask = self._to(np.outer(rows, columns).astype(np.float32))
        self._started = False
        self._scale_filter = self._scale_energy = np.zeros(1, np.float32)
        with stage("learn"):
            self._learn(frame)
            self._rescale(frame)
        self._started = True

    def set_search(self, cx: float, cy: float, w: float, h: float) -> None:
        """Search the next frame around this centre for a target of this size.

        Raises:
            LaeError: if a number is not finite.
        """
        self._centre, self._size = checked_search(cx, cy, w, h)

    def track(self, frame: Image) -> tuple[tuple[float, float, float, float], float]:
        """The target's box in the next frame, and the peak-to-sidelobe ratio.

        Raises:
            LaeError: if the frame is no image, or ``init`` was not called.
        """
        frame = checked_frame(frame)
        if not self._started:
            raise LaeError("dcf: init must come before track")
        self._keep_inside(frame)
        with stage("inference"):
            response = (self._filter.conj() * self._channels(frame)).sum(0)
            shift, psr = _peak(response.cpu().numpy() if self._torch else response)
        if psr >= self._min_psr * self._mean_psr:
            self._mean_psr += PSR_RATE * (psr - self._mean_psr) if self._mean_psr else psr
            self._centre += shift * self._side() / CELLS
            self._keep_inside(frame)
            with stage("learn"):
                self._rescale(frame)
                self._learn(frame)
        (cx, cy), (w, h) = self._centre.tolist(), self._size.tolist()
        return (cx - w / 2, cy - h / 2, w, h), psr

    def sync(self) -> None:
        """Wait for the GPU, if one is used."""
        if self._torch and self._device.type == "cuda":
            self._torch.cuda.synchronize(self._device)

    def describe(self) -> dict[str, Any]:
        """Name, version, settings, and where it searches."""
        search = {
            # half the window over sqrt((w + p)(h + p)), which is 2 sqrt(w h) of a square target
            "half_side": self._padding / 4,
            "window": True,
            "source": f"a window of {self._padding:g} sqrt(w h), tapered; less for oblong targets",
        }
        return {"name": "dcf", "version": "1", "settings": self._settings, "search": search}

    def _to(self, array: Array) -> Any:
        return self._torch.from_numpy(array).to(self._device) if self._torch else array

    def _side(self) -> float:
        return max(self._padding * float(np.sqrt(self._size.prod())), SMALLEST)

    def _keep_inside(self, frame: Image) -> None:
        edge = np.array(frame.shape[1::-1], float)
        self._centre = np.clip(self._centre, 0.0, edge)
        self._size = np.minimum(self._size, np.maximum(4.0 * edge.max(), 1.0))

    def _channels(self, frame: Image) -> Any:
        """Fourier transform of the search window's channels, complex64 [C, CELLS, CELLS/2 + 1]."""
        side = self._side()
        with stage("preprocess"):
            channels = features(crop(frame, self._centre, (side, side), CELLS * CELL))
        channels -= channels.mean((1, 2), keepdims=True)
        return self._fft.rfft2(self._to(channels * self._window))

    def _learn(self, frame: Image) -> None:
        """Bring the filter up to date.

        The filter g minimises, summed over the frequencies of the search window,

            |g^H x - y|^2 + TEMPORAL |g - g_before|^2 + RIDGE |g|^2, g zero outside of the target

        by ADMM as in [2] and [4], with Sherman-Morrison's formula for each frequency.
        """
        x = self._channels(frame)
        energy = (x * x.conj()).real.sum(0)
        unit = float(energy.mean()) + 1e-6
        temporal = TEMPORAL * unit if self._started else 0.0
        wanted = x * self._wanted
        if self._started:
            wanted = wanted + temporal * self._filter
        step = STEP * unit
        confined: Any = 0.0
        dual: Any = 0.0
        for _ in range(ITERATIONS):
            v = wanted + step * (confined - dual)
            inverse = (x.conj() * v).sum(0) / (step + temporal + energy)
            free = (v - x * inverse) / (step + temporal)
            weight = self._mask * (step / (step + RIDGE * unit))
            confined = self._fft.rfft2(self._fft.irfft2(free + dual, (CELLS, CELLS)) * weight)
            dual = (dual + free - confined) / GROWTH
            step *= GROWTH
        self._filter = confined

    def _scale_features(self, frame: Image) -> Array:
        """Fourier transform over the scales of the target's features, complex64 [S/2 + 1, F]."""
        with stage("preprocess"):
            patches = [crop(frame, self._centre, self._size * s, SCALE_SIDE) for s in self._steps]
            found = features(np.concatenate(patches))  # one call, since each has a cost of its own
        rows = found.reshape(len(found), len(patches), -1).swapaxes(0, 1).reshape(len(patches), -1)
        return np.fft.rfft(rows * self._scale_window, axis=0).astype(np.complex64)

    def _rescale(self, frame: Image) -> None:
        """Multiply the size by the scale that responds most ([5]), and learn."""
        if len(self._steps) == 1:
            return
        z = self._scale_features(frame)
        found = 0.0
        if self._started:
            ridge = 0.01 * self._scale_energy.mean() + 1e-6
            product = (self._scale_filter.conj() * z).sum(1) / (self._scale_energy + ridge)
            response = np.fft.fftshift(np.fft.irfft(product, len(self._steps)))
            best = int(response.argmax())
            inside = 0 < best < len(response) - 1
            found = best - len(response) // 2
            found += _vertex(*response[best - 1 : best + 2]) if inside else 0.0
        # the features at the new size are those at the old one, shifted along the scales
        phase = np.exp(-2j * np.pi * found * np.arange(len(z)) / len(self._steps))
        wanted = (self._wanted_scale * phase).astype(np.complex64)[:, None]
        rate = SCALE_RATE if self._started else 1.0
        self._scale_filter = (1 - rate) * self._scale_filter + rate * z * wanted.conj()
        self._scale_energy = (1 - rate) * self._scale_energy + rate * (z * z.conj()).real.sum(1)
        size = self._size * self._scale_step**found
        if size.min() >= 1 and size.max() <= 2 * max(frame.shape[:2]):
            self._size = size


def _torch(device: str) -> tuple[Any, Any]:
    """Torch and its device, or nothing where NumPy is meant."""
    if device == "cpu":
        return None, None
    try:
        import torch

        found = torch.device(device[6:] if device.startswith("torch:") else device)
        torch.zeros(1, device=found)
    except (ImportError, RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise LaeError(f"dcf: the device {device!r} cannot be used: {reason}") from error
    return torch, found


def _gaussian(count: int, sigma: float) -> Array:
    """A Gaussian around index 0, wrapped around, float64 [count]."""
    return np.fft.ifftshift(np.exp(-0.5 * ((np.arange(count) - count // 2) / sigma) ** 2))


def _peak(transformed: Array) -> tuple[Array, float]:
    """Where the response is largest: x, y from the centre in cells, and the ratio of [6]."""
    r = np.fft.irfft2(transformed.astype(np.complex128), (CELLS, CELLS))
    row, column = (int(i) for i in np.unravel_index(r.argmax(), r.shape))
    # between the cells the response is its Fourier series
    fine = np.linspace(-0.75, 0.75, 13)
    down = np.exp(2j * np.pi * np.outer(row + fine, np.fft.fftfreq(CELLS)))
    along = np.exp(2j * np.pi * np.outer(np.fft.rfftfreq(CELLS), column + fine))
    along[1:-1] *= 2  # the half of the spectrum that a real transform leaves out
    near = (down @ transformed @ along).real
    i, j = (int(k) for k in np.unravel_index(near.argmax(), near.shape))
    step = fine[1] - fine[0]
    x, y = column + fine[j], row + fine[i]
    if 0 < i < len(fine) - 1 and 0 < j < len(fine) - 1:
        x += step * _vertex(*near[i, j - 1 : j + 2])
        y += step * _vertex(*near[i - 1 : i + 2, j])
    half = CELLS // 2
    shift = (np.array([x, y]) + half) % CELLS - half
    centred = np.roll(r, (half - row, half - column), (0, 1))
    sidelobe = np.ones(r.shape, bool)
    sidelobe[half - 3 : half + 4, half - 3 : half + 4] = False
    rest = centred[sidelobe]
    return shift, float((r[row, column] - rest.mean()) / (rest.std() + 1e-9))


def _vertex(left: float, middle: float, right: float) -> float:
    """Where the parabola through three points at -1, 0, 1 is largest, middle being the largest."""
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


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
