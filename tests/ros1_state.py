"""Says what a master of ROS 1 and its nodes know: for each line of input, a line of JSON.

    ros1_state.py MASTER_URI

Asks by XML-RPC as `rosnode list` and `rosnode info` do, each of which takes half a second to begin.
"""

from __future__ import annotations

import json
import socket
import sys
from typing import Any
from xmlrpc.client import Fault, ServerProxy

CALLER = "/tests"


def nodes(master: ServerProxy) -> list[str]:
    """The names of all nodes."""
    _, _, state = master.getSystemState(CALLER)  # type: ignore[misc]
    return sorted({node for kind in state for _, names in kind for node in names})


def connections(master: ServerProxy, node: str) -> list[str]:
    """The topic of each connection of a node; none if it has gone."""
    try:
        code, _, uri = master.lookupNode(CALLER, node)  # type: ignore[misc]
        found: Any = ServerProxy(str(uri)).getBusInfo(CALLER) if code == 1 else (1, "", [])
    except (OSError, Fault):
        return []
    return [one[4] for one in found[2] if len(one) < 6 or one[5]]


def main() -> None:
    socket.setdefaulttimeout(5.0)
    master = ServerProxy(sys.argv[1])
    for line in sys.stdin:
        what, *arguments = json.loads(line)
        try:
            told: Any = {"nodes": nodes, "connections": connections}[what](master, *arguments)
        except OSError:
            told = None  # no master answers
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
