"""Packages whose modules are imported when one of their names is asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module

TYPE_CHECKING = False  # without typing, whose import costs more than all of this
if TYPE_CHECKING:
    from typing import Any


def names_of(package: str, **homes: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package.

    Args:
        package: Its full name.
        homes: By module, the public names that it has, with spaces between.
    """
    modules = {name: module for module, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{modules[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return get
