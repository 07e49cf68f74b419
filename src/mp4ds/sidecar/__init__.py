"""Sidecars and manifests: the models, their files, and the migration of older versions."""

from __future__ import annotations

from mp4ds.sidecar.columns import Column, Columns, Digests
from mp4ds.sidecar.fields import FORMAT_VERSION, MESSAGES_NAME, of_types
from mp4ds.sidecar.io import (
    MANIFEST_NAME,
    dump_document,
    load_document,
    load_manifest,
    load_stream,
    names_dataset,
    schema_text,
)
from mp4ds.sidecar.manifest import (
    FileEntry,
    LossEntry,
    Manifest,
    Source,
    StaticTransform,
    StreamEntry,
    TimeRange,
    Verbatim,
)
from mp4ds.sidecar.models import (
    Calibration,
    CameraInfo,
    ChannelModel,
    Color,
    Header,
    Image,
    LayoutParameters,
    PngFile,
    Roi,
    SchemaModel,
    StreamSidecar,
    Video,
)
from mp4ds.sidecar.quality import Quality
from mp4ds.sidecar.references import References

__all__ = [
    "FORMAT_VERSION",
    "MANIFEST_NAME",
    "MESSAGES_NAME",
    "Calibration",
    "CameraInfo",
    "ChannelModel",
    "Color",
    "Column",
    "Columns",
    "Digests",
    "FileEntry",
    "Header",
    "Image",
    "LayoutParameters",
    "LossEntry",
    "Manifest",
    "PngFile",
    "Quality",
    "References",
    "Roi",
    "SchemaModel",
    "Source",
    "StaticTransform",
    "StreamEntry",
    "StreamSidecar",
    "TimeRange",
    "Verbatim",
    "Video",
    "dump_document",
    "load_document",
    "load_manifest",
    "load_stream",
    "names_dataset",
    "of_types",
    "schema_text",
]
