"""Running tasks: threads within a process, processes on a machine, workers of a cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.engine.memory import give_back
    from mp4ds.engine.processes import ProcessEngine
    from mp4ds.engine.protocol import Engine, Outcome
    from mp4ds.engine.threads import Workers
else:
    __getattr__ = names_of(
        __name__,
        memory="give_back",
        processes="ProcessEngine",
        protocol="Engine Outcome",
        threads="Workers",
    )

__all__ = ["Engine", "Outcome", "ProcessEngine", "Workers", "give_back"]
