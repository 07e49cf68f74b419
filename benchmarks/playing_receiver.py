"""An ordinary subscriber of ROS 1, which notes stamps and arrivals. Knows nothing of mp4ds.

    playing_receiver.py RESULT decode|keep TOPIC...

Writes RESULT (.npz) when it reads a line, and says how many seconds of CPU it has used since it was
ready. With ``decode`` messages are CompressedImages, the files of which are decoded.
"""

from __future__ import annotations

import io
import json
import struct
import sys
import time
from functools import partial
from typing import Any

import numpy as np
import rospy
from PIL import Image

BUFFER = 1 << 24  # with rospy's own 64 kB the time goes into joining pieces


def note(found: list[tuple[int, float]], is_clock: bool, decode: bool, message: Any) -> None:
    """Note one message."""
    now = time.monotonic()
    data = message._buff
    seconds, nanoseconds = struct.unpack_from("<II", data, 0 if is_clock else 4)
    found.append((seconds * 10**9 + nanoseconds, now))
    if decode:
        (name,) = struct.unpack_from("<I", data, 12)
        (form,) = struct.unpack_from("<I", data, 16 + name)
        Image.open(io.BytesIO(data[24 + name + form :])).load()


def main() -> None:
    """Subscribe, and write what came when told."""
    result, decode, *topics = sys.argv[1:]
    rospy.init_node("receiver", anonymous=True, disable_rostime=True)
    found: list[list[tuple[int, float]]] = [[] for _ in topics]
    for topic, noted in zip(topics, found, strict=True):
        callback = partial(note, noted, topic == "/clock", decode == "decode")
        rospy.Subscriber(topic, rospy.AnyMsg, callback, buff_size=BUFFER, tcp_nodelay=True)
    before = time.process_time()
    print(json.dumps("ready"), flush=True)
    sys.stdin.readline()
    cpu = time.process_time() - before
    arrays = {}
    for i, noted in enumerate(found):
        arrays[f"stamps{i}"] = np.array([stamp for stamp, _ in noted], np.int64)
        arrays[f"arrivals{i}"] = np.array([arrival for _, arrival in noted], np.float64)
    np.savez(result, **arrays)
    print(json.dumps(cpu), flush=True)
    rospy.spin()


if __name__ == "__main__":
    main()
