"""Play datasets back to ROS 1 or ROS 2, at the recorded times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from mp4ds.dataset.collections import datasets_in
from mp4ds.dataset.salvage import HOW_TO_SALVAGE, open_selected
from mp4ds.errors import advising
from mp4ds.plugins.playing.options import PlayOptions, Wanted
from mp4ds.plugins.playing.player import Player, PlayProgress, PlaySummary
from mp4ds.plugins.playing.timeline import Timeline
from mp4ds.plugins.ros.node import Node, chosen_world, open_node

_NODES = {"ros1": "mp4ds_play", "ros2": "rosbag2_player"}


def play(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    progress: Callable[[PlayProgress], None] | None = None,
) -> PlaySummary:
    """Play back datasets, publishing their messages at the recorded times.

    Args:
        datasets: Datasets, or sidecars next to their videos; paths or URLs. Several are merged by
            log time.
        options: How to play them.
        progress: Called a few times a second.

    Returns:
        What was published, and what was left out.

    Raises:
        OptionError: An option is wrong.
        ConversionError: A topic cannot be published there; names it.
        RemoteError: ROS is not available, or the connection was lost.
        FormatError: A dataset is damaged.
    """
    with open_player(datasets, options, progress=progress) as player:
        return player.run()


@contextmanager
def open_player(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    node: Node | None = None,
    progress: Callable[[PlayProgress], None] | None = None,
) -> Iterator[Player]:
    """A player of datasets that is not running yet.

    Args:
        datasets: As for `play`.
        options: As for `play`.
        node: Where to publish, not closed here; None: as the options say.
        progress: As for `play`.
    """
    chosen = options or PlayOptions()
    world = node.world if node else chosen_world("play", chosen.to)
    chosen = replace(chosen, names=chosen.names.in_world(world))
    with ExitStack() as stack:
        stack.enter_context(advising(HOW_TO_SALVAGE))
        wanted = Wanted(chosen)
        opened = [
            stack.enter_context(open_selected(place, wanted, jpeg_quality=chosen.jpeg_quality))
            for place in datasets_in(datasets)
        ]
        timeline = Timeline(opened, chosen, wanted, world)
        node = node or stack.enter_context(open_node(world, chosen, _NODES[world]))
        follow = chosen.follow_clock
        if follow is None:
            follow = not (chosen.leads or chosen.immediate) and node.wants_clock
        chosen = replace(chosen, follow_clock=follow)
        yield Player(timeline, node, chosen, progress=progress)
