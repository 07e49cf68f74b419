"""The parts of messages around their bodies: proven to rebuild, and numbered where equal."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Generic, TypeVar

from mp4ds.records import Channel, Message
from mp4ds.sidecar.fields import MAX_VARIANTS
from mp4ds.streams.columns import Unsuited
from mp4ds.wire import Form, Parts, Template, WireError, form_of, prove, wire_of

_ModelT = TypeVar("_ModelT")


class Forms:
    """Takes the messages of one channel apart; its serialization may change between messages."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._forms: dict[str, Form] = {}

    def split(self, message: Message) -> tuple[Form, Parts]:
        """The form of a message and its parts.

        Raises:
            Unsuited: It does not parse, or is not modelled.
        """
        data = memoryview(message.data)
        schema = self._channel.schema
        try:
            wire = wire_of(self._channel.message_encoding, data)
            if wire not in self._forms:
                definition = schema.data if schema else b""
                self._forms[wire] = form_of(wire, self._channel.type_name, definition)
            form = self._forms[wire]
            return form, form.split(data)
        except WireError as error:
            raise Unsuited(f"it does not parse: {error}") from None


class Heads(Generic[_ModelT]):
    """Numbers the distinct blanks of a stream's messages.

    Args:
        form: Of all messages.
    """

    def __init__(self, form: Form) -> None:
        self.form = form
        self.items: list[_ModelT] = []
        self._templates: dict[bytes, Template] = {}
        self._numbers: dict[tuple[bytes, object], int] = {}

    def number(
        self,
        parts: Parts,
        data: memoryview,
        *,
        describe: Callable[[str | None], _ModelT],
        extra: object = None,
    ) -> int:
        """The number of a message's header, after rebuilding the message and comparing.

        Args:
            parts: Of the message.
            data: The message.
            describe: Makes the model of a new header, given its template or None for a plain one.
            extra: What else makes a header another one.

        Raises:
            Unsuited: It does not rebuild, or there are too many.
        """
        blank = parts.blank
        try:
            template = self._templates.get(blank) or self.form.template(blank)
            exact = prove(template, parts, data)
        except WireError as error:
            raise Unsuited(f"its header does not rebuild: {error}") from None
        if not exact:
            raise Unsuited("its header does not rebuild")
        known = self._numbers.get((blank, extra))
        if known is not None:
            return known
        if len(self.items) == MAX_VARIANTS:
            raise Unsuited(f"more than {MAX_VARIANTS} different message headers")
        plain = self.form.plain(parts.frame_id, parts.fields)
        self.items.append(describe(None if plain == blank else base64.b64encode(blank).decode()))
        self._templates[blank] = template
        self._numbers[blank, extra] = len(self.items) - 1
        return len(self.items) - 1
