"""Making datasets and turning them back: ``pack``, ``unpack``, ``import``, ``export``, ``demo``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

import mp4ds
from mp4ds.cli.options import (
    argument,
    command,
    datasets_argument,
    jobs_option,
    option,
    output_option,
    parse_share,
    takes,
)
from mp4ds.cli.output import (
    Row,
    display,
    number,
    plain,
    print_table,
    progress_of,
    say,
    say_counts,
    show,
)
from mp4ds.dataset.dataset import datasets_in
from mp4ds.errors import OptionError, counted, path_text, size_text
from mp4ds.options import HOW, LONG, WHERE, declared_in, seconds_text
from mp4ds.packing.options import ImportOptions, PackOptions, PackProgress, PackSummary
from mp4ds.packing.pack import is_packed
from mp4ds.plugins.demo import demo
from mp4ds.plugins.exporting.export import export
from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary
from mp4ds.plugins.importing.images import episodes_in
from mp4ds.records import Loss, latched_text
from mp4ds.unpacking.unpack import UnpackOptions, UnpackProgress, UnpackSummary, unpack, unpack_each

_LOSSES_SHOWN = 20
_TEXTS = {"topic": "topic", "type": "type", "stored in": "text"}
_SPARE = ("type", "frames", "raw")


@command()
@argument(
    "sources",
    "SOURCE...",
    "A .bag, rosbag2 folder, .mcap or dataset; or the parts of a split recording.",
    nargs=-1,
    required=True,
)
@output_option(
    "DATASET",
    "Folder to create; if it ends in a slash, one dataset per SOURCE is made in it. Default: "
    "named after SOURCE, in the current folder.",
)
@option("--shard", panel=LONG, metavar="I/N", help="Pack only share I of N shares of the parts.")
@takes(PackOptions)
def pack_command(
    sources: Sequence[str], output: str | None, shard: str | None, options: PackOptions
) -> None:
    """Pack a recording into a dataset of mp4 files, or repack a dataset.

    Lossless by default: `mp4ds unpack` restores every message exactly. To resume a long pack that
    was interrupted, run the same command again. Repacking a dataset keeps exact what was exact.
    """
    into = output if output and output.endswith("/") else None
    if shard and (options.join or into):
        raise OptionError("`shard` cannot be combined with `join` or with several datasets.")
    with pack_progress(whole=not shard) as progress:
        if shard:
            mp4ds.pack_share(sources, output, parse_share(shard), options, progress=progress)
            done = f"share {shard} is packed; once all shares are, run --join to make the dataset"
            show([], lambda _: say(done))
            return
        if into:
            summaries = mp4ds.pack_each(sources, into, options, progress=progress)
        else:
            summaries = [mp4ds.pack(sources, output, options, progress=progress)]

    def print_all(_: object) -> None:
        if into and (there := len(sources) - len(summaries)):
            say(f"{counted(there, 'recording')} already packed in {path_text(into)}")
        for summary in summaries:
            print_pack(summary)

    show(summaries if into else summaries[0], print_all)


repack_command = pack_command


def print_pack(summary: PackSummary) -> None:
    """Print what became of each topic."""
    cameras = [topic for topic in summary.topics if topic.frames]
    others = [topic for topic in summary.topics if not topic.frames]
    rows = []
    for topic in (*cameras, *others):
        is_modelled = topic.messages and topic.frames == topic.messages
        ratio = topic.raw_bytes / topic.packed_bytes if topic.packed_bytes else 0
        row = {
            "topic": topic.topic,
            "type": topic.type_name,
            "messages": str(topic.messages),
            "frames": str(topic.frames) if topic.files else "",
            "raw": size_text(topic.raw_bytes) if topic.raw_bytes else "",
            "packed": size_text(topic.packed_bytes) if topic.packed_bytes else "",
            "ratio": number(ratio or None, 2),
            "stored in": ", ".join(topic.files) or ("sidecar" if is_modelled else "messages.mcap"),
        }
        rows.append(row)
    print_table(rows, _TEXTS, spare=_SPARE)
    for topic in summary.topics:
        for reason, (count, first) in topic.verbatim.items():
            share = f"{count} of {counted(topic.messages, 'message')} stored verbatim"
            say(f"{topic.topic}: {share} in messages.mcap: {reason} (first: message {first})")
        for note in topic.notes:
            say(f"{topic.topic}: {note}")
    for what, count in summary.skipped.items():
        say(f"not packed exactly: {what} ({count})")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    _print_latched(summary.latched, summary.latched_left_out)
    _print_losses(summary.losses, "listed in dataset.yaml")
    if not any(topic.files for topic in summary.topics):
        say("no topic became a video: all messages are stored unchanged in messages.mcap")
    if summary.not_copied:
        say(f"re-encoded, because it cannot be copied: {summary.not_copied}")
    if summary.is_copy:
        say(f"{path_text(summary.dataset)}: {size_text(summary.dataset_bytes)}, copied")
        return
    change = ""
    if summary.source_bytes:
        ratio = summary.source_bytes / summary.dataset_bytes
        change = f"{ratio:.2f} times smaller" if ratio >= 1 else f"{1 / ratio:.2f} times as large"
        change = f" ({change})"
    say(
        f"{path_text(summary.dataset)}: {size_text(summary.source_bytes)} -> "
        f"{size_text(summary.dataset_bytes)}{change}, of which messages.mcap "
        f"{size_text(summary.messages_bytes)}"
    )


# ---------------------------------------------------------------- progress of packs

_DIGITS = 9  # digits of a share: with a float's full precision, the time left may overflow

States = dict[Path, PackProgress]
"""Last reported state of each dataset, in the order in which they began."""


def share_of(states: States) -> float | None:
    """Share of packs that is done, by bytes of the sources; None if unknown."""
    total = packed = 0.0
    for state in states.values():
        share, weight = packed_share(state), max(1.0, state.bytes_total)
        if share is None:
            return None
        total, packed = total + weight, packed + weight * share
    return round(packed / total, _DIGITS) if total else None


def rows_of(states: States) -> list[Row]:
    """All packs, and each dataset or, of one, each camera."""
    if len(states) > 1:
        name, text = f"packing {len(states)} datasets", _amounts(*states.values())
        rows = [Row(one.dataset.name, _text(one), packed_share(one)) for one in states.values()]
        return [Row(name, text, share_of(states)), *rows]
    (state,) = states.values()
    cameras = [
        Row(
            topic,
            str(done) if total is None else f"{done}/{total}",
            min(1.0, done / total) if total else None,
        )
        for topic, (done, total) in state.topics.items()
    ]
    return [Row(f"packing {state.dataset.name}", _text(state), share_of(states)), *cameras]


def packed_share(state: PackProgress) -> float | None:
    """Share of a dataset that is packed, 0 to 1; None if unknown."""
    if state.phase == "planning":
        return 0.0
    if state.phase != "packing":
        return 1.0
    if state.done is not None:
        return round(min(1.0, max(0.0, state.done)), _DIGITS)
    return min(1.0, state.tasks_done / state.tasks_total) if state.tasks_total else None


def _text(state: PackProgress) -> str:
    phase = "" if state.phase == "packing" else f"{state.phase} {plain(state.note)}".strip()
    return "  ".join(filter(None, (phase, _amounts(state))))


def _amounts(*states: PackProgress) -> str:
    """Parts done and total, if there are any, and bytes read and written."""
    total, failed = sum(s.tasks_total for s in states), sum(s.failed for s in states)
    read, written = sum(s.bytes_read for s in states), sum(s.bytes_written for s in states)
    texts = [
        f"parts {sum(s.tasks_done for s in states)}/{total}" if total else "",
        f"{failed} failed" if failed else "",
        f"{size_text(read)} -> {size_text(written)}",
    ]
    return "  ".join(filter(None, texts))


@contextmanager
def pack_progress(*, whole: bool = True) -> Iterator[Callable[[PackProgress], None]]:
    """Show the progress of packs while the context lasts.

    Args:
        whole: Whether this run is to do all of the job; of a share, the time left is not shown.

    Yields:
        What takes the progress, several times a second.
    """
    states: States = {}
    with display(timed=whole) as show:

        def take(state: PackProgress) -> None:
            states[state.dataset] = state
            show(rows_of(states))

        yield take


# ---------------------------------------------------------------- unpack


@command()
@datasets_argument
@option(
    "--to",
    panel=WHERE,
    metavar="TEXT",
    help="bag, rosbag2 or mcap; default: by the suffix of OUT, else as recorded.",
)
@output_option(
    "OUT", "Output, or a folder for the outputs of several datasets; default: NAME_unpacked."
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
    """Turn a dataset back into a recording: a bag, rosbag2 or MCAP.

    Messages are converted between ROS 1 and ROS 2 if the output format requires it.
    """
    found = datasets_in(datasets)
    with progress_of("unpacking") as tell:

        def progress(state: UnpackProgress) -> None:
            total = state.messages_total
            unit = "message" if len(found) == 1 else "dataset"
            done = f"{state.messages} of {total}" if total else f"{state.messages}"
            tell(f"{done} {unit}s", state.messages / total if total else None)

        if len(found) == 1:
            summaries = [unpack(found[0], to, output, options, progress=progress)]
        else:
            summaries = unpack_each(found, to, output, options, jobs=jobs, progress=progress)
    result = summaries[0] if len(found) == 1 else summaries
    show(result, lambda _: [*map(_print_unpack, summaries)])


def _print_unpack(summary: UnpackSummary) -> None:
    """Print what was written, and what the target could not hold."""
    total = sum(summary.messages.values())
    topics = counted(len(summary.messages), "topic")
    say(f"{path_text(summary.output)}: {counted(total, 'message')} of {topics}")
    for topic, now in summary.republished.items():
        taken = f" (the name {now.instead_of} is taken)" if now.instead_of else ""
        say(f"{topic}: written as {now.topic}, {now.type_name}{taken}")
    say_counts(summary.as_recorded, "as recorded")
    say_counts(summary.unconvertible, "left out")
    if summary.converted:
        say(f"converted between ROS 1 and ROS 2: {', '.join(summary.converted)}")
    for what, count in summary.omitted.items():
        say(f"not supported by this format: {what} ({count})")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    _print_latched(summary.latched, summary.latched_left_out)
    for note in summary.notes:
        say(note)
    _print_losses(summary.losses, "listed with --json")


# ---------------------------------------------------------------- of both


def _print_losses(losses: Sequence[Loss], where: str) -> None:
    """Print what could not be read, and where the rest is listed."""
    for loss in losses[:_LOSSES_SHOWN]:
        topics = f" of {', '.join(loss.topics)}" if loss.topics else ""
        if loss.frames is not None:
            first, last = loss.frames
            frames = f"frame {first}" if first == last else f"frames {first} to {last}"
            ends = [seconds_text(time) for time in (loss.start, loss.end) if time is not None]
            logged = f", log time {' to '.join(dict.fromkeys(ends))}" if ends else ""
            say(f"lost: {loss.file}: {frames}{topics}{logged}: {loss.problem}")
            continue
        place = f" at byte {loss.offset}" if loss.offset is not None else ""
        size = f", {size_text(loss.size)}" if loss.size is not None else ""
        messages = f"; {counted(loss.messages, 'message')}" if loss.messages else ""
        if loss.messages == 0:
            messages = "; no messages"
        say(f"lost: {loss.file}{place}{size}: {loss.problem}{messages}{topics}")
    if len(losses) > _LOSSES_SHOWN:
        say(f"lost: {counted(len(losses) - _LOSSES_SHOWN, 'more place')}, {where}")


def _print_latched(latched: Mapping[str, int], left_out: Sequence[str]) -> None:
    """Print which latched messages from before a slice were included, by topic."""
    if latched:
        say(latched_text(latched))
    if left_out:
        topics = ", ".join(left_out)
        say(f"left out, as too large: latched messages from before the start: {topics}")


# ---------------------------------------------------------------- import, export, demo

_force = option("--force", "-f", is_flag=True, panel=WHERE, help="Replace an existing output.")


@click.group("import")
def import_command() -> None:
    """Make a dataset from images, from a video, or from a LeRobotDataset."""


def _imports(*kinds: str) -> Callable[[Callable[..., Any]], Any]:
    """Give a command the options of what it imports, and of packing."""
    others = [name for name, one in declared_in(ImportOptions) if not {*one.only} & {*kinds}]
    packing = takes(PackOptions, without=("camera_info", "join", "salvage"))
    return lambda function: takes(ImportOptions, "images", without=others)(packing(function))


def _import(source: str, output: str, images: ImportOptions, options: PackOptions) -> None:
    with pack_progress() as progress:
        summary = mp4ds.pack(source, output, replace(options, images=images), progress=progress)
    show(summary, print_pack)


@command("images")
@argument("folder", "FOLDER", "Folder of images.")
@output_option("DATASET", "Folder to create.", required=True)
@_imports("plain")
def images_command(folder: str, output: str, images: ImportOptions, options: PackOptions) -> None:
    """Make a dataset from a folder of timestamped images.

    Lossless by default. To resume a long import that was interrupted, run the same command again.
    """
    _import(folder, output, images, options)


@command("video")
@argument("video", "VIDEO", "An mp4, m4v or mov file.")
@output_option("DATASET", "Folder to create.", required=True)
@_imports("video")
def video_command(video: str, output: str, images: ImportOptions, options: PackOptions) -> None:
    """Make a dataset from a video of any other program.

    Its packets are copied: H.264, H.265 and AV1 become CompressedVideo, Motion JPEG
    CompressedImage. Times are those of the video, or of a list.
    """
    _import(video, output, images, options)


@command("lerobot")
@argument("folder", "FOLDER", "A LeRobotDataset v3: the folder with meta, data and videos.")
@output_option(
    "DATASET",
    "Folder to create; without --episode, the folder for episode_000000 and so on.",
    required=True,
)
@_imports("lerobot")
def lerobot_command(folder: str, output: str, images: ImportOptions, options: PackOptions) -> None:
    """Make datasets of the episodes of a LeRobotDataset v3.

    Packets of videos are copied; states, actions and other rows become messages. To resume, run
    the same command again.
    """
    if images.episode is not None:
        _import(folder, output, images, options)
        return
    numbers, summaries = episodes_in(Path(folder)), []
    with pack_progress() as progress:
        for number in numbers:
            target = Path(output) / f"episode_{number:06d}"
            chosen = replace(options, images=replace(images, episode=number))
            # those that an earlier run made are left as they are
            if options.force or not is_packed(Path(folder), target, chosen):
                target.parent.mkdir(exist_ok=True)
                summaries.append(mp4ds.pack(folder, target, chosen, progress=progress))
    show(summaries, lambda _: [*map(print_pack, summaries)])


@command("ros-mp4")
@argument("video", "VIDEO", "The mp4 file.")
@argument("sidecar", "YAML", "The YAML file that belongs to it.")
@output_option("DATASET", "Folder to create.", required=True)
@_force
def ros_mp4_command(video: str, sidecar: str, output: str, force: bool) -> None:
    """Convert an mp4 and YAML made by the tool published with the paper.

    The video is not re-encoded: its packets are copied.
    """
    show(mp4ds.import_ros_mp4(video, sidecar, output, force=force), print_pack)


for _command in (images_command, video_command, lerobot_command, ros_mp4_command):
    import_command.add_command(_command)


@command()
@argument(
    "output",
    "OUTPUT",
    "What to write: .mcap, .bag (ROS 1), or no suffix for rosbag2.  [default: demo.mcap]",
    default="demo.mcap",
    type=click.Path(path_type=Path),
)
@option(
    "--seconds",
    type=float,
    default=3.0,
    panel=HOW,
    metavar="N",
    help="Length of the recording.  [default: 3]",
)
@_force
def demo_command(output: Path, seconds: float, force: bool) -> None:
    """Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf."""
    messages = demo(output, seconds=seconds, force=force)
    text = f"{path_text(output)}: {counted(messages, 'message')}"
    show({"output": output, "messages": messages}, lambda _: say(text))


@command()
@argument("to", "FORMAT", "images, euroc, tum, colmap or lerobot.")
@argument(
    "datasets",
    "DATASET...",
    "A dataset; for lerobot one or more, each an episode.",
    nargs=-1,
    required=True,
)
@output_option("OUT", "Folder to create.", required=True)
@takes(ExportOptions)
def export_command(to: str, datasets: Sequence[str], output: str, options: ExportOptions) -> None:
    """Export a dataset to image files or another tool's format, keeping what that supports.

    FORMAT images makes a folder for each camera: JPEG and PNG files as recorded, other images as
    PNG files, and their times in stamps.csv. Folders of images get the exact pixels, or with
    --quality visual those of the views of lossless cameras; lerobot's videos are made of the
    views. What is left out is counted by topic and listed, here and in mp4ds_export.json.
    """
    with progress_of("exporting") as tell:
        summary = export(datasets, to, output, options, progress=tell)
    show(summary, _print_export)


def _print_export(summary: ExportSummary) -> None:
    """Print what was written, and every message that was not."""
    total = sum(summary.messages.values())
    topics = counted(len(summary.messages), "topic")
    say(f"{path_text(summary.output)}: {counted(total, 'message')} of {topics}")
    for place, topic in summary.places.items():
        say(f"{place}: {topic}")
    for note in summary.notes:
        say(f"note: {note}")
    for topic, reasons in summary.left_out.items():
        for reason, count in reasons.items():
            say(f"left out: {counted(count, 'message')} of {topic}: {reason}")
