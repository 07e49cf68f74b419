"""Train a small network on the frames of a dataset: from two frames it predicts the next one.

python examples/train.py DATASET [EPOCHS]     (needs pip install 'mp4ds[torch]')
"""

from __future__ import annotations

import sys

import torch
from torch import nn
from torch.utils.data import DataLoader

from mp4ds.torch import FrameDataset


def main(path: str, epochs: int) -> None:
    """Print the error of each epoch, and that of taking the last frame for the next."""
    torch.manual_seed(0)
    frames = FrameDataset(path, offsets=(-2, -1, 0), resize=(60, 44), dtype="float32")
    camera = frames.topics[0]
    loader = DataLoader(frames, batch_size=8, shuffle=True, num_workers=2, persistent_workers=True)
    network = nn.Sequential(
        nn.Conv2d(6, 32, 5, padding=2), nn.ReLU(), nn.Conv2d(32, 3, 5, padding=2)
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    print(f"{len(frames)} samples of {camera}")
    for epoch in range(epochs):
        errors, still = [], []
        for batch in loader:
            window = batch[camera][~batch[f"{camera}_is_pad"].any(1)]  # without the very first
            before, now = window[:, :2], window[:, 2]
            predicted = before[:, 1] + network(before.flatten(1, 2))
            loss = nn.functional.mse_loss(predicted, now)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            errors.append(loss.item())
            still.append(nn.functional.mse_loss(before[:, 1], now).item())
        mean, reference = sum(errors) / len(errors), sum(still) / len(still)
        print(f"epoch {epoch}: error {mean:.5f}, of no motion {reference:.5f}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 3)
