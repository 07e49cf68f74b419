"""Running tasks: threads within a process, processes on a machine, workers of a cluster."""

from __future__ import annotations

from mp4ds.engine.memory import give_back
from mp4ds.engine.processes import ProcessEngine
from mp4ds.engine.protocol import Engine, Outcome
from mp4ds.engine.threads import Workers

__all__ = ["Engine", "Outcome", "ProcessEngine", "Workers", "give_back"]
