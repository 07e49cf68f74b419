"""Enters a domain of DDS as a node of ROS 2 would."""

from __future__ import annotations

import os
from typing import Any

from mp4ds.errors import OptionError, PublishError

_LAST = 232
_LOCAL = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)


def domain_id(asked: int | None) -> int:
    """The domain that was asked for, else that of ROS_DOMAIN_ID, else 0.

    Raises:
        OptionError: There is no such domain.
    """
    told = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if asked is None and not told:
        return 0
    text = told if asked is None else str(asked)
    where = "ROS_DOMAIN_ID" if asked is None else "The domain"
    if not text.isascii() or not text.isdigit() or len(text) > 9 or int(text) > _LAST:
        raise OptionError(f"{where} is {text!r}, and DDS has domains 0 to {_LAST}.")
    return int(text)


def open_participant(domain: int) -> Any:
    """A participant of a domain, configured by CYCLONEDDS_URI.

    Discovery is kept to this machine where ROS_LOCALHOST_ONLY or ROS_AUTOMATIC_DISCOVERY_RANGE
    say so, as ROS 2 does it.

    Raises:
        PublishError: Cyclone DDS is not installed, or refuses.
    """
    where = f"DDS domain {domain}"
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
    except ImportError:
        problem = (
            "Cyclone DDS is not installed, and no ROS 2 is sourced; source one, "
            "or run: pip install 'mp4ds[dds]'"
        )
        raise PublishError(where, problem) from None
    try:
        if not _is_local():
            return DomainParticipant(domain)
        config = ",".join(filter(None, (_LOCAL, os.environ.get("CYCLONEDDS_URI"))))
        opened = Domain(domain, config)
        participant = DomainParticipant(domain)
        participant.mp4ds_domain = opened  # lives as long
        return participant
    except DDSException as error:
        problem = f"cannot be entered: {error.msg}; look at the network and at CYCLONEDDS_URI"
        raise PublishError(where, problem) from None


def _is_local() -> bool:
    told = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    return told == "LOCALHOST" or os.environ.get("ROS_LOCALHOST_ONLY", "").strip() == "1"
