"""What Foxglove clients are told beside messages: the time, and where the player stands."""

from __future__ import annotations

import struct
import threading
import time
from typing import Any

from mp4ds.publishers.protocol import Controls

_TIME_S = 0.05
"""Time is told no more often: clients that do not take it are disconnected by the SDK."""

_STATE_S = 1.0
"""The player's state is told at least as often, for clients that came since."""

MAX_TIME = 2**64 - 1
"""The last time, nanoseconds, that the protocol can hold."""


class Teller:
    """Tells the time of the messages, or of a clock, and the state of a player.

    Args:
        websocket: The SDK's module of this name.
        can_control: Whether clients were told that they control a player.
    """

    def __init__(self, websocket: Any, *, can_control: bool) -> None:
        self._sdk = websocket
        self._can_control = can_control
        self._server: Any = None
        self._controls: Controls | None = None
        self._time: int | None = None
        self._published: int | None = None
        self._has_clock = False
        self._told: int | None = None
        self._told_at = 0.0
        # what is told is the latest: an older time would be a jump to clients
        self._telling = threading.Lock()
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_telling, name="foxglove", daemon=True)

    def start(self, server: Any) -> None:
        """Begin to tell a server's clients."""
        self._server = server
        self._thread.start()

    def serve(self, controls: Controls) -> None:
        """Tell of this player, and do with it what clients want."""
        self._controls = controls

    def close(self) -> None:
        """Tell nothing any more."""
        self._is_closing.set()
        self._thread.join()

    def reach(self, time_ns: int) -> None:
        """Be at the time of a message that is about to be published, nanoseconds."""
        has_jumped = self._published is not None and time_ns < self._published
        self._published = self._time = time_ns
        if has_jumped:
            self._tell_state(did_seek=True)
        if not self._has_clock and time.monotonic() - self._told_at >= _TIME_S:
            self._tell_time()

    def clock(self, time_ns: int) -> None:
        """Tell a time; from the first call on, those of messages are not told."""
        self._has_clock = True
        self._time = min(max(0, time_ns), MAX_TIME)
        self._tell_time()

    def on_request(self, request: Any) -> Any:
        """What a client wants of the player is done; returns the player's state.

        From any thread. Where there is no player the answer is None.
        """
        controls = self._controls
        if controls is None:
            return None
        did_seek = request.seek_time is not None and controls.seek(request.seek_time)
        if did_seek:
            # the answer tells of this jump
            self._time, self._published = request.seek_time, None
        if request.playback_speed != _as_float32(controls.rate):
            # it comes as a float32: 1.1 is not to become 1.10000002384
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

    def _tell_state(self, *, did_seek: bool = False) -> None:
        if self._controls is None or not self._can_control or self._time is None:
            return
        # asked for outside of the lock: the player may have one of its own
        is_paused, rate = self._controls.is_paused, self._controls.rate
        with self._telling:
            self._server.broadcast_playback_state(self._state(is_paused, rate, did_seek))

    def _tell_time(self) -> None:
        with self._telling:
            if self._time is not None:
                self._told, self._told_at = self._time, time.monotonic()
                self._server.broadcast_time(self._time)

    def _keep_telling(self) -> None:
        """What else would not be told: changes by other controls, the time of the last message."""
        told: tuple[bool, float] | None = None
        told_at = 0.0
        while not self._is_closing.wait(_TIME_S):
            if not self._has_clock and self._time != self._told:
                self._tell_time()
            if self._controls is None or self._time is None:
                continue
            state = self._controls.is_paused, self._controls.rate
            if state != told or time.monotonic() - told_at >= _STATE_S:
                told, told_at = state, time.monotonic()
                self._tell_state()


def _as_float32(value: float) -> float:
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return value
