"""The publisher for Foxglove and compatible clients, which is a WebSocket server.

Clients get the recorded messages unchanged, in any serialization, with their log times. They can
play, pause, seek and set the rate of a player that allows it.
"""

from __future__ import annotations

import asyncio
import datetime
import io
import logging
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from http.client import HTTPException, parse_headers
from typing import Any
from urllib.parse import urlsplit

from mp4ds.bags.latched import Kept, has_late
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.plugins.publishing.publisher import Controls
from mp4ds.records import Channel, Schema

FOXGLOVE_ORIGIN = "https://app.foxglove.dev"

_LOOPBACK = "127.0.0.1"
_LOOPBACK_NAMES = ("localhost", _LOOPBACK, "::1")
_NAME = "mp4ds"  # in the certificate
_HEAD_S = 10.0
_BLOCK = 1 << 18
_FLUSH_S = 0.5
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


def is_welcome(origin: str | None, allowed: Sequence[str]) -> bool:
    """Whether a client may connect.

    Args:
        origin: The ``Origin`` header of its request, which browsers always send.
        allowed: Origins of web sites that may, besides local ones.
    """
    if origin is None or origin in allowed:
        return True
    try:
        parts = urlsplit(origin)
        host = parts.hostname
    except ValueError:
        return False
    if parts.scheme in ("http", "https"):
        return host in _LOOPBACK_NAMES
    return bool(parts.scheme)  # a program's, such as file: ; that of a framed page is "null"


