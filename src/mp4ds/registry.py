"""The table by which the core finds its plugins without importing them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PLUGINS = {
    "images": "importing.layouts:open_images",
    "cluster": "cluster:ClusterExecutor",
}
"""What the core asks for -> module of `mp4ds.plugins`, and its name there."""


def plugin(name: str) -> Any:
    """What a plugin offers to the core, by one of the names above."""
    module, _, found = _PLUGINS[name].partition(":")
    return getattr(import_module(f"mp4ds.plugins.{module}"), found)
