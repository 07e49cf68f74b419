"""Files that a divided pack keeps for its own use: JSON with a checksum, so that rot is noticed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import xxhash

_MARK = b',\n"xxh64": "'
_END = b'"}\n'


def dump_kept(values: Mapping[str, Any]) -> bytes:
    """The file of values.

    Args:
        values: At least one; such as JSON has.
    """
    text = json.dumps(values, indent=1).encode().removesuffix(b"}").rstrip()
    return text + _MARK + xxhash.xxh64_hexdigest(text).encode() + _END


def load_kept(data: bytes) -> dict[str, Any]:
    """The values of a file that `dump_kept` made.

    Raises:
        ValueError: It is damaged, or another version's.
    """
    text, mark, rest = data.rpartition(_MARK)
    if not mark or rest != xxhash.xxh64_hexdigest(text).encode() + _END:
        raise ValueError("which is damaged, or another version's")
    try:
        values: dict[str, Any] = json.loads(text + b"}")
    except RecursionError:
        raise ValueError("which is damaged") from None
    return values
