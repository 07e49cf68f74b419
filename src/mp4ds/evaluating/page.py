"""An evaluation as one page that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from html import escape

from mp4ds.evaluating.plots import COSTS, SIZE, plot
from mp4ds.evaluating.results import CameraEvaluation, Cell, Evaluation
from mp4ds.video.drawing import svg_of

_STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; color: #222; margin: 2em auto; max-width: 1340px;
       padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; font-variant-numeric: tabular-nums; }
th, td { padding: 2px 9px; text-align: right; border-bottom: 1px solid #e4e4e4; }
th { border-bottom: 1px solid #888; }
td.word, th.word { text-align: left; }
tr.chosen { background: #e7f4e4; }
.plots, .pictures { display: flex; flex-wrap: wrap; gap: 12px; }
figure { margin: 0; }
figure img { display: block; image-rendering: pixelated; }
figcaption { font-size: 12px; }
code { background: #f2f2f2; padding: 1px 4px; }
"""
_CELL_HEADS = (
    *("codec", "preset", "crf", "kbit/s", "bytes/frame", "frames/s", "CPU s/frame"),
    *("decoded frames/CPU s", "VMAF", "harmonic", "5 %", "least"),
    *("PSNR Y", "PSNR Cb", "PSNR Cr", "SSIM", "whole, MB", "whole, min"),
)
_STATISTICS = ("mean", "harmonic_mean", "percentile_5", "minimum")


def page(result: Evaluation) -> str:
    """The page.

    Args:
        result: What was found; its pictures are read from its folder.

    Raises:
        OSError: A picture cannot be read.
    """
    title = escape(f"Evaluation of {result.source.name}")
    body = "\n".join([f"<h1>{title}</h1>", *_head(result), *_sections(result)])
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _head(result: Evaluation) -> Iterator[str]:
    for item in result.recommended if len(result.cameras) > 1 else ():
        yield _paragraph(f"{item.why} for all cameras", item.options, f"at least {item.score:.2f}")
    for topic, reason in result.left_out.items():
        yield f"<p>{escape(topic)} is left out: {escape(reason)}.</p>"
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    yield f"<p>Measured with {escape(versions)}.</p>"


def _paragraph(what: str, options: str, score: str) -> str:
    return f"<p>The {escape(what)}: <code>{escape(options)}</code> ({escape(score)}).</p>"


def _sections(result: Evaluation) -> Iterator[str]:
    for camera in result.cameras:
        yield f"<h2>{escape(camera.topic)}</h2>"
        yield f"<p>{escape(_facts(camera))}</p>"
        for item in camera.recommended:
            score = f"{camera.target.metric} {item.score:.2f}"
            yield _paragraph(f"{item.why} that reaches the target", item.options, score)
        yield from (f"<p>Note: {escape(note)}.</p>" for note in camera.notes)
        plots = "".join(f"<figure>{svg_of(plot(camera, kind), SIZE)}</figure>" for kind in COSTS)
        yield f'<div class="plots">{plots}</div>'
        yield _cells(camera)
        yield from _rates(camera)
        yield from _storage(camera)
        yield from _pictures(result, camera)


def _facts(camera: CameraEvaluation) -> str:
    width, height = camera.size
    rate = f"{camera.rate:.2f} Hz, " if camera.rate else ""
    ceiling = ", ".join(f"{name} {value.mean:.2f}" for name, value in camera.ceiling.items())
    return (
        f"{camera.encoding}, {width}x{height}, {rate}{camera.source_frames} images; a clip of "
        f"{camera.frames} frames from {camera.start:.2f} s on, {camera.seconds:.2f} s long. "
        f"The clip beside itself has {ceiling}: no setting has more. "
        f"The target is {camera.target.metric} {camera.reachable:.2f}."
    )


