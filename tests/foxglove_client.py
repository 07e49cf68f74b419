"""A Foxglove client of the tests' own, which takes apart what the protocol sends."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from waiting import WATCHDOG_S

WAIT_S = WATCHDOG_S
PLAY, PAUSE = 0, 1


@dataclass(frozen=True)
class State:
    """Where a player stands."""

    is_paused: bool
    time: int
    speed: float
    did_seek: bool
    request: str


class Client:
    """Connects, and keeps what comes while it waits for something.

    Attributes:
        info: The server's first message.
        channels: What is announced, by id.
        messages: Id of the channel, log time, payload; in order.
        times: Times told.
        states: States of the player.
        statuses: Texts of status messages.
    """

    def __init__(self, address: str) -> None:
        self._connection = connect(
            address, subprotocols=["foxglove.sdk.v1"], max_size=None, compression=None
        )
        self.info: dict[str, Any] = {}
        self.channels: dict[int, dict[str, Any]] = {}
        self.messages: list[tuple[int, int, bytes]] = []
        self.times: list[int] = []
        self.states: list[State] = []
        self.statuses: list[str] = []

    def __enter__(self) -> Client:
        self._socket = self._connection.__enter__()
        self.wait(lambda: bool(self.info))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._connection.__exit__(kind, error, trace)

    def wait(self, is_done: Callable[[], bool]) -> None:
        """Take what comes until something is so."""
        end = time.monotonic() + WAIT_S
        while not is_done():
            self._take(self._socket.recv(timeout=max(0.01, end - time.monotonic())))

    def drain(self, seconds: float) -> None:
        """Take what comes for a while, or to the end."""
        end = time.monotonic() + seconds
        try:
            while time.monotonic() < end:
                self._take(self._socket.recv(timeout=max(0.01, end - time.monotonic())))
        except (TimeoutError, ConnectionClosed):
            return

    def wait_closed(self) -> None:
        """Take what comes until the server ends the connection."""
        try:
            while True:
                self._take(self._socket.recv(timeout=WAIT_S))
        except ConnectionClosed:
            return

    def subscribe(self, *channels: int) -> None:
        """Subscribe to channels, under their own ids."""
        wanted = [{"id": channel, "channelId": channel} for channel in channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def unsubscribe(self, *channels: int) -> None:
        """Unsubscribe from channels."""
        self._socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": list(channels)}))

    def request(self, command: int, speed: float, seek: int | None = None, name: str = "r") -> None:
        """Want something of the player."""
        told = struct.pack(
            "<BBfBQI", 3, command, speed, seek is not None, seek or 0, len(name.encode())
        )
        self._socket.send(told + name.encode())

    def state(self, request: str) -> State:
        """The state that answers a request."""
        self.wait(lambda: any(state.request == request for state in self.states))
        return next(state for state in self.states if state.request == request)

    def _take(self, data: str | bytes) -> None:
        if isinstance(data, str):
            self._take_text(json.loads(data))
            return
        if data[0] == 1:
            _, channel, log_time = struct.unpack_from("<BIQ", data)
            self.messages.append((channel, log_time, data[13:]))
        elif data[0] == 2:
            self.times.append(struct.unpack_from("<Q", data, 1)[0])
        elif data[0] == 5:
            status, now, speed, did_seek, length = struct.unpack_from("<BQfBI", data, 1)
            name = data[19 : 19 + length].decode()
            self.states.append(State({0: False, 1: True}[status], now, speed, bool(did_seek), name))
        else:
            raise ValueError(f"operation {data[0]}")

    def _take_text(self, told: dict[str, Any]) -> None:
        if told["op"] == "serverInfo":
            self.info = told
        elif told["op"] == "advertise":
            self.channels |= {channel["id"]: channel for channel in told["channels"]}
        elif told["op"] == "status":
            self.statuses.append(told["message"])
        else:
            raise ValueError(told["op"])
