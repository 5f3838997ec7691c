"""SAM 2 on a stream of frames: a tracker that answers with masks, as a user writes one.

SAM 2 (Ravi et al., "SAM 2: Segment Anything in Images and Videos", 2024) comes as a predictor of
whole videos; https://github.com/Gy920/segment-anything-2-real-time has one that takes frame after
frame. It needs that package, a GPU, and a checkpoint with its configuration:

    lae-sim profile --tracker sam2_camera:Sam2 --option config=NAME.yaml checkpoint=FILE.pt
"""

import torch
from sam2.build_sam import build_sam2_camera_predictor

from lae_sim.trackers import box_of


class Sam2:
    def __init__(self, config, checkpoint):
        self.predictor = build_sam2_camera_predictor(config, checkpoint)

    def init(self, frame, box):
        x, y, w, h = box
        self.predictor.frame_idx = 0  # which the first frame of another sequence leaves as it is
        with torch.autocast("cuda", dtype=torch.bfloat16):
            self.predictor.load_first_frame(frame[:, :, ::-1])  # red, green, blue
            self.predictor.add_new_prompt(frame_idx=0, obj_id=1, bbox=[[x, y], [x + w, y + h]])

    def track(self, frame):
        with torch.autocast("cuda", dtype=torch.bfloat16):
            _, logits = self.predictor.track(frame[:, :, ::-1])  # [objects, 1, H, W]
        return box_of((logits[0, 0] > 0).cpu())
