"""Sidecars and manifests: what is read, what is refused, and that both tiers agree."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from jsonschema.protocols import Validator
from jsonschema.validators import extend
from pydantic import ValidationError

from mp4ds import yamlio
from mp4ds.errors import FormatError
from mp4ds.format.fields import (
    FORMAT_VERSION,
    MAX_CAMERA_INFOS,
    MAX_FRAMES,
    document_of,
)
from mp4ds.format.manifest import Manifest
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import (
    dump_document,
    load_document,
    load_manifest,
    load_stream,
    schema_text,
)
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import LAYOUTS
from pixel_kinds import PAIRS, bound, rounded

Document = dict[str, Any]


def calibration() -> Document:
    return {
        "frame_id": "cam",
        "height": 6,
        "width": 8,
        "distortion_model": "plumb_bob",
        "d": [-0.3, 0.1, 1e-3, -2e-4, 0.0],
        "k": [5.0, 0.0, 4.0, 0.0, 5.0, 3.0, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [5.0, 0.0, 4.0, 0.0, 0.0, 5.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def channel(topic: str, type_name: str) -> Document:
    return {
        "topic": topic,
        "message_encoding": "ros1",
        "schema": {"name": type_name, "encoding": "ros1msg", "text": "uint8[] data\r\n# \u00e4\n"},
        "metadata": {"md5sum": "060021388200f6f0f447d0fcd9c64743", "latching": "0", "callerid": ""},
    }


def column(start: int = 1_700_000_000_000_000_000) -> Document:
    return {"start": start, "step": 33_333_333, "values": "0 -12\n"}


def stream() -> Document:
    """A sidecar of raw images with every key that there is."""
    columns = {
        "log_time": column(),
        "publish_time": column(5),
        "sequence": column(0),
        "stamp": column(),
        "seq": {"start": 7, "step": 1, "values": "0*2\n"},
        "variant": {"start": 0, "step": 0, "values": "0*2\n"},
        "ordinal": {"start": 0, "step": 1, "values": "0*2\n"},
    }
    return {
        "mp4ds": FORMAT_VERSION,
        "kind": "stream",
        "profile": "lossless",
        "stamps": "record-float",
        "frames": 3,
        "channel": channel("/cam/image_raw", "sensor_msgs/Image"),
        "wire": "ros1",
        "image": {"encoding": "rgb8", "width": 8, "height": 6, "step": 24, "is_bigendian": 0},
        "headers": [{"frame_id": "cam", "template": "AAAA", "padding": "eJwDAAAAAAE="}],
        "video": {
            "file": "cam_image_raw.mp4",
            "layout": "rgb24",
            "codec": "h264",
            "pixel_format": "rgb24",
            "width": 8,
            "height": 6,
            "color": {
                "primaries": "bt709",
                "transfer": "bt709",
                "matrix": "gbr",
                "range": "full",
            },
            "encoder": "libx264rgb",
            "options": {"qp": "0"},
            "size": 1000,
            "sha256": "0" * 64,
        },
        "camera_info": {
            "channel": channel("/cam/camera_info", "sensor_msgs/CameraInfo"),
            "wire": "ros1",
            "messages": 3,
            "calibrations": [
                {
                    **calibration(),
                    "binning_x": 1,
                    "binning_y": 2,
                    "roi": {"x_offset": 1, "y_offset": 2, "height": 3, "width": 4, "do_rectify": 1},
                    "template": "AAAA",
                }
            ],
            "columns": {"log_time": column(), "stamp": column()},
        },
        "columns": columns,
        "digests": {"algorithm": "xxh64", "values": "0123456789abcdef " * 2 + "0123456789abcdef\n"},
    }


def packet() -> Document:
    """A sidecar of video packets."""
    document = stream()
    document["channel"] = channel(
        "/cam/image_raw/ffmpeg", "ffmpeg_image_transport_msgs/FFMPEGPacket"
    )
    document["body"] = "packet"
    document["headers"] = [
        {"frame_id": "cam", "format": "libx264", "template": "AAAA", "framing": "4 4 3 +2"},
        {"frame_id": "cam", "format": "libx264", "template": "AAAA", "framing": "4"},
    ]
    kept = ("file", "layout", "codec", "width", "height", "size", "sha256")
    document["video"] = {key: document["video"][key] for key in kept}
    document["video"]["references"] = {"structures": ["k 1 2", "k"], "groups": column()}
    document["columns"]["pts"] = {"start": 0, "step": 3003, "values": "0 -1\n"}
    return document


def seen() -> Document:
    """A sidecar of images that a view predicts."""
    document = stream()
    document["view"] = document["video"]
    document["view"] |= {"codec": "av1", "pixel_format": "yuv420p", "options": {"crf": "18"}}
    document["view"]["color"]["matrix"] = "bt709"
    document["view"]["references"] = {"structures": ["k 1 2", "k"], "groups": column()}
    kept = ("layout", "codec", "pixel_format", "width", "height", "size", "sha256")
    document["video"] = {key: stream()["video"][key] for key in kept}
    document["video"]["file"] = "cam_image_raw.exact.mp4"
    return document


def png() -> Document:
    """A sidecar of depth images in PNG files."""
    document = stream()
    document["channel"] = channel("/cam/compressedDepth", "sensor_msgs/CompressedImage")
    document["body"] = "png"
    document["image"] |= {"encoding": "16UC1", "step": 16}
    document["headers"] = [
        {
            "frame_id": "cam",
            "format": "16UC1; compressedDepth png",
            "prefix": "000000000000a07f34120080",
            "png": {
                "filters": "sub",
                "level": 1,
                "strategy": 3,
                "memory_level": 8,
                "window_bits": 15,
                "zlib_header": "7801",
                "chunk_bytes": 8192,
                "deflate": "c1f62ae5",
                "before": "AAAA",
                "after": "AAAA",
            },
        }
    ]
    document["video"] |= {
        "layout": "gray_bits",
        "parameters": {"bits": 12, "shift": 4},
        "codec": "ffv1",
        "pixel_format": "gray12le",
    }
    del document["video"]["color"]
    return document


def scored() -> Document:
    """A sidecar of a video that keeps a score."""
    document = stream()
    del document["digests"]
    document["profile"] = "vmaf=99.5"
    document["video"]["quality"] = {
        "metric": "vmaf",
        "target": 99.5,
        "mean": 99.53,
        "p5": 99.503,
        "min": 99.5,
        "worst_window": 99.5,
        "windows": 2,
        "reencoded": 1,
        "limited": 1,
        "scores": {"start": 9950, "step": 3, "values": "0*2\n"},
    }
    return document


def dataset() -> Document:
    """A manifest with every key that there is."""
    return {
        "mp4ds": FORMAT_VERSION,
        "kind": "dataset",
        "profile": "crf=22",
        "format": "bag",
        "recording_profile": "ros1",
        "library": "a recorder",
        "sources": [
            {
                "name": "drive.bag",
                "size": 5,
                "sha256": "a" * 64,
                "excerpt": {"start": 1, "end": 2},
            }
        ],
        "about": {
            "title": "Two cameras",
            "description": "In a workshop.\nBy hand.",
            "authors": [
                {"name": "A lab", "affiliation": "A school", "orcid": "0000-0000-0000-000X"}
            ],
            "license": "CC-BY-4.0",
            "doi": "10.5281/zenodo.1",
            "links": ["https://example.org/drive"],
            "keywords": ["stereo"],
        },
        "derived_from": [{"name": "first", "profile": "visual", "sha256": "b" * 64}],
        "reductions": [
            {
                "crop": [0, 4, 60, 40],
                "factor": 0.5,
                "size": [30, 20],
                "nearest": ["/masks/*"],
                "every": 2,
                "max_rate": 10.5,
                "images": [
                    {
                        "topic": "/cam/image_raw",
                        "type": "sensor_msgs/Image",
                        "encoding": "bayer_rggb8",
                        "width": 64,
                        "height": 48,
                    }
                ],
            }
        ],
        "redactions": [
            {
                "rules_sha256": "c" * 64,
                "rules_text": "rules: []",
                "function": "faces:find",
                "rules": [2],
                "topics": [
                    {
                        "topic": "/cam/image_raw",
                        "type": "sensor_msgs/Image",
                        "images": 3,
                        "changed": 2,
                        "untouched": {"values": f"3 40 {'d' * 64}\n"},
                    }
                ],
            }
        ],
        "messages": 9,
        "losses": [
            {
                "file": "drive.bag",
                "offset": 4109,
                "size": 768000,
                "problem": "the bz2 data of a chunk is damaged",
                "messages": 25,
                "topics": ["/cam/image_raw", "/imu"],
                "start": -5,
                "end": 2**64 - 1,
            }
        ],
        "topics_left_out": ["/other"],
        "time_range": {"start": -5, "end": 2**64 - 1},
        "streams": [
            {
                "topic": "/cam/image_raw",
                "sidecar": "c.yaml",
                "video": "c.exact.mp4",
                "view": "c.mp4",
                "frames": 3,
            }
        ],
        "transforms": [
            {
                "parent": "base_link",
                "child": "cam",
                "translation": [0.1, -0.0, 1.5],
                "rotation": [0.5, -0.5, 0.5, -0.5],
            }
        ],
        "verbatim": [{"topic": "/cam/image_raw", "messages": 1, "first": 0, "reason": "odd"}],
        "files": [{"name": "messages.mcap", "size": 0, "sha256": "b" * 64}],
        "tools": {"mp4ds": "0.1.0"},
    }


WHOLE: dict[str, Callable[[], Document]] = {
    "stream": stream,
    "packet": packet,
    "seen": seen,
    "png": png,
    "scored": scored,
    "dataset": dataset,
}
KINDS = ("stream", "dataset")


def schema_of(name: str) -> Document:
    """The schema of the document of that name."""
    found: Document = json.loads(schema_text(WHOLE[name]()["kind"]))
    return found


def write(folder: Path, document: Document) -> Path:
    path = folder / "some.yaml"
    path.write_bytes(yamlio.dump(document))
    return path


def load(path: Path, kind: str) -> StreamSidecar | Manifest:
    return load_manifest(path) if kind == "dataset" else load_stream(path)


def edited(document: Document, path: str, value: Any) -> Document:
    """One with another value at a dotted path, and the same others; ``...`` removes the key."""
    key, _, rest = path.partition(".")
    copied = copy.copy(document)
    place: Any = int(key) if isinstance(copied, list) else key
    if rest:
        value = edited(copied[place], rest, value)
    if value is ...:
        del copied[place]
    else:
        copied[place] = value
    return copied


# ---------------------------------------------------------------- round trip


@pytest.mark.parametrize("kind", WHOLE)
def test_a_file_with_every_key_returns(kind: str, tmp_path: Path) -> None:
    document = WHOLE[kind]()
    model = load(write(tmp_path, document), kind)
    assert document_of(model) == document
    (tmp_path / "again.yaml").write_bytes(dump_document(model))
    assert load(tmp_path / "again.yaml", kind) == model
    assert load_document(tmp_path / "again.yaml") == document
    assert (tmp_path / "again.yaml").read_text().startswith("# ")


@pytest.mark.parametrize("kind", KINDS)
def test_the_fixtures_have_every_key(kind: str) -> None:
    """So that a new key is not forgotten in these tests."""
    schema = json.loads(schema_text(kind))

    def missing(node: Any, rules: dict[str, Any], place: str) -> list[str]:
        rules = next((rule for rule in rules.get("anyOf", []) if rule.get("type") != "null"), rules)
        if "$ref" in rules:
            rules = schema["$defs"][rules["$ref"].rpartition("/")[2]]
        if isinstance(node, list):
            return [m for item in node for m in missing(item, rules.get("items", {}), place + "[]")]
        if not isinstance(node, dict):
            return []
        found = [f"{place}.{key}" for key in rules.get("properties", {}) if key not in node]
        for key, child in node.items():
            found += missing(child, rules.get("properties", {}).get(key, {}), f"{place}.{key}")
        return found

    # a camera_info has the columns of a stream, a schema has one of two, and which parameters
    # there are is each layout's own matter: tested below; a case of the suite has `predicted`
    allowed = ("camera_info.columns.", "schema.base64", "video.parameters.", "stream.predicted")
    documents = [make() for make in WHOLE.values() if make()["kind"] == kind]
    found = set.intersection(*(set(missing(document, schema, kind)) for document in documents))
    assert [place for place in found if not any(part in place for part in allowed)] == []


PARAMETERS = [(encoding, layout) for encoding, layout in PAIRS if LAYOUTS[layout].parameters]


@pytest.mark.parametrize(("encoding", "layout"), PARAMETERS)
def test_all_parameters_of_layouts_return(encoding: str, layout: str, tmp_path: Path) -> None:
    size = rounded(ENCODINGS[encoding], 8, 6)
    values = bound(layout, ENCODINGS[encoding], *size).parameters.values
    assert set(values) == LAYOUTS[layout].parameters
    document = png()
    del document["body"]
    document["headers"] = [{"frame_id": "cam"}]
    step = size[0] * ENCODINGS[encoding].pixel_bytes
    document["image"] |= {"encoding": encoding, "step": step}
    document["video"] |= {"layout": layout, "parameters": values, "width": 99, "height": 999}
    path = write(tmp_path, document)
    read = load_stream(path)
    assert document_of(read) == document
    assert read.layout.parameters.values == values
    assert Draft202012Validator(json.loads(schema_text("stream"))).is_valid(document)
    for name in values:
        with pytest.raises(FormatError, match=name):
            load_stream(write(tmp_path, edited(document, f"video.parameters.{name}", ...)))


@pytest.mark.parametrize("kind", WHOLE)
def test_optional_keys_may_be_absent(kind: str, tmp_path: Path) -> None:
    validator, whole = Draft202012Validator(schema_of(kind)), WHOLE[kind]()
    assert list(validator.iter_errors(whole)) == []
    for key in whole:
        if key in schema_of(kind)["required"]:
            continue
        document = edited(whole, key, ...)
        assert validator.is_valid(document)
        if key == "digests":
            document["profile"] = "visual"
            document.pop("view", None)
        if key != "body":  # what belongs to PNG files, or to packets, then has no place
            assert document_of(load(write(tmp_path, document), kind)) == document


# ---------------------------------------------------------------- what is refused

BAD_NAMES = ["", ".", "..", "../x.mp4", "/etc/passwd", "a/b.mp4", "a\\b.mp4", "C:x", ".hidden",
             "a\0b", "a\n", "a b", "\u00e4.mp4", "-x.mp4", "_x", "x" * 129, "\uff0e\uff0e/x.mp4",
             "\u2024\u2024", "x\u200b.mp4", "x\u202e4pm.", "%00d.mp4", "http:x.mp4", 5, None,
             ["a"]]  # fmt: skip
PNG = png()["headers"][0]["png"]
ODD: list[Any] = [
    *(..., None, True, -1, 0, 10, 17, 101, 257, 16387, 2**32, 2**63, 2**64, -(2**63) - 1, 2**70),
    *(1.5, "8", "0" * 63, "G" * 64, "A" * 5000, "AA=A", "00\n", "crf=100", "vmaf=99.12345"),
    *("k 01", "k +1", "k 1234567", "4-4", "\u0664", *BAD_NAMES),
    *([], {}, [None], [5], ["0"] * 9, [0.0] * 8, [{}]),
]  # fmt: skip
"""What may be put in any place of a document."""

# What must be refused, whatever the schemas say: kind -> dotted places -> values.
SHAPES: dict[str, dict[str, list[Any]]] = {
    "stream": {
        "frames": [0, MAX_FRAMES + 1, "3", True, None, ...],
        "video.file": BAD_NAMES,
        "image.width image.height": [0, -1, 16385, 2**70, 1.0, "8", True, None],
        "headers": [[], [{"frame_id": "cam"}] * 257],
        "camera_info.messages": [-1, MAX_CAMERA_INFOS + 1],
        "columns.stamp.start": [2**63, -(2**63) - 1, 0.0, "0", None, ...],
        "surprise columns.stamp.surprise camera_info.calibrations.0.roi.surprise": [1],
    },
    "packet": {"video.references.structures": [[], "k", ["k"] * 257, None, ...]},
    "seen": {"view.file": BAD_NAMES, "view.surprise": [1], "view.layout": [None, 5, ...]},
    "scored": {"video.quality.surprise": [1]},
    "png": {"headers.0.png.window_bits": [8, 16, -15, 31, None, ...]},
    "dataset": {
        "streams.0.sidecar streams.0.video files.0.name": BAD_NAMES,
        "losses.0.topics": [["/t"] * 65],
    },
}


# Rules over several keys, or over what the names mean: for the model alone.
RULES: dict[str, dict[str, list[Any]]] = {
    "stream": {
        "wire": ["cdr", ""],
        "image.step": [23, 4121],
        "image.encoding": ["rgba8", "", "RGB8", "mono16"],
        "video.layout": ["gray8", "bgr24", "", "nv12"],
        "video.width": [7],
        "video.height": [5],
        "channel.schema.text digests": [...],
        "channel.schema.base64": ["AAAA"],
        "camera_info.wire": ["xcdr2"],
    },
    "packet": {
        "headers.0.png": [PNG],
        "video.codec": ["hevc", "png", "H264", "", "ffv1"],
        "video.pixel_format": ["yuvj420p", "", "gray"],
        "body": ["pixels", "png", "rvl", "jpeg", ...],
        "video.parameters": [{"bits": 12, "shift": 0}],
    },
    "seen": {
        "profile": ["visual", "crf=22"],
        "body": ["rvl", "jpeg"],
        "image.encoding": ["mono8", "bayer_rggb8"],
        "video.file": ["cam_image_raw.mp4", "cam.exact.mp4", "cam_image_raw.exact.MP4"],
        "video.color": [stream()["video"]["color"]],
        "view.file": ["cam.mp4", "cam_image_raw", "cam_image_raw.MP4", "cam_image_raw.exact.mp4"],
        "view.layout": ["bgr24", "gray8", "demosaic8", ""],
        "view.codec": ["vp9", "mjpeg", "ffv1", ""],
        "view.pixel_format": ["yuv444p", "yuvj420p", "gray", "rgb24", ...],
        "view.width": [7],
        "view.height": [5],
        "view.color": [...],
        "view.color.matrix": ["gbr", "bt2020nc", ""],
        "view.quality": [scored()["video"]["quality"]],
    },
    "scored": {
        "profile": ["lossless", "visual", "vmaf=99", "psnr=99.5"],
        "video.quality.metric": ["psnr"],
        "video.quality.reencoded video.quality.limited": [3],
    },
    "png": {
        "body": [..., "pixels", "packet", "rvl", "jpeg"],
        "headers.0.png video.pixel_format": [...],
        "image.encoding": ["32FC1", "rgb8", "mono8"],
        "video.layout": ["mosaic_bits", "gbr_bits", "gray8", "metres16"],
        "video.parameters": [{}, {"bits": 12}, {"table": [1]}, ...],
        "video.parameters.bits": [1, 9, 11, 13, 15, ...],
        "video.parameters.shift": [5, ...],
        "video.parameters.table": [[], [0], [*range(99)]],
        "video.parameters.hole": [0],
        "video.parameters.scale": ["product", ""],
    },
}  # fmt: skip


def listed(table: dict[str, dict[str, list[Any]]], kind: str) -> Iterator[tuple[str, Any]]:
    """Each place and value of a table for a kind of document."""
    for places, values in table.get(kind, {}).items():
        yield from itertools.product(places.split(), values)


@pytest.mark.parametrize("kind", SHAPES)
def test_refused_with_its_place(kind: str, tmp_path: Path) -> None:
    for place, value in itertools.chain(listed(SHAPES, kind), listed(RULES, kind)):
        path = write(tmp_path, edited(WHOLE[kind](), place, value))
        with pytest.raises(FormatError) as caught:
            load(path, kind)
        assert caught.value.code in ("model-invalid", "kind-unknown")
        assert caught.value.place.startswith(str(path))
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 600 + len(str(path))


def places(node: Any, above: str = "") -> Iterator[str]:
    """The dotted place of everything in a document, and of a surprise in each mapping."""
    if isinstance(node, (dict, list)):
        names = [*node, "surprise"] if isinstance(node, dict) else range(len(node))
        for name in names:
            yield f"{above}{name}"
            if name != "surprise":
                yield from places(node[name], f"{above}{name}.")


def takes(kind: str, document: Document) -> bool:
    """Whether the model of a kind takes a document."""
    try:
        (Manifest if kind == "dataset" else StreamSidecar).model_validate(document)
    except ValidationError:
        return False
    return True


def remembering(kind: str, whole: Document) -> Validator:
    """A validator that passes over what documents have in common with a valid one."""
    known: set[tuple[int, int]] = set()

    def once(check: Callable[..., Iterator[Any]]) -> Callable[..., Iterator[Any]]:
        def errors(validator: Validator, value: Any, node: Any, schema: Any) -> Iterator[Any]:
            if (id(value), id(node)) not in known:
                found = [*check(validator, value, node, schema)]
                if is_first and not found:
                    known.add((id(value), id(node)))
                yield from found

        return errors

    checks = {name: once(Draft202012Validator.VALIDATORS[name]) for name in ("$ref", "properties")}
    validator: Validator = extend(Draft202012Validator, checks)(schema_of(kind))  # type: ignore[no-untyped-call]
    is_first = True
    assert validator.is_valid(whole)
    is_first = False
    return validator


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", WHOLE)
def test_the_model_takes_nothing_that_the_released_schema_refuses(kind: str) -> None:
    whole = WHOLE[kind]()
    validator = remembering(kind, whole)
    for place in places(whole):
        is_new = place.endswith("surprise")
        for value in [1] if is_new else ODD:
            document = edited(whole, place, value)
            if takes(kind, document):
                # the schema has no null where the model has it for "absent"
                assert value is None or validator.is_valid(document), (place, value)


@pytest.mark.parametrize("kind", SHAPES)
def test_the_released_schema_refuses_it_too(kind: str) -> None:
    validator = Draft202012Validator(schema_of(kind))
    for place, value in listed(SHAPES, kind):
        # JSON Schema takes 1.0 for an integer, and null where the model has it for "absent"
        if value is None or isinstance(value, float):
            continue
        if isinstance(value, str) and value.endswith("\n"):
            continue  # `$` matches before a last line feed in Python's patterns
        assert not validator.is_valid(edited(WHOLE[kind](), place, value)), (place, value)
    for place, value in listed(RULES, kind):
        assert validator.is_valid(edited(WHOLE[kind](), place, value)), (place, value)


# ---------------------------------------------------------------- versions and files


@pytest.mark.parametrize("kind", WHOLE)
def test_a_newer_minor_version_is_read_with_a_warning(kind: str, tmp_path: Path) -> None:
    document = edited(WHOLE[kind](), "mp4ds", "2.7")
    document["surprise"] = {"a": [1]}
    first = "streams.0.new" if kind == "dataset" else "camera_info.calibrations.0.new"
    path = write(tmp_path, edited(document, first, "news"))
    with pytest.warns(UserWarning, match="2.7") as caught:
        model = load(path, kind)
    assert "surprise" in str(caught[0].message)
    assert first in str(caught[0].message)
    assert document_of(model) == edited(WHOLE[kind](), "mp4ds", "2.7")
    # what this version knows is read as strictly
    with pytest.warns(UserWarning, match="2.7"), pytest.raises(FormatError):
        load(write(tmp_path, edited(document, "profile", "best")), kind)
