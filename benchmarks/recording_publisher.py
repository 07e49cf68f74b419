"""Cameras and an IMU of a robot, by rospy. Knows nothing of mp4ds.

    recording_publisher.py CAMERAS WIDTHxHEIGHT HZ IMU_HZ QUEUE SECONDS SUBSCRIBERS

Publishes Bayer images with the noise of a camera (see clips.py) as /camN/image_raw, their
CameraInfo, and /imu, when each topic has so many subscribers; says then that it begins, and at its
end how many messages of each topic it published. Without an end where SECONDS is 0. So many
messages wait for a subscriber that is slow; where QUEUE is 0, the publisher waits for it instead.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from typing import Any

import numpy as np
import rospy
from sensor_msgs.msg import CameraInfo, Image, Imu

import clips

KEPT_BYTES = 64 << 20
"""Of frames that are published again and again."""


class RawImage(Image):  # type: ignore[misc]
    """An image whose pixels are not copied into a message first."""

    _has_header = False  # that rospy would fill in

    def __init__(self, seq: int, stamp: int, pixels: np.ndarray[Any, Any]) -> None:
        height, width = pixels.shape
        secs, nsecs = divmod(stamp, 10**9)
        frame, encoding = b"camera", b"bayer_rggb8"
        self._head = b"".join(
            (
                struct.pack("<III", seq, secs, nsecs),
                struct.pack("<I", len(frame)) + frame,
                struct.pack("<II", height, width),
                struct.pack("<I", len(encoding)) + encoding,
                struct.pack("<BII", 0, width, pixels.size),
            )
        )
        self._body = memoryview(pixels).cast("B")

    def serialize(self, buff: Any) -> None:
        """See genpy."""
        buff.write(self._head)
        buff.write(self._body)


def frames_of(size: tuple[int, int], hertz: float) -> list[np.ndarray[Any, Any]]:
    """Frames of a camera."""
    count = max(2, min(round(2 * hertz), KEPT_BYTES // (size[0] * size[1])))
    scene = "cups" if clips.data_folder() else clips.DEMO
    spec = clips.ClipSpec(scene, "bayer_rggb8", "low", count, size)
    return [np.ascontiguousarray(frame) for frame in clips.make(spec)]


def run(hertz: float, seconds: float, publish: Any, counts: dict[str, int], topic: str) -> None:
    """Publish in time."""
    begun, number = time.monotonic(), 0
    while not rospy.is_shutdown() and (not seconds or number < round(seconds * hertz)):
        time.sleep(max(0.0, begun + number / hertz - time.monotonic()))
        publish(number, time.time_ns())
        number += 1
        counts[topic] = number


def main() -> None:
    """Publish."""
    cameras, dimensions, hertz, imu_hertz, queue, seconds, subscribers = sys.argv[1:]
    width, height = map(int, dimensions.split("x"))
    frames = frames_of((width, height), float(hertz))
    rospy.init_node("robot", disable_rostime=True)
    tasks, counts, publishers = [], {}, []

    def advertise(topic: str, kind: Any) -> Any:
        publishers.append(
            rospy.Publisher(topic, kind, queue_size=int(queue) or None, tcp_nodelay=True)
        )
        return publishers[-1]

    def camera(name: str) -> Any:
        images = advertise(f"/{name}/image_raw", Image)
        infos = advertise(f"/{name}/camera_info", CameraInfo)
        info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
        info.K, info.D = [500.0, 0, width / 2, 0, 500.0, height / 2, 0, 0, 1], [0.0] * 5
        info.header.frame_id = "camera"

        def publish(number: int, stamp: int) -> None:
            images.publish(RawImage(number, stamp, frames[number % len(frames)]))
            info.header.stamp = rospy.Time(*divmod(stamp, 10**9))
            infos.publish(info)

        return publish

    for number in range(int(cameras)):
        tasks.append((float(hertz), camera(f"cam{number}"), f"/cam{number}/image_raw"))
    if float(imu_hertz):
        imu = advertise("/imu", Imu)

        def publish(number: int, stamp: int) -> None:
            message = Imu()
            message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
            message.linear_acceleration.x = number
            imu.publish(message)

        tasks.append((float(imu_hertz), publish, "/imu"))
    while any(one.get_num_connections() < int(subscribers) for one in publishers):
        time.sleep(0.05)
    time.sleep(1.0)  # others have to know of the connection, too
    print(json.dumps("begun"), flush=True)
    threads = [
        threading.Thread(
            target=run, args=(rate, float(seconds), publish, counts, topic), daemon=True
        )
        for rate, publish, topic in tasks
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    time.sleep(2.0)  # for what waits in queues
    print(json.dumps(counts), flush=True)


if __name__ == "__main__":
    main()
