"""A recording of which parts of images are filled or blurred while it is read: `pack --redact`.

A message whose image changes keeps its topic, type and times: a raw image has the same bytes except
those of the boxes, a JPEG file becomes a PNG of its decoded pixels, PNG files and compressed depths
are written anew, without anything that they had besides pixels. Packets of a video, which refer to
one another, all become raw images (`ReducedReader`). Everything after this reader packs what it
gives, so nothing of what was there gets into any file.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from mp4ds.bags.latched import ends_of
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.images import Shown, shown_by
from mp4ds.dataset.redaction import (
    Box,
    Rectangle,
    Redaction,
    UntouchedBlocks,
    check_change,
    holds_pixels,
    placed,
    redact,
)
from mp4ds.dataset.views import View, view_of
from mp4ds.errors import OptionError, Refused, SourceError
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels, pixel_view
from mp4ds.messages.serializations import MessageSplitter, is_camera, plain_message
from mp4ds.messages.wire import CodedFields, Form, ImageFields, Parts, Slots
from mp4ds.options import Selection
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.reducing import PACKETS, ChangedReader, ReducedReader
from mp4ds.records import EVERYTHING, Channel, Excerpt, Message, Record
from mp4ds.times import INT64_MAX
from mp4ds.unpacking.pictures import named_encoding

_MOST_LOOKED_AT = 1000  # messages of a topic for an image that can be decoded
_DISTANCES = ("16UC1", "32FC1")
_PNG = png.PngRecipe("2", 1, 0, 8, 15, "7801", 0, "", "AAAAAElFTkSuQmCC")
"""Fast, and found at once when the file is to be rebuilt; no chunks besides the image."""
_FILES = re.compile(r"jpe?g|webp|bmp|tiff?|ppm", re.IGNORECASE)
_ALL = (None, None)
_LATEST = INT64_MAX - 1  # rules without an end apply to it


@dataclass(frozen=True, slots=True)
class _Image:
    """An image of a message.

    Attributes:
        form: Of the message.
        parts: Of the message.
        shown: What it shows.
        encoding: Of its pixels.
        size: Its width and height.
        is_depth: Whether its values are distances.
    """

    form: Form
    parts: Parts
    shown: Shown
    encoding: Encoding
    size: tuple[int, int]
    is_depth: bool

    @classmethod
    def of(cls, channel: Channel, form: Form, parts: Parts) -> _Image:
        """That of a message.

        Raises:
            Refused: It has none that can be decoded.
        """
        shown, told = shown_by(channel, parts), ""
        if isinstance(parts.fields, CodedFields):
            told = parts.fields.format
        encoding = ENCODINGS[named_encoding(shown.encoding, told)]
        size = shown.pixels.shape[1], int(shown.pixels.shape[0] / encoding.rows)
        is_depth = encoding.name in _DISTANCES or "compressedDepth" in told
        return cls(form, parts, shown, encoding, size, is_depth)

    def place(self, box: Box, *, widened: bool = False) -> Rectangle | None:
        """Where a box is; see `placed`.

        Raises:
            OptionError: It is not inside, or cannot be changed so.
        """
        check_change(box, self.encoding, is_depth=self.is_depth)
        if self.shown.header and box.fill != 0:
            raise OptionError("its depths are quantised: fill can only be 0, which is none")
        return placed(box, self.encoding, self.size, widened=widened)


class _Topic:
    """What is redacted of the images of a topic, and what became of them.

    Args:
        type_name: Of its messages.
        rules: Number of each rule, its box, and its first log time and the first after, ns.

    Attributes:
        blocks: Proves what was not changed; None for no proof.
        images: How many there were.
        changed: How many were changed.
    """

    def __init__(self, type_name: str, rules: list[tuple[int, Box, int, int]]) -> None:
        self.type_name, self.rules = type_name, rules
        self.blocks: UntouchedBlocks | None = None
        self.images = self.changed = 0
        self._starts, self._ends = np.array([rule[2:] for rule in rules], np.int64).reshape(-1, 2).T

    def due(self, time: int) -> list[tuple[int, Box]]:
        """The rules for an image of a log time, ns, by their numbers; no time is out of reach."""
        time = min(max(time, 0), _LATEST)
        found = np.flatnonzero((self._starts <= time) & (time < self._ends))
        return [self.rules[place][:2] for place in found.tolist()]


class RedactedReader(ChangedReader):
    """A recording with parts of its images filled or blurred.

    Args:
        reader: The recording; closed with this one.
        options: What to redact; of which topics.

    Raises:
        OptionError: A rule does not apply: names it, and why.
        SourceError: A topic has no image that can be decoded.
    """

    def __init__(self, reader: BagReader, options: PackOptions) -> None:
        super().__init__(reader)
        self._recorded, self.pairs = reader, reader.pairs
        self._redaction = told = options.redaction or Redaction("nothing")
        cameras = [channel for channel in reader.channels if is_camera(channel)]
        selected = [channel for channel in cameras if options.selected(channel.topic)]
        topics = {channel.topic for channel in cameras}
        for number, rule in enumerate(told.rules):
            if not any(map(Selection([rule.topic]), topics)):
                listed = ", ".join(sorted(topics)) or "none"
                raise OptionError(
                    f"{told.called(number)}: matches no topic of images. Topics of images: "
                    f"{listed}."
                )
        chosen = {one.topic: one for one in selected}
        self._topics = self._rules_of(chosen)
        self._counts = [0] * len(told.rules)
        several = [one.topic for one in selected]
        is_proven = told.proof and options.goal.lossless and not options.derives
        self._proven = {one for one in chosen if is_proven and several.count(one) == 1}
        self._views: dict[tuple[str, tuple[int, int]], View] = {}
        videos = [name for name, one in self._topics.items() if one.type_name.endswith(PACKETS)]
        if videos:
            self._reader = ReducedReader(reader, PackOptions(topics=videos))
        is_sent = False
        with suppress(pickle.PicklingError, AttributeError, TypeError):
            # the main module of a script or notebook is another one in other processes
            is_sent = b"__main__" not in pickle.dumps(told.find)
        if options.cluster and not is_sent:
            raise OptionError(
                f"`redact` {told.name} cannot be sent to other machines: define it in a module "
                "that they have, too."
            )
        self.is_indexed = self._reader.is_indexed and is_sent
        if not told.find:
            for topic in self._topics:
                self._check_first(topic)

    # ------------------------------------------------------------ rules

    def _rules_of(self, chosen: Mapping[str, Channel]) -> dict[str, _Topic]:
        """The rules of each topic that is packed, with their log times.

        Raises:
            OptionError: One matches no image.
        """
        if self._redaction.find:
            return {topic: _Topic(one.type_name, []) for topic, one in chosen.items()}
        first, _ = ends_of(self._recorded)
        found: dict[str, list[tuple[int, Box, int, int]]] = {}
        self._due: list[int] = []
        is_indexed = self._recorded.is_indexed
        times = self._recorded.times() if is_indexed else {}
        for number, rule in enumerate(self._redaction.rules):
            start = 0 if rule.start is None else rule.start.after(first)
            end = INT64_MAX if rule.end is None else rule.end.after(first)
            if start >= end:
                raise OptionError(f"{self._redaction.called(number)}: its range is empty.")
            topics = [one for one in chosen.values() if Selection([rule.topic])(one.topic)]
            span = self.slice.span.within(Excerpt(start, end))
            if not topics or not span.has_messages:
                continue  # none of its images are packed
            self._due.append(number)
            own = [times[one.id].clip(0, _LATEST) for one in topics if one.id in times]
            if is_indexed and not any(((at >= start) & (at < end)).any() for at in own):
                raise self._no_image(number)
            for one in topics:
                box = Box(*rule.box, fill=rule.fill, blur=rule.blur)
                found.setdefault(one.topic, []).append((number, box, start, end))
        return {topic: _Topic(chosen[topic].type_name, own) for topic, own in found.items()}

    def _no_image(self, number: int) -> OptionError:
        rule = self._redaction.rules[number]
        ends = f" from {rule.start or 'the beginning'} to {rule.end or 'the end'}"
        return OptionError(
            f"{self._redaction.called(number)}: there is no image of the topic{ends}, so nothing "
            "was redacted by it. Correct the times, or remove the rule."
        )

    def _check_first(self, topic: str) -> None:
        """Try all rules on the first image of a topic, since others come late.

        Raises:
            OptionError: A box does not fit.
        """
        excerpt = Excerpt(topics=frozenset([topic]), others=False)
        for record in islice(self._reader.records(excerpt), _MOST_LOOKED_AT):
            if isinstance(record, Message) and is_camera(record.channel):
                with suppress(Refused):
                    form, parts = MessageSplitter(record.channel).split(record)
                    image = _Image.of(record.channel, form, parts)
                    for number, box, *_ in self._topics[topic].rules:
                        self._place(image, number, box)
                    return

    def _place(self, image: _Image, number: int, box: Box) -> Rectangle:
        try:
            found = image.place(box)
        except OptionError as error:
            raise OptionError(f"{self._redaction.called(number)}: {error}.") from None
        if found is None:
            raise OptionError(f"{self._redaction.called(number)}: its box is empty.")
        return found

    # ------------------------------------------------------------ as a reader

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Read an excerpt, with images as they are to be; see `BagReader.records`.

        Raises:
            OptionError: A rule was for no image, or cannot be applied to one.
            SourceError: An image that is to be redacted cannot be decoded.
        """
        self._counts = [0] * len(self._redaction.rules)
        for name, topic in self._topics.items():
            topic.images = topic.changed = 0
            is_proven = name in self._proven
            topic.blocks = UntouchedBlocks(self._redaction.proof) if is_proven else None
        splitters: dict[int, MessageSplitter] = {}
        for record in self._reader.records(excerpt):
            if (
                isinstance(record, Message)
                and record.channel.topic in self._topics
                and is_camera(record.channel)
            ):
                if record.channel.id not in splitters:
                    splitters[record.channel.id] = MessageSplitter(record.channel)
                record = self._redacted(record, splitters[record.channel.id])
            yield record
        is_all = (excerpt.start, excerpt.end) == _ALL and excerpt.topics is None
        if is_all and not excerpt.without and not self._redaction.find:
            for number in self._due:
                if not self._counts[number]:
                    raise self._no_image(number)

    def records_before(self, topics: Any) -> Iterator[Record]:
        """Records as recorded, of topics of packets that are not redacted."""
        return self._recorded.records_before(topics)

    @property
    def redaction(self) -> Mapping[str, Any]:  # type: ignore[override]
        """What the last `records` redacted, as manifests have it."""
        topics = []
        for name, topic in self._topics.items():
            told: dict[str, Any] = {"topic": name, "type": topic.type_name}
            told |= {"images": topic.images, "changed": topic.changed}
            if values := topic.blocks.values if topic.blocks else "":
                told["untouched"] = {"values": values}
            topics += [told] if topic.images else []
        told = {**self._redaction.told, "rules": list(self._counts), "topics": topics}
        return {**told, "rules_text": self._redaction.text}

    # ------------------------------------------------------------ messages

    def _redacted(self, message: Message, splitter: MessageSplitter) -> Message:
        topic = self._topics[message.channel.topic]
        topic.images += 1
        due = topic.due(message.log_time)
        is_looked_at = bool(due or self._redaction.find)
        try:
            if message.channel.type_name.endswith(PACKETS):
                is_looked_at = True  # those around it may have been changed
                raise Refused("no picture of it: no key frame is before it, or it has B-frames")
            form, parts = splitter.split(message)
            if not is_looked_at and (topic.blocks is None or not holds_pixels(parts)):
                return message
            image = _Image.of(message.channel, form, parts)
        except Refused as reason:
            if is_looked_at:
                raise self._undecodable(message, reason) from None
            return message
        found = self._found(message, image)
        for number, box in due:
            found.append((box, self._place(image, number, box)))
            self._counts[number] += 1
        pixels = np.ascontiguousarray(image.shown.pixels)
        if topic.blocks is not None and (found or holds_pixels(image.parts)):
            topic.blocks.add((image.encoding, pixels), [part for _, part in found])
        if not found:
            return message
        topic.changed += 1
        made = pixels.copy()
        for box, part in found:
            redact(made, image.encoding, box, part)
        data = _message(message.channel, image, made, found)
        _, now = splitter.split(replace(message, data=data))
        if (now.stamp, now.frame_id) != (image.parts.stamp, image.parts.frame_id):
            raise self._undecodable(message, "its header cannot be kept")
        return replace(message, data=data)

    def _undecodable(self, message: Message, reason: object) -> SourceError:
        problem = f"the message of {message.channel.topic} logged at {message.log_time} ns"
        return SourceError(
            self.path,
            f"{problem} cannot be redacted: {reason}",
            "Leave it out by `start` and `end`, or its topic by `exclude`.",
        )

    def _found(self, message: Message, image: _Image) -> list[tuple[Box, Rectangle]]:
        """What the function finds, and where that is.

        Raises:
            OptionError: It is no box, or cannot be redacted.
        """
        found: list[tuple[Box, Rectangle]] = []
        if self._redaction.find is None:
            return found
        topic, time = message.channel.topic, message.log_time
        boxes: Any = self._redaction.find(topic, time, self._colours(topic, image))
        if not isinstance(boxes, Iterable):
            raise OptionError(
                f"`redact`, {self._redaction.name} for {topic} at {time} ns: gave {boxes!r}, not "
                "a list of boxes."
            )
        for given in boxes:
            try:
                if not isinstance(given, Box):
                    x, y, width, height = map(float, given)
                box = given if isinstance(given, Box) else Box(x, y, width, height)
                part = image.place(box, widened=True)
            except (TypeError, ValueError, OverflowError) as error:
                raise OptionError(
                    f"`redact`, {self._redaction.name} for {topic} at {time} ns: {given!r}: "
                    f"{str(error).rstrip('.')}."
                ) from None
            if part is not None:
                found.append((box, part))
        return found

    def _colours(self, topic: str, image: _Image) -> Pixels:
        """RGB of an image that shows colours or grey, of as many bits; else its pixels."""
        kind = image.encoding.name, image.size
        for name in ("native",) if image.is_depth else ("rgb", "native"):
            with suppress(OptionError):  # it does not show colours
                if kind not in self._views:
                    self._views[kind] = view_of(
                        topic, image.encoding, image.size, format=name, resize=None, crop=None
                    )
        view = self._views[kind]
        made: Pixels = np.empty(view.shape, view.dtype)
        view.give(np.ascontiguousarray(image.shown.pixels), made)
        return made


