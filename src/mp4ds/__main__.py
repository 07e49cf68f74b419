"""``python -m mp4ds``."""

from __future__ import annotations

from mp4ds.cli import main

main()
