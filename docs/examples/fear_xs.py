"""FEAR-XS on ONNX Runtime: a whole tracker of today, as a user writes one.

FEAR (Borsuk et al., "FEAR: Fast, Efficient, Accurate and Robust Visual Tracker", ECCV 2022) takes
features of the target once, and then in each frame answers for each point of a 16 x 16 grid whether
the target is there and how far its four sides are. Two models do that: ``fear_xs_init.onnx``
(``image`` [1, 3, 128, 128] -> ``features``) and ``fear_xs_track.onnx`` (``image`` [1, 3, 256, 256],
``template_features`` -> ``bbox`` [1, 4, 16, 16], ``cls`` [1, 1, 16, 16]).

    lae-sim profile --tracker fear_xs:FearXS --option weights=FOLDER --root DATASET --threads 1
"""

from pathlib import Path

import cv2
import numpy as np

from lae_sim.trackers import onnx_session, stage

TEMPLATE, SEARCH, STRIDE = 128, 256, 16  # pixels of the two crops, and between points of the grid
AROUND_TEMPLATE, AROUND_SEARCH = 0.2, 2.0  # what a crop has on each side of the box, in its sides


class FearXS:
    def __init__(self, weights, provider="CPU"):
        init, track = (Path(weights) / f"fear_xs_{part}.onnx" for part in ("init", "track"))
        self.features = onnx_session(init, provider)  # fails here, with the path, or not at all
        self.network = onnx_session(track, provider)
        self.points = STRIDE * (np.arange(SEARCH // STRIDE) - SEARCH // STRIDE // 2) + SEARCH / 2

    def init(self, frame, box):
        self.edge = np.array(frame.shape[1::-1])
        self.colour = cv2.mean(frame)[:3]
        self.box = self.inside(box)
        image, _, _ = self.crop(frame, AROUND_TEMPLATE, TEMPLATE)
        (self.template,) = self.features.run(["features"], {"image": image})

    def set_search(self, cx, cy, w, h):
        self.box = self.inside((cx - w / 2, cy - h / 2, w, h))

    def track(self, frame):
        with stage("preprocess"):
            image, corner, scale = self.crop(frame, AROUND_SEARCH, SEARCH)
        with stage("inference"):
            inputs = {"image": image, "template_features": self.template}
            (sides,), ((logits,),) = self.network.run(["bbox", "cls"], inputs)
        row, column = np.unravel_index(logits.argmax(), logits.shape)
        left, top, right, bottom = sides[:, row, column].astype(float)
        place = np.array([self.points[column] - left, self.points[row] - top])
        size = np.maximum(np.array([left + right, top + bottom]) * scale, 3)
        self.box = self.inside(np.round([*(place * scale + corner), *size]))
        return self.box, 1 / (1 + np.exp(-float(logits[row, column])))

    def describe(self):
        search = {"half_side": 1.25, "window": False, "source": "a crop of 5 w, 5 h"}
        return {"name": "fear-xs", "settings": {"around": AROUND_SEARCH}, "search": search}

    def inside(self, box):
        """The part of a box within the frame, no thinner than 3 pixels."""
        start = np.clip(box[:2], 0, self.edge - 3)
        end = np.clip(np.add(box[:2], box[2:]), 0, self.edge)
        return [*start, *np.maximum(end - start, 3)]

    def crop(self, frame, around, pixels):
        """What lies around the box, as networks take it; its corner, and frame pixels in one."""
        x, y, w, h = self.box
        region = [x - w * around, y - h * around, w * (1 + 2 * around), h * (1 + 2 * around)]
        corner, size = np.split(np.array(region).astype(int), 2)
        scale = size / pixels
        start = (0.5 - corner) / scale - 0.5  # centres of pixels fall on centres of pixels
        matrix = np.array([[1 / scale[0], 0, start[0]], [0, 1 / scale[1], start[1]]])
        patch = cv2.warpAffine(frame, matrix, (pixels, pixels), borderValue=self.colour)
        image = patch[:, :, ::-1].transpose(2, 0, 1)[None]  # red, green, blue; channels first
        return np.ascontiguousarray(image, np.float32), corner, scale
