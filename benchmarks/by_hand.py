"""What one would write instead of ``lae-sim replay``: one trace, 51 permitted latencies, by hand.

``python benchmarks/by_hand.py TRACE [kalman]`` prints the four scores at each sigma as JSON: of the
latest box, and with ``kalman`` of the paper's filter too, which runs anew for each sigma. It takes
the frame rate, the convention and a truth in every frame for granted, and counts time in ticks of
1/30 ns, as lae_sim does.
"""

import json
import sys
from itertools import pairwise

import numpy as np
import pyarrow.parquet as pq

FPS, FRAME = 30, 10**9  # ticks of a frame interval; a nanosecond is 30 ticks
OVERLAPS, SHARES = np.arange(21) / 20, np.arange(51) / 100


def schedule(elapsed):
    frame, now, frames, ready = 0, 0, [], []
    while now < len(elapsed) * FRAME:
        frames.append(frame)
        ready.append(now + int(elapsed[frame]) * FPS)
        newest = ready[-1] // FRAME
        frame = max(newest, frame + 1)
        now = max(ready[-1], frame * FRAME)
    return np.array(frames), np.array(ready)


def score(boxes, truth):
    corner = np.minimum(boxes[:, :2] + boxes[:, 2:], truth[:, :2] + truth[:, 2:])
    inside = np.clip(corner - np.maximum(boxes[:, :2], truth[:, :2]), 0, None).prod(axis=1)
    iou = inside / (boxes[:, 2:].prod(axis=1) + truth[:, 2:].prod(axis=1) - inside)
    offset = boxes[:, :2] + boxes[:, 2:] / 2 - truth[:, :2] - truth[:, 2:] / 2
    error, share = np.linalg.norm(offset, axis=1), np.linalg.norm(offset / truth[:, 2:], axis=1)
    passed = iou[:, None] > OVERLAPS, error <= 20, share <= 0.2, share[:, None] <= SHARES
    return [each.mean() for each in passed]


def kalman(frames, boxes, answer):
    state, covariance, last = np.append(boxes[0], np.zeros(4)), 100 * np.eye(8), 0
    states, measure = np.zeros((len(frames), 8)), np.eye(4, 8)
    states[0] = state
    for output in np.unique(answer)[1:]:  # those overtaken between two queries are not used
        interval, last = frames[output] - last, frames[output]
        move = np.eye(8) + interval * np.eye(8, k=4)
        state = move @ state
        covariance = move @ covariance @ move.T + interval**2 * np.eye(8)
        gain = covariance @ measure.T @ np.linalg.inv(covariance[:4, :4] + 10 * np.eye(4))
        state = state + gain @ (boxes[output] - state[:4])
        covariance = covariance - gain @ measure @ covariance
        states[output] = state
    ahead = np.arange(len(answer)) - frames[answer]
    return states[answer, :4] + ahead[:, None] * states[answer, 4:]


table = pq.read_table(sys.argv[1])
column = {name: table[name].to_numpy() for name in table.column_names}
truths = np.column_stack([column[f"truth_{side}"] for side in "xywh"])
boxes = np.column_stack([column[side] for side in "xywh"])
starts = np.append(np.flatnonzero(column["frame"] == 0), len(boxes))
scores = {name: np.zeros((len(starts) - 1, 51, 4)) for name in ["hold", *sys.argv[2:]]}
for s, (begin, end) in enumerate(pairwise(starts)):
    truth, times = truths[begin:end], column["elapsed_ns"][begin:end]
    frames, ready = schedule(times)
    outputs = boxes[begin:end][frames]
    for m in range(51):
        query = np.arange(end - begin) * FRAME + m * FRAME // 50
        answer = np.maximum(np.searchsorted(ready, query, side="right") - 1, 0)
        scores["hold"][s, m] = score(outputs[answer], truth)
        if "kalman" in scores:
            scores["kalman"][s, m] = score(kalman(frames, outputs, answer), truth)
print(json.dumps({name: values.mean(axis=0).tolist() for name, values in scores.items()}))
