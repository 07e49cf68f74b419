"""``mp4ds demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mp4ds.cli.options import ForceFlag, JsonFlag
from mp4ds.cli.output import print_json, say
from mp4ds.cli.process import report_errors
from mp4ds.errors import counted, path_text
from mp4ds.plugins.demo import demo as make_demo


def demo(
    output: Annotated[
        Path,
        typer.Argument(help="What to write: .mcap, .bag (ROS 1), or no suffix for rosbag2."),
    ] = Path("demo.mcap"),
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.1, max=3600.0, help="Length of the recording.")
    ] = 3.0,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf."""
    with report_errors(as_json):
        messages = make_demo(output, seconds=seconds, force=force)
    if as_json:
        print_json({"output": output, "messages": messages})
    else:
        say(f"{path_text(output)}: {counted(messages, 'message')}")
