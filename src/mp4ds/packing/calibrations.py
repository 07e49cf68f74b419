"""Pairs calibrations with images, and hands them to the images' streams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from mp4ds.bags.protocols import with_own_payload
from mp4ds.errors import OptionError, Refused
from mp4ds.format.fields import MAX_CAMERA_INFOS
from mp4ds.format.models import Calibration, CameraInfo, ChannelModel
from mp4ds.messages.serializations import (
    INFO_NAMES,
    TRANSPORTS,
    MessageSplitter,
    is_calibration,
    is_camera,
    kind_of,
)
from mp4ds.messages.wire import CalibrationFields, CodedFields
from mp4ds.packing.inspection import MessageTable
from mp4ds.packing.options import TopicSummary
from mp4ds.records import Channel, Message

Pairs = Mapping[int, int]
"""Id of a calibration channel -> id of the channel of its images."""

_LISTED = 20

# ---------------------------------------------------------------- by the user's choice


def choose_pairs(choices: Sequence[str], channels: Sequence[Channel]) -> dict[int, int]:
    """Pair what the user asks for.

    With several publishers on the topics, the first of one is paired with the first of the other,
    and so on.

    Args:
        choices: ``IMAGE=INFO`` each, two topics, spelled as in the recording.
        channels: The recording's, as far as they are packed.

    Returns:
        Id of the calibration channel -> id of the image channel.

    Raises:
        OptionError: A topic is unknown or of the wrong kind, or is paired with two others.
    """
    topics = by_topic(channels)
    pairs: dict[int, int] = {}
    chosen: dict[str, str] = {}  # topics of a pair, in both directions
    for choice in dict.fromkeys(choices):
        image, _, info = choice.partition("=")
        if not image or not info:
            raise OptionError(
                f"`camera_info` {choice!r} is not of the form IMAGE=INFO, "
                "such as /left/image_raw=/left/info."
            )
        for topic, holds, noun in (
            (image, is_camera, "images"),
            (info, is_calibration, "calibrations"),
        ):
            if not any(map(holds, topics.get(topic, ()))):
                raise OptionError(_no_such_topic(choice, topic, topics, holds, noun))
            if topic in chosen:
                raise OptionError(
                    f"`camera_info` pairs {topic} with {chosen[topic]}, so {choice} cannot be: a "
                    "stream has one calibration topic, which belongs to it only. Leave one of the "
                    "two out: all messages are kept."
                )
        chosen[image], chosen[info] = info, image
        infos, images = filter(is_calibration, topics[info]), filter(is_camera, topics[image])
        pairs.update((a.id, b.id) for a, b in zip(infos, images, strict=False))
    return pairs


def _no_such_topic(
    choice: str,
    topic: str,
    topics: Mapping[str, list[Channel]],
    holds: Callable[[Channel], bool],
    noun: str,
) -> str:
    wanted = sorted(name for name, own in topics.items() if any(map(holds, own)))
    listed = ", ".join(wanted[:_LISTED]) + (", ..." if len(wanted) > _LISTED else "")
    problem = f"{topic!r} is not among the packed topics"
    if own := topics.get(topic):
        problem = f"{topic!r} holds {own[0].type_name or 'messages without a type'}, not {noun}"
    return f"`camera_info` {choice!r}: {problem}. Topics of {noun}: {listed or 'none'}."


def by_topic(channels: Iterable[Channel]) -> dict[str, list[Channel]]:
    """The channels of each topic, by their ids."""
    found: dict[str, list[Channel]] = {}
    for channel in sorted(channels, key=lambda channel: channel.id):
        found.setdefault(channel.topic, []).append(channel)
    return found


# ---------------------------------------------------------------- by name


def pair_camera_infos(
    channels: Sequence[Channel], *, chosen: Pairs | None = None
) -> dict[int, int]:
    """Pair calibrations with images by the names of their topics.

    A topic named ``camera_info``, or ``calibration`` as in Foxglove's examples, belongs to the
    image topic in the same namespace. For coded images the namespace is that of the image they
    transport: ``/cam/image_raw/compressed`` has its calibration on ``/cam/camera_info``. Among
    several, raw images come first, with ``image_raw`` preferred, then the first by name.
    librealsense's ``NAME/info/camera_info`` belongs to ``NAME/image/data``. With several publishers
    on a calibration topic none is paired.

    Args:
        channels: The recording's, as far as they are packed.
        chosen: Existing pairs, such as those of `choose_pairs`.

    Returns:
        Id of the calibration channel -> id of the image channel; the chosen ones too.
    """
    pairs = dict(chosen or {})
    beside: dict[str, list[tuple[int, Channel]]] = {}
    for image in filter(is_camera, channels):
        for rank, namespace in enumerate(_namespaces(image)):
            beside.setdefault(namespace, []).append((rank, image))
    infos = by_topic(filter(is_calibration, channels))
    found = [
        ((INFO_NAMES.index(_leaf(topic)), rank, *_preference(image)), own[0], image)
        for topic, own in infos.items()
        if len(own) == 1 and _leaf(topic) in INFO_NAMES
        for rank, image in beside.get(_namespace_of_images(topic), [])
    ]
    taken = set(pairs.values())
    for _, info, image in sorted(found, key=lambda item: (item[0], item[1].topic)):
        if info.id not in pairs and image.id not in taken:
            pairs[info.id] = image.id
            taken.add(image.id)
    return pairs


def _preference(image: Channel) -> tuple[bool, bool, str, int]:
    """Orders the images of a camera: the raw image is what the calibration was made for."""
    is_coded = kind_of(image) is CodedFields
    return is_coded, _leaf(_base(image)) != "image_raw", image.topic, image.id


def _leaf(topic: str) -> str:
    return topic.strip("/").rpartition("/")[2]


def _parent(topic: str) -> str:
    return topic.strip("/").rpartition("/")[0]


def _namespace_of_images(topic: str) -> str:
    """Namespace of a calibration topic's images: its own, or where librealsense puts them."""
    parent = _parent(topic)
    return f"{_parent(parent)}/image" if _leaf(parent) == "info" else parent