def _table(heads: Sequence[str], rows: Iterator[tuple[bool, Sequence[str]]], words: int) -> str:
    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=word' if number < words else ''}>{escape(value)}</{tag}>"
            for number, value in enumerate(values)
        )

    lines = [f"<tr>{cells('th', heads)}</tr>"]
    for is_chosen, values in rows:
        lines.append(f"<tr{' class=chosen' if is_chosen else ''}>{cells('td', values)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _cells(camera: CameraEvaluation) -> str:
    chosen = {item.setting for item in camera.recommended}
    rows = ((cell.setting in chosen, _cell(camera, cell)) for cell in camera.cells)
    return _table(_CELL_HEADS, rows, 2)


def _cell(camera: CameraEvaluation, cell: Cell) -> list[str]:
    setting = cell.setting
    return [
        *(setting.codec, setting.preset, str(setting.crf)),
        f"{cell.kbps:.1f}",
        f"{cell.frame_bytes:.0f}",
        f"{cell.encode_fps:.1f}",
        f"{cell.encode_cpu_seconds / camera.frames:.4f}",
        f"{cell.decode_fps:.0f}",
        *(_score(cell, "vmaf", statistic, 3) for statistic in _STATISTICS),
        *(_score(cell, metric, "mean", 2) for metric in ("psnr_y", "psnr_cb", "psnr_cr")),
        _score(cell, "ssim", "mean", 5),
        f"{cell.whole_bytes / 1e6:.1f}",
        f"{cell.whole_seconds / 60:.1f}",
    ]


def _score(cell: Cell, metric: str, statistic: str, digits: int) -> str:
    summary = cell.scores.get(metric)
    return "" if summary is None else f"{getattr(summary, statistic):.{digits}f}"


def _rates(camera: CameraEvaluation) -> Iterator[str]:
    if not camera.rates:
        return
    yield f"<h3>The crf that reaches {camera.target.metric} {camera.target.score:g}</h3>"
    heads = (
        *("Hz", "frames", "codec", "preset", "crf", "score", "ceiling", "bytes/frame"),
        *("s/frame", "kbit/s"),
    )
    rows = (
        (
            False,
            [
                f"{row.rate:g}",
                str(row.frames),
                row.setting.codec,
                row.setting.preset,
                str(row.setting.crf) + ("" if row.reached else " (does not reach it)"),
                f"{row.score:.3f}",
                f"{row.ceiling:.3f}",
                f"{row.frame_bytes:.0f}",
                f"{row.frame_seconds:.4f}",
                f"{row.kbps:.1f}",
            ],
        )
        for row in camera.rates
    )
    yield _table(heads, rows, 0)


def _storage(camera: CameraEvaluation) -> Iterator[str]:
    data_set = camera.data_set
    if data_set is None:
        return
    yield (
        f"<h3>{data_set.streams} cameras for {data_set.hours:g} hours "
        f"at {data_set.rate:.2f} Hz</h3>"
    )
    rows = (
        (
            row.days is not None,
            [
                row.form,
                f"{row.frame_bytes:.0f}",
                f"{row.gigabytes:.2f}",
                "" if row.days is None else f"{row.days:.3f}",
                "" if row.cpu_days is None else f"{row.cpu_days:.3f}",
            ],
        )
        for row in camera.storage
    )
    yield _table(("stored as", "bytes/frame", "GB", "days to encode", "CPU days"), rows, 1)


def _pictures(result: Evaluation, camera: CameraEvaluation) -> Iterator[str]:
    yield "<h3>The same detail of each, twice enlarged</h3>"
    shown = [("what the encoder was given", camera.ground_truth)]
    for cell in camera.cells:
        score = _score(cell, camera.target.metric, "mean", 2)
        words = f"{cell.setting.name}: {camera.target.metric} {score}, {cell.kbps:.0f} kbit/s"
        shown.append((words, cell.picture))
    figures = []
    for words, name in shown:
        data = base64.b64encode((result.output / name).read_bytes()).decode()
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{escape(words)}">'
            f"<figcaption>{escape(words)}</figcaption></figure>"
        )
    yield f'<div class="pictures">{"".join(figures)}</div>'
