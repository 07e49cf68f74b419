"""An ordinary subscriber of ROS 1, which notes stamps and arrivals. Knows nothing of mp4ds.

    playing_receiver.py RESULT TOPIC

Writes RESULT (.npz) when it reads a line.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from typing import Any

import numpy as np
import rospy

BUFFER = 1 << 24  # with rospy's own 64 kB the time goes into joining pieces


def main() -> None:
    """Subscribe, and write what came when told."""
    result, topic = sys.argv[1:]
    rospy.init_node("receiver", anonymous=True, disable_rostime=True)
    found: list[tuple[int, float]] = []

    def note(message: Any) -> None:
        now = time.monotonic()
        seconds, nanoseconds = struct.unpack_from("<II", message._buff, 4)
        found.append((seconds * 10**9 + nanoseconds, now))

    rospy.Subscriber(topic, rospy.AnyMsg, note, buff_size=BUFFER, tcp_nodelay=True)
    print(json.dumps("ready"), flush=True)
    sys.stdin.readline()
    stamps, arrivals = zip(*found, strict=True)
    np.savez(result, stamps=np.array(stamps, np.int64), arrivals=np.array(arrivals, np.float64))
    print(json.dumps("written"), flush=True)
    rospy.spin()


if __name__ == "__main__":
    main()