def _base(image: Channel) -> str:
    """The base topic of a transport, even if its images were decoded; else the topic itself."""
    if _leaf(image.topic) in TRANSPORTS and _parent(image.topic):
        return _parent(image.topic)
    return image.topic.strip("/")


def _namespaces(image: Channel) -> list[str]:
    """Namespaces its calibration may be in: that of its base topic, else its own."""
    return list(dict.fromkeys((_parent(_base(image)), _parent(image.topic))))


# ---------------------------------------------------------------- all of them


def find_pairs(chosen: Sequence[str], channels: Sequence[Channel]) -> Pairs:
    """Pair calibrations with images before anything is packed, so that all parts agree.

    Args:
        chosen: Pairs that the user names, ``IMAGE=INFO``.
        channels: What is packed of the recording.

    Raises:
        OptionError: A chosen pair is not possible.
    """
    return pair_camera_infos(channels, chosen=choose_pairs(chosen, channels))


_MAX_PENDING = 1000
"""Calibrations of a topic that may wait for their stream; with more, all are kept verbatim."""

Identity = tuple[object, ...]
"""Of a channel of images, whose first stream takes its calibrations."""


class _InfoChannel:
    """The calibration messages of one channel.

    Attributes:
        images: The channel of their images.
        pending: Messages, with ordinals, that wait for a stream of the images.
    """

    def __init__(self, channel: Channel, images: Identity) -> None:
        self.images = images
        self.pending: list[tuple[Message, int]] = []
        self._channel = channel
        self._forms = MessageSplitter(channel)
        self._table: MessageTable[Calibration] | None = None  # with the form of the first message

    def accept(self, message: Message, ordinal: int) -> None:
        """Put a message into the stream.

        Args:
            message: The message.
            ordinal: Its position among the channel's messages.

        Raises:
            Refused: It cannot be modelled exactly; nothing was changed.
        """
        form, parts = self._forms.split(message)
        table = self._table or MessageTable[Calibration](form, MAX_CAMERA_INFOS)
        table.check(message, parts)
        fields = parts.fields
        if not isinstance(fields, CalibrationFields):
            raise Refused("it is not a calibration")
        if table.form.wire != form.wire:
            raise Refused("its byte order differs from the first one's")
        table.add(
            message,
            parts,
            ordinal,
            describe=lambda template: Calibration.of(parts.frame_id, fields, template),
        )
        self._table = table

    def to_model(self) -> CameraInfo | None:
        """The model, or None if no message was accepted."""
        table = self._table
        if table is None:
            return None
        return CameraInfo(
            channel=ChannelModel.from_record(self._channel),
            wire=table.form.wire,
            messages=len(table),
            calibrations=table.headers,
            columns=table.to_model(),
        )


