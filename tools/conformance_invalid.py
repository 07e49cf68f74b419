"""Sidecars of the conformance suite that break a rule.

Each is a good file with one edit, and the code that a validator gives for it.
"""

from __future__ import annotations

from conformance_files import (
    Document,
    FileCase,
    both,
    column,
    not_lossless,
    plain,
    replacing,
    scored,
    setting,
    with_template,
    without,
)
from mp4ds import yamlio


def damaged(document: Document) -> bytes:
    """With a checksum of what it was before."""
    return yamlio.dump(document).replace(b"frame_id: cam", b"frame_id: cat", 1)


_NOT_A_VIDEO = "not-a-video.mp4"
INVALID: dict[str, FileCase] = {
    "video-missing": FileCase(
        "its video is not there", edit=setting("video.file", "gone.mp4"), code="file-missing"
    ),
    "video-is-none": FileCase(
        "its video is no mp4",
        edit=both(setting("video.file", _NOT_A_VIDEO), without("video.size", "video.sha256")),
        code="video-unreadable",
    ),
    "video-size": FileCase(
        "another size than the video's", edit=setting("video.size", 7), code="size-mismatch"
    ),
    "video-hash": FileCase(
        "another SHA-256 than the video's",
        edit=setting("video.sha256", "0" * 64),
        code="hash-mismatch",
    ),
    "video-codec": FileCase(
        "another codec than the video's", edit=setting("video.codec", "ffv1"), code="codec-mismatch"
    ),
    "video-geometry": FileCase(
        "another coded size than the video's",
        edit=setting("video.width", 32),
        code="geometry-mismatch",
    ),
    "video-longer": FileCase(
        "fewer frames than the video has",
        edit=both(
            not_lossless,
            setting("frames", 3),
            setting("columns", {"log_time": column(0, 1, "0*2"), "stamp": column(0, 1, "0 0")}),
        ),
        code="frame-count",
    ),
    "frames-of-nothing": FileCase(
        "more frames than the video has bytes: nothing may be allocated for them",
        edit=setting("frames", 20_000_000),
        code="frame-count",
    ),
    "digest": FileCase(
        "a digest of another message",
        edit=lambda document: document["digests"].update(
            values="0" * 16 + document["digests"]["values"][16:]
        ),
        code="digest-mismatch",
    ),
    "framing": FileCase(
        "a framing of more NAL units than the packet has",
        base="h264",
        edit=setting("headers.0.framing", "4 4 4 4 4 4 4"),
        code="decode-failed",
    ),
    "scores": FileCase(
        "scores that do not come to the mean that is told", edit=scored(42.0), code="scores-invalid"
    ),
    "references": FileCase(
        "references of more packets than the group of pictures has",
        base="h264",
        edit=setting(
            "video.references", {"structures": ["k 1 1 1 1 1 1"], "groups": column(0, 0, "")}
        ),
        code="references-invalid",
    ),
    # ------------------------------------------------------------ the YAML subset
    "yaml-anchor": FileCase(
        "an anchor",
        write=replacing(b"kind: stream", b"kind: &a stream"),
        code="yaml-invalid",
    ),
    "yaml-tag": FileCase(
        "a tag", write=replacing(b"kind: stream", b"kind: !!str stream"), code="yaml-invalid"
    ),
    "yaml-twice": FileCase(
        "a key that stands twice",
        write=replacing(b"kind: stream", b"kind: stream\nkind: stream"),
        code="yaml-invalid",
    ),
    "yaml-two-documents": FileCase(
        "two documents", write=lambda document: plain(document) + b"---\n{}\n", code="yaml-invalid"
    ),
    "yaml-latin-1": FileCase(
        "not UTF-8", write=replacing(b"kind: stream", b"kind: str\xe9am"), code="yaml-invalid"
    ),
    "yaml-deep": FileCase(
        "nesting deeper than 32",
        write=lambda document: plain(document) + b"deep: " + b"[" * 40 + b"]" * 40 + b"\n",
        code="yaml-invalid",
    ),
    "yaml-number-key": FileCase(
        "a key that is no string",
        write=lambda document: plain(document) + b"7: seven\n",
        code="yaml-invalid",
    ),
    "yaml-infinite": FileCase(
        "a float beyond a double",
        write=lambda document: plain(document) + b"much: 1e999\n",
        code="yaml-invalid",
    ),
    "yaml-list": FileCase(
        "a list at the top", write=lambda document: b"- kind: stream\n", code="yaml-invalid"
    ),
    "checksum": FileCase("edited, with its checksum left", write=damaged, code="checksum-mismatch"),
    # ------------------------------------------------------------ versions and kinds
    "version-absent": FileCase("no version", edit=without("mp4ds"), code="version-unsupported"),
    "version-number": FileCase(
        "a version without quotes",
        write=replacing(b'mp4ds: "1.1"', b"mp4ds: 1.1"),
        code="version-unsupported",
    ),
    "version-major": FileCase(
        "a newer major version", edit=setting("mp4ds", "2.0"), code="version-unsupported"
    ),
    "version-zeros": FileCase(
        "a version with a leading zero", edit=setting("mp4ds", "1.00"), code="version-unsupported"
    ),
    "version-0-incomplete": FileCase(
        "version 0 without a calibration",
        base="version-0",
        edit=without("camera_info"),
        write=plain,
        code="migration-failed",
    ),
    "version-0-unknown-key": FileCase(
        "version 0 with a key that it does not have",
        base="version-0",
        edit=setting("weather", "rain"),
        write=plain,
        code="migration-failed",
    ),
    "kind": FileCase("a kind that there is not", edit=setting("kind", "map"), code="kind-unknown"),
    "kind-dataset": FileCase(
        "a manifest where a sidecar is due", base="manifest", code="kind-unknown"
    ),
    # ------------------------------------------------------------ keys and values
    "key-missing": FileCase("no image", edit=without("image"), code="schema-invalid"),
    "key-unknown": FileCase(
        "a key that there is not", edit=setting("video.bitrate", 5), code="schema-invalid"
    ),
    "key-checksum": FileCase(
        "a checksum that is none: an unknown key",
        edit=setting("checksum", "md5:0"),
        code="schema-invalid",
    ),
    "type-string": FileCase(
        "a string where a number is due",
        edit=setting("image.width", "24"),
        code="schema-invalid",
    ),
    "type-float": FileCase(
        "a float where an integer is due", edit=setting("frames", 4.5), code="schema-invalid"
    ),
    "type-boolean": FileCase(
        "a boolean where an integer is due",
        edit=setting("image.is_bigendian", False),
        code="schema-invalid",
    ),
    "name-of-a-parent": FileCase(
        "a file name that leaves the folder",
        edit=setting("video.file", "../gray.mp4"),
        code="schema-invalid",
    ),
    "frames-none": FileCase("no frames", edit=setting("frames", 0), code="schema-invalid"),
    "profile": FileCase(
        "a profile that there is not", edit=setting("profile", "nice"), code="schema-invalid"
    ),
    "layout-unknown": FileCase(
        "a layout that there is not", edit=setting("video.layout", "gray9"), code="model-invalid"
    ),
    "layout-of-others": FileCase(
        "a layout that its encoding may not have",
        edit=setting("video.layout", "rgb24"),
        code="model-invalid",
    ),
    "layout-parameters": FileCase(
        "parameters of a layout that has none",
        edit=setting("video.parameters", {"bits": 10}),
        code="model-invalid",
    ),
    "codec-unknown": FileCase(
        "a codec that there is not", edit=setting("video.codec", "mpeg2"), code="model-invalid"
    ),
    "wire-unknown": FileCase(
        "a wire that there is not", edit=setting("wire", "cbor"), code="model-invalid"
    ),
    "encoding-unknown": FileCase(
        "an encoding that there is not",
        edit=setting("image.encoding", "mono7"),
        code="model-invalid",
    ),
    "step-short": FileCase(
        "a step shorter than a row", edit=setting("image.step", 8), code="model-invalid"
    ),
    "digests-missing": FileCase(
        "lossless without digests", edit=without("digests"), code="model-invalid"
    ),
    "picture-larger": FileCase(
        "a video smaller than its pictures",
        edit=setting("image.height", 400),
        code="model-invalid",
    ),
    "body-packet-with-format": FileCase(
        "packets with a pixel format",
        base="h264",
        edit=setting("video.pixel_format", "yuv420p"),
        code="model-invalid",
    ),
    "schema-twice": FileCase(
        "a definition as text and as base64",
        edit=setting("channel.schema.base64", "AAAA"),
        code="model-invalid",
    ),
    # ------------------------------------------------------------ columns and blanks
    "column-short": FileCase(
        "a residual too few", edit=setting("columns.stamp.values", "0 0"), code="column-invalid"
    ),
    "column-long": FileCase(
        "a run too long", edit=setting("columns.stamp.values", "0*4"), code="column-invalid"
    ),
    "column-plus": FileCase(
        "a plus sign", edit=setting("columns.stamp.values", "0 +1 0"), code="column-invalid"
    ),
    "column-tab": FileCase(
        "a tab", edit=setting("columns.stamp.values", "0\t0\t0"), code="column-invalid"
    ),
    "column-65-bits": FileCase(
        "a residual beyond 64 bits",
        edit=setting("columns.stamp.values", "0 9223372036854775808 0"),
        code="column-invalid",
    ),
    "column-count-0": FileCase(
        "a run of none", edit=setting("columns.stamp.values", "0*0 0*3"), code="column-invalid"
    ),
    "column-run-of-all": FileCase(
        "a run that would fill the memory",
        edit=setting("columns.stamp.values", "0*99999999999999"),
        code="column-invalid",
    ),
    "column-stamp": FileCase(
        "a stamp before 1970, which ros1 has no bits for",
        edit=setting("columns.stamp", column(-1, 0, "0*3")),
        code="column-invalid",
        part="messages",
    ),
    "column-variant": FileCase(
        "a variant of a header that there is not",
        edit=setting("columns.variant", column(0, 1, "0*3")),
        code="column-invalid",
    ),
    "column-ordinal": FileCase(
        "ordinals that repeat",
        edit=setting("columns.ordinal", column(0, 0, "0*3")),
        code="column-invalid",
    ),
    "digests-short": FileCase(
        "a digest too few",
        edit=lambda document: document["digests"].update(values="0123456789abcdef\n"),
        code="column-invalid",
    ),
    "camera-info-columns": FileCase(
        "calibration messages without columns",
        edit=without("camera_info.columns"),
        code="column-invalid",
    ),
    "template-of-another": FileCase(
        "a blank that says another frame_id",
        edit=both(with_template, setting("headers.0.frame_id", "cat")),
        code="header-mismatch",
    ),
    "template-cut": FileCase(
        "a blank that ends inside of a field",
        edit=setting("headers.0.template", "AAAA"),
        code="header-mismatch",
    ),
}
