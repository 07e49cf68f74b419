"""Messages to Foxglove and its kin, as they are recorded, over a WebSocket server.

Clients are shown the very messages of the recording, with their log times; whatever the
serialization. Where they can control a player, they play, pause, seek and set the rate.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from mp4ds.bags.convert import is_latched
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.publishers.foxglove_gate import FOXGLOVE_ORIGIN, Gate
from mp4ds.publishers.foxglove_teller import MAX_TIME, Teller
from mp4ds.publishers.protocol import Controls
from mp4ds.records import Channel, Schema

_BACKLOG = 128
"""Messages that wait for a slow client."""

_BATCH = 32
_BATCH_S = 0.01
"""Pause after so many announcements: the SDK drops clients that do not take them."""

_LINGER_S = 0.5
"""How long what was published last may take to be sent before the server closes."""

_STOP_S = 2.0
"""How long the server waits for clients that take nothing, to say goodbye."""

_BINARY_SCHEMAS = ("protobuf", "flatbuffer")


class FoxglovePublisher:
    """Serves messages to Foxglove clients over a WebSocket.

    A client that takes messages more slowly than they come neither stops the others nor the
    publisher: `backlog` messages wait for it, then the oldest is dropped for each new one, for
    this client alone. The SDK counts no drops, so neither does this. A client that does not
    even take the time, for `backlog` / 20 s, is disconnected with a status message and may
    connect again. Memory is bounded by `backlog` times the size of the messages, for each slow
    client.

    The last message of each latched channel (ROS 1 latching, ROS 2 transient_local) is sent
    again when a client subscribes to it; other subscribers get it a second time, with the same
    log time.

    Channels without a schema are announced with an empty one. Bytes of a definition that are no
    UTF-8 (in comments of old ROS 1 definitions) are announced as U+FFFD, since the protocol is
    text there.

    Args:
        host: Address of this machine to listen on.
        port: Port to listen on; 0 picks a free one.
        name: What clients show as the server's name.
        span: First and last log time of the recording, nanoseconds: the time line that clients
            show to control the player. Without it they can only watch.
        backlog: Messages that wait for each slow client; also control messages.
        origins: Web sites that may connect, such as ``https://app.foxglove.dev``, besides those
            of this machine; programs that are no browser always may.

    Attributes:
        world: None: messages go as they are recorded.

    Raises:
        PublishError: The port is taken, or the package is missing.
        OptionError: An option cannot be.
    """

    world: str | None = None

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = 8765,
        name: str = "mp4ds",
        span: tuple[int, int] | None = None,
        backlog: int = _BACKLOG,
        origins: Sequence[str] = (),
    ) -> None:
        _check(port, span, backlog)
        self._host = host
        self._port = port
        self._sdk = _sdk(self.address)
        self._context = self._sdk.Context()
        self._outlets: dict[int, _Outlet] = {}
        self._by_sdk_id: dict[int, list[_Outlet]] = {}
        self._subscribed: dict[int, set[int]] = {}
        # one message at a time: a latched one must not overtake its successor
        self._sending = threading.Lock()
        self._sent_at = 0.0
        self._is_closed = False
        self._teller = Teller(self._sdk.websocket, can_control=span is not None)
        self._gate = self._opened((FOXGLOVE_ORIGIN, *origins))
        self._port = self._gate.port
        try:
            self._server = self._start(name, span, backlog)
        except BaseException:
            self._gate.close()
            raise
        self._gate.open(self._server.port)
        self._teller.start(self._server)

    def _opened(self, origins: Sequence[str]) -> Gate:
        try:
            return Gate(self._host, self._port, origins)
        except ImportError:
            raise _missing(self.address, "cryptography") from None
        except OSError as error:
            raise PublishError(
                self.address,
                f"Foxglove cannot be served there: {error.strerror or error}; choose another port "
                "with --port, or --port 0 for any that is free",
            ) from None

    def _start(self, name: str, span: tuple[int, int] | None, backlog: int) -> Any:
        capability = self._sdk.websocket.Capability
        return self._sdk.start_server(
            name=name,
            host="127.0.0.1",
            port=0,
            tls_cert=self._gate.certificate,
            tls_key=self._gate.key,
            context=self._context,
            capabilities=[capability.Time],
            server_listener=_Listener(self, self._teller),
            playback_time_range=span,
            message_backlog_size=backlog,
        )

    @property
    def address(self) -> str:
        """What clients connect to, such as ``ws://127.0.0.1:8765``."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"ws://{host}:{self._port}"

    # ------------------------------------------------------------ messages

    def advertise(self, channel: Channel) -> None:
        """See `Publisher`."""
        if id(channel) in self._outlets:
            return
        announced = self._sdk.Channel(
            _text(channel.topic),
            message_encoding=_text(channel.message_encoding),
            schema=self._schema(channel),
            metadata={_text(key): _text(value) for key, value in channel.metadata.items()},
            context=self._context,
        )
        # channels that cannot be told apart are one to the SDK
        outlet = _Outlet(channel, announced, is_latched(channel))
        with self._sending:
            self._outlets[id(channel)] = outlet
            self._by_sdk_id.setdefault(announced.id(), []).append(outlet)
        if len(self._outlets) % _BATCH == 0:
            time.sleep(_BATCH_S)

    def _schema(self, channel: Channel) -> Any:
        schema = channel.schema
        if schema is None:
            encoding = "jsonschema" if channel.message_encoding == "json" else ""
            schema = Schema("", encoding, b"")
        data = schema.data
        if schema.encoding not in _BINARY_SCHEMAS:
            data = data.decode("utf-8", "replace").encode()
        return self._sdk.Schema(name=_text(schema.name), encoding=_text(schema.encoding), data=data)

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """See `Publisher`."""
        outlet = self._outlets[id(channel)]
        if not 0 <= time_ns <= MAX_TIME:
            raise ConversionError(
                channel.topic,
                f"has a message of the time {time_ns} ns, and Foxglove's begin at 0",
                "Leave the topic out.",
            )
        if self._is_closed:
            raise PublishError(self.address, "the server was closed")
        if not outlet.is_latched:
            # a latched message of the past does not bring the past back
            self._teller.reach(time_ns)
        if not (outlet.is_latched or outlet.announced.has_sinks()):
            return
        data = payload if isinstance(payload, bytes) else bytes(payload)
        with self._sending:
            if outlet.is_latched:
                outlet.last = (data, time_ns)
            outlet.announced.log(data, log_time=time_ns)
        self._sent_at = time.monotonic()

    def subscribers(self, channel: Channel) -> int:
        """See `Publisher`; those of this very channel, not of all with its topic."""
        outlet = self._outlets[id(channel)]
        with self._sending:
            return len(self._subscribed.get(outlet.announced.id(), ()))

    def on_subscribe(self, client: int, channel: int) -> None:
        """A client subscribed: what is latched is sent again. From any thread."""
        with self._sending:
            self._subscribed.setdefault(channel, set()).add(client)
            for outlet in self._by_sdk_id.get(channel, ()):
                if outlet.last is not None:
                    data, time_ns = outlet.last
                    outlet.announced.log(data, log_time=time_ns)
                    self._sent_at = time.monotonic()

    def on_unsubscribe(self, client: int, channel: int) -> None:
        """A client unsubscribed or left. From any thread."""
        with self._sending:
            self._subscribed.get(channel, set()).discard(client)

    # ------------------------------------------------------------ time and controls

    def clock(self, time_ns: int) -> None:
        """See `Publisher`; from the first call on, no other time is told.

        Times that Foxglove cannot hold are told as the nearest that it can.
        """
        if not self._is_closed:
            self._teller.clock(time_ns)

    def serve(self, controls: Controls) -> None:
        """See `Publisher`; clients control the player if the recording's span was given."""
        self._teller.serve(controls)

    # ------------------------------------------------------------ what it has not, and the end

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """See `Publisher`.

        Raises:
            OptionError: Always: Foxglove clients publish no clock.
        """
        raise OptionError(
            "another clock cannot be followed with --foxglove: its clients have none."
        )

    def listen(self, topic: str, on_message: Callable[[], None]) -> None:
        """See `Publisher`.

        Raises:
            OptionError: Always: there are no topics of others.
        """
        raise OptionError(
            f"{topic} cannot be listened to with --foxglove: its clients publish nothing."
        )

    @property
    def wants_clock(self) -> bool:
        """False: clients are told the time anyway."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether it was not closed: nobody shuts it down from outside."""
        return not self._is_closed

    def close(self) -> None:
        """See `Publisher`; what a client has not taken 0.5 s after the last message is dropped."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            with self._sending:
                is_anybody_there = any(self._subscribed.values())
            if is_anybody_there:
                time.sleep(max(0.0, self._sent_at + _LINGER_S - time.monotonic()))
        finally:
            self._teller.close()
            # in a thread: the SDK waits for ever for a client that takes nothing
            stopper = threading.Thread(target=self._server.stop, name="foxglove stop", daemon=True)
            stopper.start()
            stopper.join(_STOP_S)
            self._gate.close()

    def __enter__(self) -> FoxglovePublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Outlet:
    """A channel as it is announced, and the last of its messages where it is latched."""

    def __init__(self, channel: Channel, announced: Any, is_latched: bool) -> None:
        self.channel = channel  # kept, so that its id() stays its own
        self.announced = announced
        self.is_latched = is_latched
        self.last: tuple[bytes, int] | None = None


class _Listener:
    """What the SDK calls, from threads of its own."""

    def __init__(self, publisher: FoxglovePublisher, teller: Teller) -> None:
        self._publisher = publisher
        self._teller = teller

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._publisher.on_subscribe(client.id, channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        self._publisher.on_unsubscribe(client.id, channel.id)

    def on_playback_control_request(self, playback_control_request: Any) -> Any:
        return self._teller.on_request(playback_control_request)


def _check(port: int, span: tuple[int, int] | None, backlog: int) -> None:
    if not 0 <= port <= 65535:
        raise OptionError(f"--port {port} is no port: they go from 0 to 65535.")
    if span is not None and not 0 <= span[0] <= span[1] <= MAX_TIME:
        raise OptionError(f"{span[0]} to {span[1]} ns is no span of time that Foxglove can show.")
    if backlog < 1:
        raise OptionError(f"{backlog} messages cannot wait for a client: at least 1.")


def _sdk(address: str) -> Any:
    """The SDK, which logs only where the program set up logging for it."""
    try:
        import foxglove
        import foxglove.websocket
    except ImportError:
        raise _missing(address, "foxglove-sdk") from None
    logger = logging.getLogger("foxglove")
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        logger.addHandler(logging.NullHandler())
    return foxglove


def _missing(address: str, package: str) -> PublishError:
    said = f"needs the Python package {package}: pip install 'mp4ds[foxglove]'"
    return PublishError(address, said)


def _text(text: str) -> str:
    """Text that UTF-8 can hold: a recording's may have bytes that it could not."""
    return text.encode("utf-8", "replace").decode()