class Calibrations:
    """Hands calibrations to the streams of their images.

    Args:
        channels: The recording's, as far as they are packed.
        pairs: Of `find_pairs`.
        topic_of: The summary of a channel's topic.
        keep: Stores messages that belong to no stream.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        pairs: Pairs,
        topic_of: Callable[[Channel], TopicSummary],
        keep: Callable[[Message], None],
    ) -> None:
        self._topic_of = topic_of
        self._keep = keep
        self._channels = {channel.id: channel for channel in channels}
        self._pairs = dict(pairs)
        self._counts: Counter[Identity] = Counter()
        self._infos: dict[int, _InfoChannel | None] = {}  # None: they are kept
        self._streams: dict[Identity, _InfoChannel | None] = {}  # of which images, with whose

    def meet(self, channel: Channel) -> None:
        """Pair a channel by its name if it was not known at the beginning."""
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self._pairs = pair_camera_infos(list(self._channels.values()), chosen=self._pairs)

    def have_images(self, channel: Channel) -> bool:
        """Whether it is known which images the calibrations of a channel are for."""
        return channel.id in self._pairs

    def take(self, message: Message) -> None:
        """Add a calibration to its stream, or keep it if it belongs to none."""
        channel = message.channel
        # its position among those of all channels with the same identity
        ordinal = self._counts[channel.identity]
        self._counts[channel.identity] += 1
        if channel.id not in self._infos:
            images = self._channels.get(self._pairs.get(channel.id, -1))
            new = _InfoChannel(channel, images.identity) if images else None
            self._infos[channel.id] = new
            self._settle()
        if (info := self._infos[channel.id]) is None:
            self._keep(message)
        elif self._streams.get(info.images) is info:
            self._add(info, message, ordinal)
        elif len(info.pending) < _MAX_PENDING:
            info.pending.append((with_own_payload(message), ordinal))
        else:
            self._give_up(channel.id, info)
            self._keep(message)

    def adopt(self, images: Identity) -> None:
        """Take the calibrations that waited for the first stream of a channel of images."""
        self._streams[images] = None
        self._settle()

    def _settle(self) -> None:
        for info in self._infos.values():
            # a stream has the calibrations of one channel
            if info and info.images in self._streams and self._streams[info.images] is None:
                self._streams[info.images] = info
                pending, info.pending = info.pending, []
                for message, ordinal in pending:
                    self._add(info, message, ordinal)

    def finish(self) -> dict[Identity, CameraInfo]:
        """The calibrations of each stream; those whose stream never came are kept."""
        for info_id, info in self._infos.items():
            if info is not None:
                self._give_up(info_id, info)
        models = {images: info and info.to_model() for images, info in self._streams.items()}
        return {images: model for images, model in models.items() if model}

    def _add(self, info: _InfoChannel, message: Message, ordinal: int) -> None:
        try:
            info.accept(message, ordinal)
        except Refused as reason:
            self._topic_of(message.channel).count_verbatim(str(reason), ordinal)
            self._keep(message)

    def _give_up(self, info_id: int, info: _InfoChannel) -> None:
        for message, _ in info.pending:
            self._keep(message)
        self._infos[info_id] = None
