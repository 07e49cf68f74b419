"""``mp4ds evaluate``, and what it prints."""

from __future__ import annotations

from itertools import chain

from mp4ds.cli.options import argument, command, output_option, takes
from mp4ds.cli.output import print_table, say, show
from mp4ds.cli.progress import progress_of
from mp4ds.errors import counted, interrupted, path_text
from mp4ds.plugins.evaluating.evaluate import EvaluateOptions, evaluate
from mp4ds.plugins.evaluating.page import findings_of
from mp4ds.plugins.evaluating.trials import Evaluation

_SPARE = (
    *("best", "PSNR Cr", "PSNR Cb", "B/frame", "harmonic", "decoded/CPU s"),
    *("CPU s", "SSIM", "5 %", "least", "time", "fps"),
)


def print_evaluation(result: Evaluation) -> None:
    """Print what was found."""
    for item in chain.from_iterable(map(findings_of, result.cameras)):
        if isinstance(item, str):
            say(item)
        else:
            print_table(item, {"stored as": "text"}, spare=_SPARE)
    for topic, reason in result.left_out.items():
        say(f"{topic}: left out: {reason}")
    if len(result.cameras) > 1:
        for best in result.recommended:
            say(f"{best.why} for all cameras: {best.options} (score at least {best.score:.2f})")
        if not result.recommended:
            say("no setting reaches every camera's target")
    known = f", {result.known} of them in an earlier run" if result.known else ""
    tried = counted(result.tried + result.known, "setting")
    say(f"{path_text(result.output)}/index.html: {tried} tried{known}")


@command()
@argument("source", "SOURCE", "A .bag, rosbag2 folder, .mcap, dataset or video.")
@output_option("DIR", "Folder for the results; default: NAME_evaluation.")
@takes(EvaluateOptions)
def evaluate_command(source: str, output: str | None, options: EvaluateOptions) -> None:
    """Compare encoder settings on clips of a recording: quality, size and time.

    Writes a folder with tables, plots and a page, and recommends options for `mp4ds pack`. To
    resume an interrupted evaluation, run the same command again.
    """
    try:
        with progress_of("evaluating") as tell:
            result = evaluate(source, options, output=output, progress=tell)
    except (KeyboardInterrupt, SystemExit) as error:
        kept = "results so far are kept: run the same command again to resume"
        raise interrupted(error, kept) from None
    show(result, print_evaluation)