class Gate:
    """A proxy in front of the SDK's server, which only allowed clients get through.

    Memory for a slow client is bounded: nothing is read from the server until the client receives.

    Args:
        host: Address of this machine to listen on.
        port: Port to listen on; 0 picks a free one.
        origins: Origins of web sites that may connect, besides local ones.

    Attributes:
        port: The port that it listens on.
        certificate: Certificate for the server, PEM.
        key: Key for the server, PEM.

    Raises:
        OSError: It cannot listen there.
        ImportError: The package cryptography is missing.
    """

    def __init__(self, host: str, port: int, origins: Sequence[str]) -> None:
        self._origins = origins
        self.certificate, self.key = _certificate()
        self._tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._tls.load_verify_locations(cadata=self.certificate.decode())
        self._listener = _listener(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._visits: set[asyncio.Task[None]] = set()
        self._thread: threading.Thread | None = None

    def open(self, server_port: int) -> None:
        """Start accepting clients.

        Args:
            server_port: Port of the SDK's server on the loopback interface.
        """
        self._server_port = server_port
        self._thread = threading.Thread(target=self._run, name="foxglove gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close all connections, after 0.5 s at most for clients to receive the rest."""
        if self._thread is None:
            self._listener.close()
            self._loop.close()
            return
        self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()
        self._thread = None

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._visit, sock=self._listener)
        await self._ending.wait()
        server.close()
        if self._visits:
            _, left = await asyncio.wait(self._visits, timeout=_FLUSH_S)
            for visit in left:
                visit.cancel()
            await asyncio.gather(*left, return_exceptions=True)

    async def _visit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._visits.add(task)
            task.add_done_callback(self._visits.discard)
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_S)
            if not self._is_welcome(head):
                writer.write(_REFUSED)
            else:
                await self._relay(head, reader, writer)
            writer.close()
            await writer.wait_closed()
        except (OSError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # it disconnected, or is not a client
        finally:
            writer.transport.abort()

    def _is_welcome(self, head: bytes) -> bool:
        try:
            origins = parse_headers(io.BytesIO(head.partition(b"\r\n")[2])).get_all("Origin", [])
        except HTTPException:
            return False
        return all(is_welcome(origin, self._origins) for origin in origins)

    async def _relay(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        from_server, to_server = await asyncio.open_connection(
            _LOOPBACK, self._server_port, ssl=self._tls, server_hostname=_NAME
        )
        to_server.write(head)
        ways = [
            asyncio.ensure_future(_pump(reader, to_server)),
            asyncio.ensure_future(_pump(from_server, writer)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            to_server.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_BLOCK):
            writer.write(data)
            await writer.drain()


def _listener(host: str, port: int) -> socket.socket:
    family, *_, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
    return socket.create_server(address[:2], family=family, dualstack_ipv6=both)


def _certificate() -> tuple[bytes, bytes]:
    """A self-signed certificate, and its key, both PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, _NAME)])
    # valid forever: it is used by this process only, and clocks may be wrong
    begin, end = (datetime.datetime(year, 1, 1) for year in (2000, 2200))
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(_NAME)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    form = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    pem = serialization.Encoding.PEM
    return certificate.public_bytes(pem), key.private_bytes(pem, *form)


# ---------------------------------------------------------------- time and state

_TIME_S = 0.05
"""Minimum interval between times sent: the SDK disconnects clients that do not keep up."""

_STATE_S = 1.0
"""Maximum interval between states sent, for clients that have connected since."""

MAX_TIME = 2**64 - 1
"""The latest time of the protocol, nanoseconds."""


class PlaybackReporter:
    """Sends clients the time, of the messages or of a clock, and the state of a player.

    Args:
        websocket: The SDK's module of this name.
        can_control: Whether clients may control a player.
    """

    def __init__(self, websocket: Any, *, can_control: bool) -> None:
        self._sdk = websocket
        self._can_control = can_control
        self._server: Any = None
        self._controls: Controls | None = None
        self._time: int | None = None
        self._published: int | None = None
        self._has_clock = False
        self._sent: int | None = None
        self._sent_at = 0.0
        # keeps times in order: an older one would be a jump to clients
        self._sending = threading.Lock()
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_sending, name="foxglove", daemon=True)

    def start(self, server: Any) -> None:
        """Start sending to a server's clients."""
        self._server = server
        self._thread.start()

    def serve(self, controls: Controls) -> None:
        """Report the state of this player, and let clients control it."""
        self._controls = controls

    def close(self) -> None:
        """Stop sending."""
        self._is_closing.set()
        self._thread.join()

    def reach(self, time_ns: int) -> None:
        """Advance to the time of a message that is about to be published, nanoseconds."""
        has_jumped = self._published is not None and time_ns < self._published
        self._published = self._time = time_ns
        if has_jumped:
            self._send_state(did_seek=True)
        if not self._has_clock and time.monotonic() - self._sent_at >= _TIME_S:
            self._send_time()

    def clock(self, time_ns: int) -> None:
        """Send a clock's time; from the first call on, times of messages are not sent."""
        self._has_clock = True
        self._time = min(max(0, time_ns), MAX_TIME)
        self._send_time()

    def on_request(self, request: Any) -> Any:
        """Carry out a client's request; returns the player's state, or None without a player.

        Called from any thread.
        """
        controls = self._controls
        if controls is None:
            return None
        did_seek = request.seek_time is not None
        if did_seek:
            # the response reports this jump
            self._time, self._published = controls.seek(request.seek_time), None
        if request.playback_speed != _as_float32(controls.rate):
            # it arrives as a float32: 1.1 must not become 1.10000002384
            controls.set_rate(round(request.playback_speed, 6))
        if request.playback_command == self._sdk.PlaybackCommand.Play:
            controls.resume()
        else:
            controls.pause()
        return self._state(controls.is_paused, controls.rate, did_seek)

    def _state(self, is_paused: bool, rate: float, did_seek: bool) -> Any:
        statuses = self._sdk.PlaybackStatus
        return self._sdk.PlaybackState(
            status=statuses.Paused if is_paused else statuses.Playing,
            current_time=self._time or 0,
            playback_speed=rate,
            did_seek=did_seek,
            request_id=None,
        )

    def _send_state(self, *, did_seek: bool = False) -> None:
        if self._controls is None or not self._can_control or self._time is None:
            return
        # read outside of the lock: the player has a lock of its own
        is_paused, rate = self._controls.is_paused, self._controls.rate
        with self._sending:
            self._server.broadcast_playback_state(self._state(is_paused, rate, did_seek))

    def _send_time(self) -> None:
        with self._sending:
            if self._time is not None:
                self._sent, self._sent_at = self._time, time.monotonic()
                self._server.broadcast_time(self._time)

    def _keep_sending(self) -> None:
        """Send changes made by other controls, and the time of the last message."""
        sent: tuple[bool, float] | None = None
        sent_at = 0.0
        while not self._is_closing.wait(_TIME_S):
            if not self._has_clock and self._time != self._sent:
                self._send_time()
            if self._controls is None or self._time is None:
                continue
            state = self._controls.is_paused, self._controls.rate
            if state != sent or time.monotonic() - sent_at >= _STATE_S:
                sent, sent_at = state, time.monotonic()
                self._send_state()


def _as_float32(value: float) -> float:
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return value


# ---------------------------------------------------------------- publisher

_BACKLOG = 128
"""Messages that may wait for a slow client."""

_BATCH = 32
_BATCH_S = 0.01
"""Pause after each batch of announcements: the SDK drops clients that do not keep up."""

_LINGER_S = 0.5
"""Time for sending the last messages before the server closes."""

_STOP_S = 2.0
"""How long the server may take to close connections with clients that receive nothing."""

_BINARY_SCHEMAS = ("protobuf", "flatbuffer")


class FoxglovePublisher:
    """Serves messages to Foxglove clients over a WebSocket.

    A slow client delays neither the others nor the publisher: `backlog` messages wait for it, then
    the oldest is dropped for each new one, for this client alone. The SDK does not count drops, so
    neither does this class. A client that does not even receive the time, for `backlog` / 20 s, is
    disconnected with a status message and may connect again. Memory is bounded by `backlog` times
    the size of the messages, for each slow client.

    Messages of a latched channel (ROS 1 latching, ROS 2 transient_local) are sent again when a
    client subscribes to it; other subscribers get them a second time, with the same log times.

    Channels without a schema are announced with an empty one. Bytes of a definition that are not
    UTF-8 (in comments of old ROS 1 definitions) are announced as U+FFFD, since the protocol has
    text there.

    Args:
        host: Address of this machine to listen on.
        port: Port to listen on; 0 picks a free one.
        name: The server's name, as shown by clients.
        span: First and last log time of the recording, nanoseconds: the time line with which
            clients control the player. Without it, they can only watch.
        backlog: Messages that may wait for each slow client; also control messages.
        origins: Web sites that may connect, such as ``https://app.foxglove.dev``, besides local
            ones; programs other than browsers always may.

    Attributes:
        world: None: messages are sent as recorded.

    Raises:
        PublishError: The port is in use, or the package is missing.
        OptionError: An option is not valid.
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
        # keeps messages in order: a latched one must not overtake its successor
        self._sending = threading.Lock()
        self._sent_at = 0.0
        self._is_closed = False
        self._reporter = PlaybackReporter(self._sdk.websocket, can_control=span is not None)
        self._gate = self._opened((FOXGLOVE_ORIGIN, *origins))
        self._port = self._gate.port
        try:
            self._server = self._start(name, span, backlog)
        except BaseException:
            self._gate.close()
            raise
        self._gate.open(self._server.port)
        self._reporter.start(self._server)

    def _opened(self, origins: Sequence[str]) -> Gate:
        try:
            return Gate(self._host, self._port, origins)
        except ImportError:
            raise _missing(self.address, "cryptography") from None
        except OSError as error:
            raise PublishError(
                self.address,
                f"cannot listen there: {error.strerror or error}; choose another port with `port`, "
                "or any free one with `port` 0",
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
            server_listener=_Listener(self, self._reporter),
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
        """Announce a channel before its first message."""
        if id(channel) in self._outlets:
            return
        announced = self._sdk.Channel(
            _text(channel.topic),
            message_encoding=_text(channel.message_encoding),
            schema=self._schema(channel),
            metadata={_text(key): _text(value) for key, value in channel.metadata.items()},
            context=self._context,
        )
        # to the SDK, channels with the same properties are one channel
        outlet = _Outlet(channel, announced)
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
        """Publish a message of an advertised channel."""
        outlet = self._outlets[id(channel)]
        if not 0 <= time_ns <= MAX_TIME:
            raise ConversionError(
                channel.topic,
                f"has a message at {time_ns} ns, and Foxglove has times from 0 to {MAX_TIME} ns",
                "Leave the topic out with `exclude`.",
            )
        if self._is_closed:
            raise PublishError(self.address, "the server was closed")
        if outlet.kept is None:
            # a latched message from the past must not set back the time
            self._reporter.reach(time_ns)
        if outlet.kept is None and not outlet.announced.has_sinks():
            return
        data = payload if isinstance(payload, bytes) else bytes(payload)
        with self._sending:
            if outlet.kept is not None:
                outlet.kept.add(data, (data, time_ns))
            outlet.announced.log(data, log_time=time_ns)
        self._sent_at = time.monotonic()

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers the channel has now, not counting others with its topic."""
        outlet = self._outlets[id(channel)]
        with self._sending:
            return len(self._subscribed.get(outlet.announced.id(), ()))

    def on_subscribe(self, client: int, channel: int) -> None:
        """Send latched messages again, as a client has subscribed. Called from any thread."""
        with self._sending:
            self._subscribed.setdefault(channel, set()).add(client)
            for outlet in self._by_sdk_id.get(channel, ()):
                for data, time_ns in outlet.kept or ():
                    outlet.announced.log(data, log_time=time_ns)
                    self._sent_at = time.monotonic()

    def on_unsubscribe(self, client: int, channel: int) -> None:
        """Forget a client that has unsubscribed or disconnected. Called from any thread."""
        with self._sending:
            self._subscribed.get(channel, set()).discard(client)

    # ------------------------------------------------------------ time and controls

    def clock(self, time_ns: int) -> None:
        """Send a recording time; from the first call on, times of messages are not sent.

        Times that Foxglove does not have are sent as the nearest that it has.
        """
        if not self._is_closed:
            self._reporter.clock(time_ns)

    def serve(self, controls: Controls) -> None:
        """Let clients control the player, if the recording's span was given."""
        self._reporter.serve(controls)

    # ------------------------------------------------------------ unsupported, and the end

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Not supported.

        Raises:
            OptionError: Always: Foxglove clients publish no clock.
        """
        raise OptionError("`foxglove` has no other players whose clock could be followed.")

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Not supported.

        Raises:
            OptionError: Always: Foxglove clients publish no messages.
        """
        raise OptionError(
            f"`foxglove` cannot subscribe to {topic}: Foxglove clients publish no messages."
        )

    @property
    def wants_clock(self) -> bool:
        """False: clients are sent the time anyway."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether it is open: it cannot be shut down from outside."""
        return not self._is_closed

    def close(self) -> None:
        """Close the server, after 0.5 s at most for clients to receive the last messages."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            with self._sending:
                has_subscribers = any(self._subscribed.values())
            if has_subscribers:
                time.sleep(max(0.0, self._sent_at + _LINGER_S - time.monotonic()))
        finally:
            self._reporter.close()
            # in a thread: the SDK waits forever for a client that receives nothing
            stopper = threading.Thread(target=self._server.stop, name="foxglove stop", daemon=True)
            stopper.start()
            stopper.join(_STOP_S)
            self._gate.close()

    def __enter__(self) -> FoxglovePublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Outlet:
    """An announced channel, and its latched messages."""

    def __init__(self, channel: Channel, announced: Any) -> None:
        self.channel = channel  # a reference, so that its id() stays unique
        self.announced = announced
        self.kept = Kept[tuple[bytes, int]](channel) if has_late(channel) else None


class _Listener:
    """The SDK's callbacks, called from threads of its own."""

    def __init__(self, publisher: FoxglovePublisher, reporter: PlaybackReporter) -> None:
        self._publisher = publisher
        self._reporter = reporter

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._publisher.on_subscribe(client.id, channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        self._publisher.on_unsubscribe(client.id, channel.id)

    def on_playback_control_request(self, playback_control_request: Any) -> Any:
        return self._reporter.on_request(playback_control_request)


def _check(port: int, span: tuple[int, int] | None, backlog: int) -> None:
    if not 0 <= port <= 65535:
        raise OptionError(f"`port` {port} is not a port from 0 to 65535.")
    if span is not None and not 0 <= span[0] <= span[1] <= MAX_TIME:
        raise OptionError(f"{span[0]} to {span[1]} ns: Foxglove cannot show this interval.")
    if backlog < 1:
        raise OptionError(f"`backlog` {backlog} is below 1.")


def _sdk(address: str) -> Any:
    """The SDK, which logs only if the program has set up logging for it."""
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
    problem = f"needs the Python package {package}: pip install 'mp4ds[foxglove]'"
    return PublishError(address, problem)


def _text(text: str) -> str:
    """Text that can be encoded as UTF-8, which a recording's may not."""
    return text.encode("utf-8", "replace").decode()
