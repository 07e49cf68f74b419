"""The YAML subset of the format with its checksum, and its JSON Schemas; of spec/ alone.

A part of the second reader, reader.py.
"""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import yaml

M64 = 2**64 - 1
KNOWN = ("1.0", "1.1")
SCHEMAS = Path(__file__).resolve().parents[1] / "schemas"


class RefusedError(Exception):
    """A file that a reader must not read: code and file."""


class Loader(yaml.SafeLoader):
    """The subset: its own plain scalars, no anchors, aliases and tags, no key twice."""

    yaml_implicit_resolvers = {}  # noqa: RUF012 - as PyYAML has it

    def compose_node(self, parent, index):
        """A node, whose like may be refused."""
        event = self.peek_event()
        if getattr(event, "anchor", None) or getattr(event, "tag", None):
            raise yaml.YAMLError("anchors, aliases and tags are refused")
        is_open = isinstance(event, yaml.CollectionStartEvent)
        self.depth = getattr(self, "depth", 0) + is_open
        if self.depth > 32:
            raise yaml.YAMLError("nested too deeply")
        node = super().compose_node(parent, index)
        self.depth -= is_open
        return node

    def construct_mapping(self, node, deep=False):
        """A map with keys that are strings, each once."""
        keys = [key.value for key, _ in node.value]
        if len(set(keys)) < len(keys) or any(not key.tag.endswith(":str") for key, _ in node.value):
            raise yaml.YAMLError("a key stands twice or is not a string")
        return {key.value: self.construct_object(value, deep=True) for key, value in node.value}


def construct_float(loader, node):
    """A float that is finite as a double."""
    value = float(node.value)
    if value - value:
        raise yaml.YAMLError("a float beyond a double")
    return value


INTEGER = r"[-+]?(0|[1-9][0-9]*)"
for kind, pattern in (
    ("null", r"|null|~"),
    ("bool", r"true|false"),
    ("int", INTEGER),
    ("float", INTEGER + r"(\.[0-9]+)?([eE][-+]?[0-9]+)?"),
):
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{kind}", re.compile(f"^({pattern})$"), None)
Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
Loader.add_constructor("tag:yaml.org,2002:float", construct_float)
Loader.add_constructor("tag:yaml.org,2002:map", Loader.construct_mapping)


def xxh64(data):
    """XXH64 with seed 0, as 16 hexadecimal digits."""
    p = (11400714785074694791, 14029467366897019727, 1609587929392839161)
    p4, p5, at = 9650029242287828579, 2870177450012600261, 0

    def left(value, bits):
        return (value << bits | value >> 64 - bits) & M64

    def turn(total, lane):
        return left((total + lane * p[1]) & M64, 31) * p[0] & M64

    if len(data) >= 32:
        lanes = [(p[0] + p[1]) & M64, p[1], 0, -p[0] & M64]
        while at + 32 <= len(data):
            words = struct.unpack_from("<4Q", data, at)
            lanes = [turn(lane, word) for lane, word in zip(lanes, words, strict=True)]
            at += 32
        total = (
            sum(left(lane, bits) for lane, bits in zip(lanes, (1, 7, 12, 18), strict=True)) & M64
        )
        for lane in lanes:
            total = ((total ^ turn(0, lane)) * p[0] + p4) & M64
    else:
        total = p5
    total = (total + len(data)) & M64
    while at + 8 <= len(data):
        total ^= turn(0, struct.unpack_from("<Q", data, at)[0])
        total, at = (left(total, 27) * p[0] + p4) & M64, at + 8
    if at + 4 <= len(data):
        total ^= struct.unpack_from("<I", data, at)[0] * p[0] & M64
        total, at = (left(total, 23) * p[1] + p[2]) & M64, at + 4
    for byte in data[at:]:
        total = left(total ^ byte * p5 & M64, 11) * p[0] & M64
    total = (total ^ total >> 33) * p[1] & M64
    total = (total ^ total >> 29) * p[2] & M64
    return f"{total ^ total >> 32:016x}"


def load(path, kind):
    """The document of a sidecar or manifest that its schema allows."""
    data = path.read_bytes()
    if found := re.search(rb'(?:^|\n)checksum: "xxh64:([0-9a-f]{16})"\n$', data):
        data = data[: found.start(1) - len('checksum: "xxh64:')]
        if xxh64(data) != found[1].decode():
            raise RefusedError("checksum-mismatch", path)
    try:
        document = yaml.load(data.decode(), Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise RefusedError("yaml-invalid", path) from error
    if not isinstance(document, dict):
        raise RefusedError("yaml-invalid", path)
    version = document.get("mp4ds")
    if not isinstance(version, str) or not re.fullmatch(r"1\.(0|[1-9]\d*)", version):
        raise RefusedError("version-unsupported", path)
    if document.get("kind") != kind:
        raise RefusedError("kind-unknown", path)
    newer = version not in KNOWN
    schema = json.loads(
        (SCHEMAS / f"v{KNOWN[-1] if newer else version}" / f"{kind}.schema.json").read_text()
    )
    if not fits(document, schema, schema.get("$defs", {}), newer=newer):
        raise RefusedError("schema-invalid", path)
    return without_nulls(document)


def without_nulls(value):
    """A document in which keys that are null are absent, which means the same."""
    if isinstance(value, dict):
        return {key: without_nulls(item) for key, item in value.items() if item is not None}
    return [without_nulls(item) for item in value] if isinstance(value, list) else value


TYPES = {"string": str, "integer": int, "number": (int, float), "array": list, "object": dict}


def fits(value, schema, names, *, newer):
    """Whether a value is what a schema allows; of a newer version, keys may be unknown."""
    if "$ref" in schema:
        return fits(value, names[schema["$ref"].rpartition("/")[2]], names, newer=newer)
    if "anyOf" in schema:
        return any(fits(value, one, names, newer=newer) for one in schema["anyOf"])
    kind = schema.get("type")
    if kind == "null":
        return value is None
    if isinstance(value, bool) or not isinstance(value, TYPES.get(kind, object)):
        return kind == "boolean" and isinstance(value, bool)
    if value != schema.get("const", value) or value not in schema.get("enum", [value]):
        return False
    if isinstance(value, str):
        pattern = schema.get("pattern", "^").replace("$", r"\Z")
        return len(value) <= schema.get("maxLength", len(value)) and re.search(pattern, value)
    if isinstance(value, (int, float)):
        return schema.get("minimum", value) <= value <= schema.get("maximum", value)
    if isinstance(value, list):
        most = schema.get("maxItems", len(value))
        return schema.get("minItems", 0) <= len(value) <= most and all(
            fits(item, schema.get("items", {}), names, newer=newer) for item in value
        )
    if isinstance(value, dict):
        known, more = schema.get("properties", {}), schema.get("additionalProperties", {})
        return set(schema.get("required", ())) <= set(value) and all(
            fits(item, known[key], names, newer=newer)
            if key in known
            else newer
            or more is True
            or (more is not False and fits(item, more, names, newer=newer))
            for key, item in value.items()
        )
    return True
