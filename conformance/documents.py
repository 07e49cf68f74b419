"""Sidecars and manifests of the format: YAML subset, checksum, JSON Schemas, columns.

A part of the second reader, reader.py.
"""

from __future__ import annotations

import json
import re
from functools import cache
from itertools import pairwise
from pathlib import Path

import jsonschema
import xxhash
import yaml

KNOWN = ("1.0", "1.1", "2.0")
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


def load(path, kind):
    """The document of a sidecar or manifest that its schema allows."""
    data = path.read_bytes()
    if found := re.search(rb'(?:^|\n)checksum: "xxh64:([0-9a-f]{16})"\n$', data):
        data = data[: found.start(1) - len('checksum: "xxh64:')]
        if xxhash.xxh64_hexdigest(data) != found[1].decode():
            raise RefusedError("checksum-mismatch", path)
    try:
        document = yaml.load(data.decode(), Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise RefusedError("yaml-invalid", path) from error
    if not isinstance(document, dict):
        raise RefusedError("yaml-invalid", path)
    version = document.get("mp4ds")
    if version not in KNOWN and not re.fullmatch(r"2\.[1-9]\d*", str(version)):
        raise RefusedError("version-unsupported", path)
    if document.get("kind") != kind:
        raise RefusedError("kind-unknown", path)
    if not schema(kind, version).is_valid(document):
        is_newer = version in KNOWN[:-1] and schema(kind, KNOWN[-1]).is_valid(document)
        raise RefusedError("migration-failed" if is_newer else "schema-invalid", path)
    return without_nulls(document)


# to a JSON Schema 1.0 is an integer; in YAML it is not
STRICT = jsonschema.validators.extend(
    jsonschema.Draft202012Validator,
    type_checker=jsonschema.Draft202012Validator.TYPE_CHECKER.redefine(
        "integer", lambda _, value: isinstance(value, int) and not isinstance(value, bool)
    ),
)


@cache
def schema(kind, version):
    """What a document of a kind may be; of a newer version, keys may be unknown."""
    newer = version not in KNOWN

    def read(part):
        if "pattern" in part:  # Python's $ also matches before a last line break
            part["pattern"] = str(part["pattern"]).replace("$", r"\Z")
        if newer and part.get("additionalProperties") is False:
            del part["additionalProperties"]
        return part

    path = SCHEMAS / f"v{KNOWN[-1] if newer else version}" / f"{kind}.schema.json"
    return STRICT(json.loads(path.read_text(), object_hook=read))


def without_nulls(value):
    """A document in which keys that are null are absent, which means the same."""
    if isinstance(value, dict):
        return {key: without_nulls(item) for key, item in value.items() if item is not None}
    return [without_nulls(item) for item in value] if isinstance(value, list) else value


# ---------------------------------------------------------------- columns


def column(path, values, count):
    """The values of a column."""
    numbers = [values["start"]]
    for token in re.split("[ \n]+", values["values"].strip(" \n")):
        found = re.fullmatch(r"(-?[0-9]+)(?:\*([0-9]+))?", token)
        if not found and token:
            raise RefusedError("column-invalid", path)
        residual, times = (int(found[1]), int(found[2] or 1)) if found else (0, 0)
        if (found and not times) or not -(2**63) <= residual < 2**63:
            raise RefusedError("column-invalid", path)
        if len(numbers) + times > count:
            raise RefusedError("column-invalid", path)
        for _ in range(times):
            total = numbers[-1] + values["step"] + residual
            numbers.append((total + 2**63) % 2**64 - 2**63)
    if len(numbers) != count:
        raise RefusedError("column-invalid", path)
    return numbers


def columns(path, listed, count, variants):
    """All columns, the absent ones with their defaults."""
    found = {name: column(path, values, count) for name, values in listed.items()}
    zeros = [0] * count
    found = {
        "log_time": found["log_time"],
        "publish_time": found.get("publish_time", found["log_time"]),
        "sequence": found.get("sequence", zeros),
        "stamp": found["stamp"],
        "seq": found.get("seq", zeros),
        "pts": found.get("pts", zeros),
        "variant": found.get("variant", zeros),
        "ordinal": found.get("ordinal", list(range(count))),
    }
    later = pairwise(found["ordinal"])
    if not all(0 <= number < variants for number in found["variant"]) or any(
        a >= b for a, b in later
    ):
        raise RefusedError("column-invalid", path)
    return found
