"""Writes what LeRobot's reader reads of a data set; runs in an environment that has it.

`read_with_lerobot.py FOLDER OUT.npz`
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

# The compiled part of torchvision is made for another build of PyTorch. The reader needs none of
# it, but torchvision cannot be imported before its operators are known.
operators = torch.library.Library("torchvision", "DEF")
for operator in ("nms", "qnms"):
    operators.define(f"{operator}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from ledataset.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

if __name__ == "__main__":
    folder, out = sys.argv[1:]
    fps = json.loads((Path(folder) / "meta" / "info.json").read_text())["fps"]
    dataset = LeRobotDataset(
        "vmdnn/exported",
        root=folder,
        video_backend="pyav",
        delta_timestamps={"action": [0.0, 1.0 / fps]},
    )
    items = [dataset[number] for number in range(len(dataset))]
    names = (name for name in items[0] if name != "task")
    np.savez(
        out,
        **{name: np.stack([np.asarray(item[name]) for item in items]) for name in names},
        tasks=np.array([item["task"] for item in items]),
        lengths=np.array(dataset.meta.episodes["length"]),
        action_mean=np.asarray(dataset.meta.stats["action"]["mean"]),
    )
