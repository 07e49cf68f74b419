"""What the topic of republished images is called. Pure."""

from __future__ import annotations

from collections.abc import Iterable

KINDS = ("raw", "jpeg", "png", "compressed-video", "ffmpeg")
"""What images can be given as."""

_SUFFIXES = {
    "jpeg": "compressed",
    "png": "compressed",
    "compressed-video": "compressed_video",
    "ffmpeg": "ffmpeg",
}
_TRANSPORTS = ("compressed", "compressedDepth", "ffmpeg", "foxglove", "compressed_video")
_FAMILIES = {
    "Image": "raw",
    "RawImage": "raw",
    "CompressedImage": "file",
    "CompressedVideo": "video",
    "FFMPEGPacket": "video",
}
_FAMILY_OF_KIND = {
    "raw": "raw",
    "jpeg": "file",
    "png": "file",
    "compressed-video": "video",
    "ffmpeg": "video",
}


def republished_topic(topic: str, type_name: str, kind: str) -> str:
    """The topic that image_transport would have for a topic's images.

    Args:
        topic: As recorded.
        type_name: Of its messages, which are a camera's.
        kind: One of `KINDS`.
    """
    family = _FAMILIES[type_name.replace(".", "/").rpartition("/")[2]]
    stem, _, last = topic.rpartition("/")
    has_transport = family != "raw" and last in _TRANSPORTS and stem != ""
    suffix = _SUFFIXES.get(kind)
    if family == _FAMILY_OF_KIND[kind] and not (has_transport and last != suffix):
        return topic
    if not has_transport:
        stem = topic
    if suffix is None:
        return stem if has_transport else f"{topic}/raw"
    return f"{stem}/{suffix}"


class FreeTopics:
    """Gives each republished topic a name that no other one has.

    Args:
        taken: Topics that are there anyway.
    """

    def __init__(self, taken: Iterable[str]) -> None:
        self._taken = set(taken)

    def take(self, topic: str, kind: str) -> str:
        """The topic, or one made of it and its kind, one of `KINDS`, where it is taken."""
        while topic in self._taken:
            topic += "_" + kind.replace("-", "_")
        self._taken.add(topic)
        return topic