def _message(
    channel: Channel, image: _Image, made: Pixels, found: list[tuple[Box, Rectangle]]
) -> bytes:
    """A message with other pixels."""
    form, parts, fields = image.form, image.parts, image.parts.fields
    blank = parts.blank
    slots = Slots(parts.stamp, parts.seq, parts.pts)
    body: bytes | bytearray
    if isinstance(fields, ImageFields):
        body = _raw(fields, image, made, found)
    else:
        is_file = bytes(parts.body[:8]) == png.SIGNATURE
        told = fields.format if isinstance(fields, CodedFields) else ""
        body, prefix = b"", b""
        if "compressedDepth" in told and not is_file:
            prefix = bytes(parts.body[: depth.HEADER_BYTES])
            if bytes(parts.body[len(prefix) : len(prefix) + 8]) != png.SIGNATURE:
                body = depth.encode_rvl(made)
        elif not is_file:
            told = _FILES.sub("png", told)
        body = prefix + (body or png.rebuild(made, _PNG))
        if isinstance(fields, CodedFields) and told != fields.format:
            if form.wire != "protobuf":
                changed = replace(fields, format=told)
                name = channel.type_name
                return plain_message(form.wire, name, parts.frame_id, changed, slots, body)
            if (
                fields.format.isascii() and len(fields.format) < 128
            ):  # of which a byte is the length
                old, new = (bytes([len(text)]) + text.encode() for text in (fields.format, told))
                blank = blank.replace(old, new)
    template = form.template(blank)
    head, tail = template.around(slots, len(body))
    data = b"".join((head, body, bytes(template.padding(len(body))), tail))
    if form.wire != "protobuf":
        # bytes after the last field may be what a buffer held before, such as an earlier image
        name, view = channel.type_name, memoryview(body)
        plain = plain_message(form.wire, name, parts.frame_id, fields, slots, view)
        surplus = max(0, len(data) - len(plain))
        data = data[: len(data) - surplus] + bytes(surplus)
    return data


def _raw(
    fields: ImageFields, image: _Image, made: Pixels, found: list[tuple[Box, Rectangle]]
) -> bytearray:
    """The body of a raw image with other pixels.

    What is between and after its rows may show more of what was there, and is zero beside boxes.
    """
    encoding, body = image.encoding, bytearray(image.parts.body)
    view = pixel_view(body, fields)
    view[...] = made
    row_bytes, rows = fields.width * encoding.pixel_bytes, view.shape[0]
    for _, (_, y, _, height) in found:
        first, last = (y, y + height) if encoding.rows == 1 else (0, rows)
        for row in range(first, last):
            after = slice(row * fields.step + row_bytes, min((row + 1) * fields.step, len(body)))
            body[after] = bytes(len(body[after]))
    rest = slice(encoding.size(fields.step, fields.height), None)
    body[rest] = bytes(len(body[rest]))
    return body
