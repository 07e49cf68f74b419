"""Older versions of the format, brought to the current one by pure steps.

Each step turns the document of one version into that of the next. Version 0 is the YAML of
the tool published with the paper (github.com/STAR-Center/ros_mp4): it has no version key.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import PurePath
from typing import Any

from mp4ds.errors import FormatError
from mp4ds.stamps import encode_column

Document = dict[str, Any]

_VERSION_0_KEYS = {"bagname", "topic_name", "camera_info", "img_timestamp"}


def version_of(document: Document) -> str | None:
    """The version that a document claims; None where it claims none."""
    if "mp4ds" in document:
        version = document["mp4ds"]
        return version if isinstance(version, str) else None
    return "0" if set(document) >= {"topic_name", "img_timestamp"} else None


def migrate(document: Document, place: str) -> Document:
    """Bring a document of any older version to the current one.

    Raises:
        FormatError: ``migration-failed``, with what is missing.
    """
    while (version := version_of(document)) in MIGRATIONS:
        try:
            document = MIGRATIONS[str(version)](document, place)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise FormatError(
                "migration-failed", place, f"is not a whole file of version {version} ({reason})"
            ) from None
    return document


def _from_0(old: Document, place: str) -> Document:
    """Version 0: one stream, float seconds of record time, the first camera_info."""
    unknown = set(old) - _VERSION_0_KEYS
    if unknown:
        raise ValueError(f"unknown keys {sorted(unknown)}")
    if not isinstance(old["topic_name"], list):
        raise ValueError("topic_name is no list")
    info_topic, image_topic = map(_text, old["topic_name"])
    info = old["camera_info"]
    # round half even of the exact product: the nearest nanosecond to the stored float
    times = [round(Fraction(_number(seconds)) * 10**9) for seconds in old["img_timestamp"]]
    column = encode_column(times)
    width, height = _integer(info["width"]), _integer(info["height"])
    return {
        "mp4ds": "1.0",
        "kind": "stream",
        "profile": "crf=22",
        "stamps": "record-float",
        "frames": len(times),
        "channel": _channel_0(image_topic, "sensor_msgs/Image"),
        "wire": "ros1",
        "image": {
            "encoding": "bgr8",
            "width": width,
            "height": height,
            "step": 3 * width,
            "is_bigendian": 0,
        },
        "headers": [{"frame_id": str(info["frameid"])}],
        "video": {
            "file": PurePath(place).with_suffix(".mp4").name,
            "layout": "bgr24",
            "codec": "av1",
            "pixel_format": "yuv420p",
            "width": width,
            "height": height,
            # that tool left the conversion to ffmpeg, which then takes BT.601, limited
            "color": {
                "primaries": "bt709",
                "transfer": "bt709",
                "matrix": "smpte170m",
                "range": "limited",
            },
        },
        "camera_info": {
            "channel": _channel_0(info_topic, "sensor_msgs/CameraInfo"),
            "wire": "ros1",
            "messages": 0,
            "calibrations": [_calibration_0(info)],
        },
        "columns": {
            "log_time": column,
            "stamp": column,
            "seq": {"start": 0, "step": 1, "values": f"0*{len(times) - 1}" if times[1:] else ""},
        },
    }


def _channel_0(topic: str, type_name: str) -> Document:
    return {
        "topic": topic,
        "message_encoding": "ros1",
        "schema": {"name": type_name, "encoding": "", "text": ""},
        "metadata": {},
    }


def _calibration_0(info: Document) -> Document:
    return {
        "frame_id": str(info["frameid"]),
        "height": _integer(info["height"]),
        "width": _integer(info["width"]),
        "distortion_model": str(info["distortion_model"]),
        **{key.lower(): [_number(value) for value in info[key]] for key in "DKRP"},
    }


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} is no number")
    if value - value != 0:
        raise ValueError(f"{value} is no finite number")
    return float(value)


def _integer(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is no whole number")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is no text")
    return value


def _from_1_0(old: Document, place: str) -> Document:
    """Version 1.0: no header has padding."""
    headers = old.get("headers")
    if isinstance(headers, list) and any(isinstance(h, dict) and "padding" in h for h in headers):
        raise ValueError("headers with padding are of version 1.1")
    return {**old, "mp4ds": "1.1"}


MIGRATIONS: dict[str, Callable[[Document, str], Document]] = {"0": _from_0, "1.0": _from_1_0}
"""Version that a step starts from -> the step."""
