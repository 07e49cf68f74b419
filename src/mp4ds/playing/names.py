"""What topics are called where they are played. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from mp4ds.errors import OptionError
from mp4ds.plan import Selection


class Names:
    """New names of topics.

    Args:
        remap: ``old:=new``, each of one topic; a missing slash at the beginning does not count.
        prefix: Put before all names that are not remapped.

    Raises:
        OptionError: A rule is none.
    """

    def __init__(self, remap: Sequence[str] = (), prefix: str = "") -> None:
        self._rules: dict[str, str] = {}
        for rule in remap:
            old, found, new = rule.partition(":=")
            if not (found and old.strip("/ ") and new.strip("/ ")):
                raise OptionError(
                    f"--remap {rule!r} is no rule: write it as /old/topic:=/new/topic"
                )
            self._rules[_rooted(old)] = new
        self._prefix = prefix.rstrip("/")

    def check(self, topics: Iterable[str]) -> None:
        """Refuse a rule for a topic that is not there.

        Raises:
            OptionError: Names it.
        """
        known = {_rooted(topic) for topic in topics}
        for old in self._rules:
            if old not in known:
                raise OptionError(f"--remap {old!r}: there is no such topic to be played")

    def __call__(self, topic: str) -> str:
        """The name of a topic."""
        new = self._rules.get(_rooted(topic))
        if new is not None:
            return new
        return f"{self._prefix}/{topic.lstrip('/')}" if self._prefix else topic


class Wanted:
    """Which topics are played.

    Args:
        selection: By globs.
        regex: Topics of which a part matches are played too, as with ``ros2 bag play``; with
            neither globs nor this, all are.
        without: Topics that are not, whatever the others say.

    Raises:
        OptionError: The regular expression is none.
    """

    def __init__(
        self,
        topics: Sequence[str] = (),
        exclude: Sequence[str] = (),
        *,
        regex: str = "",
        without: frozenset[str] = frozenset(),
    ) -> None:
        self._by_glob = Selection(topics)
        self._has_globs = bool(topics)
        self._excluded = Selection((), exclude)
        self._globs = Selection(topics, exclude)
        try:
            self._regex = re.compile(regex) if regex else None
        except re.error as error:
            raise OptionError(f"--regex {regex!r} is no regular expression: {error}") from None
        self._without = without

    def __call__(self, topic: str) -> bool:
        """Whether a topic is played."""
        if topic in self._without or not self._excluded(topic):
            return False
        if self._regex is None:
            return self._by_glob(topic)
        return (self._has_globs and self._by_glob(topic)) or bool(self._regex.search(topic))

    def check(self, topics: Iterable[str]) -> None:
        """Refuse what matches no topic.

        Raises:
            OptionError: Names the pattern, and the topics there are.
        """
        known = list(topics)
        self._globs.check(known)
        if self._regex is not None and not any(self._regex.search(topic) for topic in known):
            raise OptionError(f"--regex {self._regex.pattern!r} matches no topic.")


def _rooted(topic: str) -> str:
    return "/" + topic.strip().lstrip("/")
