"""Videos: encoding pictures, decoding them, and the table of codecs. Only here is PyAV used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.video.codecs import Recipe, check_codec, recipe_for, remade
    from mp4ds.video.decoder import VideoDecoder
    from mp4ds.video.digest import VideoDigest, digest_video, packets_in_groups
    from mp4ds.video.encoder import VideoEncoder, tool_versions
    from mp4ds.video.file import VideoFile, open_file_frames
    from mp4ds.video.hardware import HARDWARE, HardwareError, check_hardware
    from mp4ds.video.images import ImageFile
    from mp4ds.video.join import SegmentsDifferError, join_segments
    from mp4ds.video.jpeg import jpeg_pixels
    from mp4ds.video.memory import encoder_bytes
    from mp4ds.video.packets import PacketReader, PacketWriter
    from mp4ds.video.reader import FrameReader, open_frames
    from mp4ds.video.rendering import Renderer, encoding_as, shown_format
    from mp4ds.video.sample_entry import read_sample_entry
    from mp4ds.video.trial import Choice, choose
else:
    __getattr__ = names_of(
        __name__,
        codecs="Recipe check_codec recipe_for remade",
        decoder="VideoDecoder",
        digest="VideoDigest digest_video packets_in_groups",
        encoder="VideoEncoder tool_versions",
        file="VideoFile open_file_frames",
        hardware="HARDWARE HardwareError check_hardware",
        images="ImageFile",
        join="SegmentsDifferError join_segments",
        jpeg="jpeg_pixels",
        memory="encoder_bytes",
        packets="PacketReader PacketWriter",
        reader="FrameReader open_frames",
        rendering="Renderer encoding_as shown_format",
        sample_entry="read_sample_entry",
        trial="Choice choose",
    )

__all__ = [
    "HARDWARE",
    "Choice",
    "FrameReader",
    "HardwareError",
    "ImageFile",
    "PacketReader",
    "PacketWriter",
    "Recipe",
    "Renderer",
    "SegmentsDifferError",
    "VideoDecoder",
    "VideoDigest",
    "VideoEncoder",
    "VideoFile",
    "check_codec",
    "check_hardware",
    "choose",
    "digest_video",
    "encoder_bytes",
    "encoding_as",
    "join_segments",
    "jpeg_pixels",
    "open_file_frames",
    "open_frames",
    "packets_in_groups",
    "read_sample_entry",
    "recipe_for",
    "remade",
    "shown_format",
    "tool_versions",
]
