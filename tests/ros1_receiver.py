"""An ordinary subscriber of ROS 1, which says in JSON what it gets. Knows nothing of mp4ds.

    ros1_receiver.py TOPIC...

Each line is a message: topic, what its connection says, its size, digest and first bytes, and the
time of its arrival by ``time.monotonic()``.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from functools import partial
from threading import Lock
from typing import Any

import rospy


def tell(what: Any) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def say(lock: Lock, topic: str, message: Any) -> None:
    now = time.monotonic()
    header, data = message._connection_header, message._buff
    told = {
        "topic": topic,
        "type": header["type"],
        "md5sum": header["md5sum"],
        "definition": header["message_definition"],
        "latching": header.get("latching"),
        "size": len(data),
        "digest": hashlib.sha256(data).hexdigest(),
        "start": bytes(data[:64]).hex(),
        "arrival": now,
    }
    with lock:  # topics come on threads of their own
        tell(told)


def main() -> None:
    rospy.init_node("receiver", anonymous=True, disable_rostime=True)
    lock = Lock()
    for topic in sys.argv[1:]:
        rospy.Subscriber(topic, rospy.AnyMsg, partial(say, lock, topic))
    tell("ready")
    rospy.spin()


if __name__ == "__main__":
    main()
