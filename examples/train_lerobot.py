"""Train a policy of LeRobot on datasets as they are, with LeRobot's own training program.

python examples/train_lerobot.py DATASET... --state TOPIC --action TOPIC -- LEROBOTS_OPTIONS...

LeRobot's are those of lerobot-train, such as --policy.type=act --policy.push_to_hub=false
--steps=20. Needs pip install 'lerobot[training]' 'mp4ds[torch]'.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from typing import Any

from lerobot.datasets import factory
from lerobot.scripts import lerobot_train

from mp4ds.torch import LeRobotDataset


def main(words: list[str], others: list[str]) -> None:
    """Have LeRobot's factory make our datasets, and run its program."""
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--topics", nargs="+")
    parser.add_argument("--state", required=True)
    parser.add_argument("--action", required=True)
    parser.add_argument("--task")
    parser.add_argument("--fps", type=int)
    parser.add_argument("--episode-topic")
    drives = partial(LeRobotDataset, **vars(parser.parse_args(words)))

    def dataset(*_: object, **given: Any) -> LeRobotDataset:
        names = ("episodes", "delta_timestamps", "image_transforms", "return_uint8")
        return drives(**{name: given[name] for name in names})

    factory.LeRobotDatasetMetadata = lambda *_, **__: drives().meta
    factory.LeRobotDataset = dataset
    sys.argv = [sys.argv[0], "--dataset.repo_id=mp4ds", *others]
    lerobot_train.main()


if __name__ == "__main__":
    place = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    main(sys.argv[1:place], sys.argv[place + 1 :])
