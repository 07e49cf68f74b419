"""Frames of datasets as PyTorch samples.

`FrameDataset` returns samples by number, in any order; `FrameStream` reads recordings from
beginning to end, shuffled by windows; `LeRobotDataset` returns samples as LeRobot has them. All
are meant for a ``torch.utils.data.DataLoader`` with workers: see docs/training.md. Needs
``pip install 'mp4ds[torch]'``.
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
