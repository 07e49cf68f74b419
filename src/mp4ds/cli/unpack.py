"""``mp4ds unpack``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from mp4ds.cli.options import command, datasets_argument, jobs_option, option, takes
from mp4ds.cli.output import say, show
from mp4ds.cli.pack import print_latched, print_losses
from mp4ds.cli.progress import progress_of
from mp4ds.dataset.collections import datasets_in
from mp4ds.errors import counted, path_text
from mp4ds.options import WHERE
from mp4ds.unpacking.options import UnpackOptions, UnpackProgress, UnpackSummary
from mp4ds.unpacking.unpack import unpack, unpack_each


@command()
@datasets_argument
@option(
    "--to",
    panel=WHERE,
    metavar="TEXT",
    help="bag, rosbag2, mcap or images; default: the recorded format.",
)
@option(
    "--output",
    "-o",
    panel=WHERE,
    metavar="OUT",
    help="Output, or a folder for the outputs of several datasets; default: NAME_unpacked.",
)
@jobs_option
@takes(UnpackOptions)
def unpack_command(
    datasets: Sequence[str],
    to: str | None,
    output: str | None,
    jobs: int | None,
    options: UnpackOptions,
) -> None:
    """Turn a dataset back into a recording: a bag, rosbag2, MCAP or images.

    Messages are converted between ROS 1 and ROS 2 if the output format requires it.
    """
    noun = "image" if to == "images" else "message"
    found = datasets_in(datasets)
    with progress_of("unpacking") as tell:

        def progress(state: UnpackProgress) -> None:
            total = state.messages_total
            unit = noun if len(found) == 1 else "dataset"
            done = f"{state.messages} of {total}" if total else f"{state.messages}"
            tell(f"{done} {unit}s", state.messages / total if total else None)

        if len(found) == 1:
            summaries = [unpack(found[0], to, output, options, progress=progress)]
        else:
            summaries = unpack_each(found, to, output, options, jobs=jobs, progress=progress)
    result = summaries[0] if len(found) == 1 else summaries
    show(result, lambda _: [*map(partial(_print, noun=noun), summaries)])


def _print(summary: UnpackSummary, noun: str) -> None:
    """Print what was written, of things of that name, and what the target could not hold."""
    total = sum(summary.messages.values())
    topics = counted(len(summary.messages), "topic")
    say(f"{path_text(summary.output)}: {counted(total, noun)} of {topics}")
    for topic, now in summary.republished.items():
        taken = f" (the name {now.instead_of} is taken)" if now.instead_of else ""
        say(f"{topic}: written as {now.topic}, {now.type_name}{taken}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {counted(count, 'message')} as recorded: {reason}")
    for topic, reasons in summary.unconvertible.items():
        for reason, count in reasons.items():
            say(f"{topic}: {counted(count, 'message')} left out: {reason}")
    for topic, count in summary.thinned.items():
        say(f"{topic}: {counted(count, 'message')} left out")
    if summary.converted:
        say(f"converted between ROS 1 and ROS 2: {', '.join(summary.converted)}")
    for what, count in summary.omitted.items():
        say(f"not supported by this format: {what} ({count})")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    print_latched(summary.latched, summary.latched_left_out)
    for note in summary.notes:
        say(note)
    print_losses(summary.losses, "listed with --json")
