"""Samples for PyTorch, read from the videos: no folder of images, no copy of the recording.

    from torch.utils.data import DataLoader
    from mp4ds.torch import FrameDataset

    frames = FrameDataset("drives/*", topics=["/left/image_raw"], resize=(224, 224))
    loader = DataLoader(frames, 32, shuffle=True, num_workers=4, collate_fn=frames.collate)
    for batch in loader:
        images = batch["/left/image_raw"]  # uint8, (32, 3, 224, 224)

- `FrameDataset` gives samples by number, in any order: one or several cameras, windows in time,
  states and actions of the robot.
- `FrameStream` reads recordings from beginning to end, shuffled by windows: each frame is decoded
  once an epoch, which costs a fraction of random access to large frames.
- `LeRobotDataset` is FrameDataset in the words of LeRobot, for its training code.

Install it with ``pip install 'mp4ds[torch]'``.
"""

from __future__ import annotations

from importlib.util import find_spec

if find_spec("torch") is None:
    raise ImportError("mp4ds.torch needs PyTorch. Install it with: pip install 'mp4ds[torch]'")

from mp4ds.errors import SampleError
from mp4ds.torch.datasets import FrameDataset
from mp4ds.torch.lerobot import LeRobotDataset
from mp4ds.torch.streams import FrameStream

__all__ = ["FrameDataset", "FrameStream", "LeRobotDataset", "SampleError"]
