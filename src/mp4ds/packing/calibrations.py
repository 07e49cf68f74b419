"""Pairs calibrations with images, and hands them to the images' streams."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice

from mp4ds.bags.protocols import BagReader, with_own_payload
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
from mp4ds.messages.wire import CalibrationFields, CodedFields, Fields, Parts
from mp4ds.packing.inspection import MessageInspector, MessageTable
from mp4ds.packing.options import TopicSummary
from mp4ds.records import Channel, Excerpt, Message

Pairs = Mapping[int, int]
"""Id of a calibration channel -> id of the channel of its images."""

INFO_WINDOW = 50
"""Number of latest stamps of a calibration channel that are compared."""
IMAGE_WINDOW = 1000
"""Number of latest stamps of an image channel compared with them: images may come more often."""

MAX_CHANNELS = 256
"""Calibration channels, and image channels, whose stamps are compared."""

_MIN_COMMON = 3
_MIN_SHARE = 0.8
_LISTED = 20

# the topics of one camera, as sensor_msgs/CameraInfo.msg and image_proc name them
_VIEWS = frozenset(
    {
        *("image", "image_raw", "image_mono", "image_color"),
        *("image_rect", "image_rect_raw", "image_rect_mono", "image_rect_color"),
    }
)

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


def _preference(image: Channel, size: tuple[int, int] = (0, 0)) -> tuple[bool, int, bool, str, int]:
    """Orders the images of a camera: the raw image is what the calibration was made for."""
    coded = _is_coded(image)
    return (
        coded,
        -size[0] * size[1] if coded else 0,
        _leaf(_base(image)) != "image_raw",
        image.topic,
        image.id,
    )


def _is_coded(image: Channel) -> bool:
    return kind_of(image) is CodedFields


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


def _camera(image: Channel) -> str:
    """Equal for image topics that are views of one camera, judging by names."""
    base = _base(image)
    return f"{_parent(base)}/" if _leaf(base) in _VIEWS else base


# ---------------------------------------------------------------- by stamp


class _Track:
    """What is known of one channel: its latest stamps, zero for none, and its latest message."""

    frame_id: str
    fields: Fields
    size: tuple[int, int]

    def __init__(self, channel: Channel, window: int) -> None:
        self.channel = channel
        self.stamps: deque[int] = deque(maxlen=window)
        self.messages = 0


class StampPairing:
    """Pairs by stamps the calibrations that names leave unpaired.

    `add` takes messages of calibration and image channels in recorded order. The latest
    `INFO_WINDOW` and `IMAGE_WINDOW` stamps of each channel are kept, so that memory is bounded and
    a channel that starts late is compared with what was recorded at the same time. A calibration
    channel is paired if

    - at least 3 of its stamps are an image channel's, and at least 80 % of those between that
      channel's first and last stamp (stamps of zero count as not found),
    - its frame_id, where both have one, and its size, by ROI and binning, are the images',
    - and this is so for the images of one camera only, or for those of one camera with the same
      frame_id, and for no other calibration channel of this camera, which has none yet.
    """

    def __init__(self) -> None:
        self._infos: dict[int, _Track] = {}
        self._images: dict[int, _Track] = {}
        self._overflow = False
        self._forms: dict[int, MessageSplitter] = {}
        self._sizes: dict[int, tuple[int, int]] = {}  # of coded images, as of their first

    def add(self, channel: Channel, parts: Parts, *, size: tuple[int, int] = (0, 0)) -> None:
        """Take a message.

        Args:
            channel: Its channel, of calibrations or images.
            parts: The message.
            size: Width and height of a coded image, if not in its message.
        """
        is_info = isinstance(parts.fields, CalibrationFields)
        tracks = self._infos if is_info else self._images
        if channel.id not in tracks:
            if len(tracks) == MAX_CHANNELS:
                self._overflow = True
                return
            tracks[channel.id] = _Track(channel, INFO_WINDOW if is_info else IMAGE_WINDOW)
        track = tracks[channel.id]
        track.stamps.append(parts.stamp)
        track.messages += 1
        track.frame_id = parts.frame_id.lstrip("/")
        track.fields = parts.fields
        told = parts.fields.width, parts.fields.height
        track.size = size if 0 in told else told

    def take(self, message: Message) -> None:
        """Take a message as recorded; one that cannot be parsed is left out."""
        channel = message.channel
        if channel.id not in self._forms:
            self._forms[channel.id] = MessageSplitter(channel)
        with suppress(Refused):
            _, parts = self._forms[channel.id].split(message)
            if isinstance(parts.fields, CodedFields) and channel.id not in self._sizes:
                key = MessageInspector(channel).inspect(message).key
                self._sizes[channel.id] = key.width, key.height
            self.add(channel, parts, size=self._sizes.get(channel.id, (0, 0)))

    def decide(self, paired: Pairs, *, final: bool = True) -> dict[int, int]:
        """Pair what was added so far.

        Args:
            paired: Existing pairs. These calibrations are not paired again, and these images take
                no other calibration, but still compete with the others.
            final: Whether the recording has ended. Then all stamps must agree for channels with
                fewer than 3 messages; before, these are not paired.

        Returns:
            Id of the calibration channel -> id of the image channel; the new ones only. Nothing
            if there are more than `MAX_CHANNELS` of a kind.
        """
        if self._overflow:
            return {}
        images = [(image, set(image.stamps) - {0}) for image in self._images.values()]
        taken = set(paired.values())
        claims: dict[int, Channel] = {}
        for info_id, info in sorted(self._infos.items()):
            if info_id not in paired:
                fitting = [image for image, found in images if _fits(info, image, found, final)]
                claim = _only_camera(info, fitting, taken)
                if claim is not None:
                    claims[info_id] = claim
        cameras = Counter(map(_camera, claims.values()))
        return {
            info_id: image.id for info_id, image in claims.items() if cameras[_camera(image)] == 1
        }


def _only_camera(info: _Track, fitting: list[_Track], taken: set[int]) -> Channel | None:
    """The best image channel, if all that match are of one camera without a calibration."""
    same_frame = [image for image in fitting if info.frame_id and info.frame_id == image.frame_id]
    fitting = same_frame or fitting
    if len({_camera(image.channel) for image in fitting}) != 1:
        return None
    if any(image.channel.id in taken for image in fitting):
        return None
    return min(fitting, key=lambda image: _preference(image.channel, image.size)).channel


def _fits(info: _Track, image: _Track, found: set[int], final: bool) -> bool:
    if info.frame_id and image.frame_id and info.frame_id != image.frame_id:
        return False
    if not isinstance(info.fields, CalibrationFields) or not _size_fits(info.fields, image.size):
        return False
    if not found:
        return False
    first, last = min(found), max(found)
    due = [stamp for stamp in info.stamps if stamp == 0 or first <= stamp <= last]
    common = [stamp for stamp in due if stamp in found]
    needed = min(_MIN_COMMON, info.messages, image.messages) if final else _MIN_COMMON
    return len(set(common)) >= needed and len(common) >= _MIN_SHARE * len(due)


def _size_fits(calibration: CalibrationFields, size: tuple[int, int]) -> bool:
    """Whether a calibration can apply to images of a size (REP 104), if both are known."""
    if 0 in size or 0 in (calibration.width, calibration.height):
        return True
    return any(
        abs(width - size[0]) < 1 and abs(height - size[1]) < 1
        for width, height in _image_sizes(calibration)
    )


def _image_sizes(calibration: CalibrationFields) -> Iterator[tuple[float, float]]:
    """Sizes that images of a calibration may have: whole or cut, binned or not."""
    _, _, roi_height, roi_width = calibration.roi
    for width, height in ((calibration.width, calibration.height), (roi_width, roi_height)):
        if width and height:
            yield width, height
            yield width / max(1, calibration.binning_x), height / max(1, calibration.binning_y)


# ---------------------------------------------------------------- all of them

_PAIRING_MESSAGES = 5_000
_DECIDED_EVERY = 100


def find_pairs(reader: BagReader, chosen: Sequence[str], channels: Sequence[Channel]) -> Pairs:
    """Pair calibrations with images before anything is packed, so that all parts agree.

    Only where names leave a calibration topic unpaired are the first messages read.

    Args:
        reader: The recording.
        chosen: Pairs that the user names, ``IMAGE=INFO``.
        channels: What is packed of it.

    Raises:
        OptionError: A chosen pair is not possible.
    """
    pairs = pair_camera_infos(channels, chosen=choose_pairs(chosen, channels))
    infos = [channel for channel in channels if is_calibration(channel)]
    if not any(map(is_camera, channels)) or all(channel.id in pairs for channel in infos):
        return pairs
    pairing = StampPairing()
    ids = {channel.id for channel in channels if is_camera(channel) or is_calibration(channel)}
    topics = frozenset(channel.topic for channel in channels if channel.id in ids)
    records = reader.records(Excerpt(topics=topics, others=False))
    for number, record in enumerate(islice(records, _PAIRING_MESSAGES)):
        if isinstance(record, Message) and record.channel.id in ids:
            pairing.take(record)
        if number % _DECIDED_EVERY == 0:
            pairs.update(pairing.decide(pairs, final=False))
            if all(channel.id in pairs for channel in infos):
                return pairs
    return {**pairs, **pairing.decide(pairs)}


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
