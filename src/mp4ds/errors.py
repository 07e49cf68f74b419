"""Every error that mp4ds raises on purpose.

:

    Mp4dsError                         exit code 1
    ├── PathError                      1  a file or folder with which something is wrong
    │   ├── SourceError (ValueError)   2  a recording that cannot be read
    │   │   └── SourceNotFoundError (FileNotFoundError)
    │   ├── TargetError (OSError)      2  an output that cannot be written there
    │   │   └── TargetExistsError (FileExistsError)
    │   ├── WriteError (OSError)       1  an output could not be written
    │   └── RemoteError                1  a store, web server, cluster or ROS that fails
    ├── OptionError (ValueError)       2  options that are unknown or contradict each other
    ├── FrameNotFoundError (LookupError) 2  no frame has the requested time
    ├── FormatError (ValueError)       1  a dataset that breaks a rule of the format
    │   ├── VersionError               1  written by a newer major version
    │   └── VideoError                 1  a video that cannot be decoded as its sidecar says
    ├── ConversionError (ValueError)   1  a message that the target cannot hold
    ├── PartsFailedError               1  parts of a pack failed, the others are kept
    ├── EncoderRefusedError            1  pictures that an encoder does not support
    ├── ScoringError                   1  an ffmpeg with libvmaf that is missing or failed
    └── SampleError (RuntimeError)     1  a sample of a data loader that cannot be read

The classes build their sentence from their fields: what, where, and what to do.
The exit code is that of the command line. `Refused` is not one of them: users never see it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path


class Mp4dsError(Exception):
    """Base of every error raised on purpose; ``str()`` is one clear sentence."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        # pickled like this because the classes cannot be rebuilt from their sentence alone
        return _restored, (type(self), self.args, vars(self))


def _restored(kind: type[Mp4dsError], args: tuple[Any, ...], fields: dict[str, Any]) -> Mp4dsError:
    """An error from another process."""
    error: Mp4dsError = (OSError if issubclass(kind, OSError) else Exception).__new__(kind)
    error.args = args
    vars(error).update(fields)
    return error


class Refused(ValueError):  # noqa: N818 - no failure: another way is taken
    """One approach does not work for this input; the text says why, as a phrase.

    Anyone who catches it tries the next approach, and reports the reason where it helps the user: a
    message is stored verbatim, a video is read in order, a camera is left out.
    """


def path_text(path: object) -> str:
    """A path as users write it: relative to the current folder, if it is inside."""
    text = str(path)
    try:
        here = os.getcwd()  # noqa: PTH109 - starting up without pathlib's classes
    except OSError:  # it was removed
        return text
    if text == here:
        return "."
    return text.removeprefix(here + os.sep) if here != os.sep else text


def counted(count: int, noun: str) -> str:
    """A number of things, such as ``1 message`` or ``2 messages``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def reason_of(error: BaseException) -> str:
    """The system's description of an error, and what helps; without a full stop."""
    if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE):
        return "too many files are open at once; `ulimit -n` allows more"
    return getattr(error, "strerror", None) or str(error)


def size_text(count: float) -> str:
    """A size in a suitable unit."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} TB"


def sentence_of(error: OSError) -> str:
    """A system error: where, and what; without a full stop."""
    return f"{path_text(error.filename or 'a file')}: {reason_of(error)}"


def interrupted(error: KeyboardInterrupt | SystemExit, text: str) -> BaseException:
    """An interruption, by Ctrl-C or a signal that ends the process, that says what is left."""
    told = type(error)(f"interrupted; {text}")
    if isinstance(told, SystemExit) and isinstance(error, SystemExit):
        told.code = error.code
    return told


class PathError(Mp4dsError):
    """Something is wrong with a file or folder, or with what is at an address.

    Args:
        path: Which.
        problem: What is wrong, without a full stop.
        remedy: What the user can do, if anything.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str = "") -> None:
        self.path = path
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path_text(path)}: {problem}." + (f" {remedy}" if remedy else ""))


class SourceError(PathError, ValueError):
    """A recording cannot be read."""

    exit_code = 2


class SourceNotFoundError(SourceError, FileNotFoundError):
    """The recording does not exist."""

    def __init__(self, path: Path | str) -> None:
        super().__init__(path, "no such file or folder", "Check the path.")


class TargetError(PathError, OSError):
    """An output cannot be written to the requested place."""

    exit_code = 2


class TargetExistsError(TargetError, FileExistsError):
    """The output exists and ``force`` was not given."""

    def __init__(
        self,
        path: Path | str,
        problem: str = "already exists",
        remedy: str = "Choose another name, or use `force` to replace it.",
    ) -> None:
        super().__init__(path, problem, remedy)


class OptionError(Mp4dsError, ValueError):
    """An option is unknown, malformed, or contradicts another one."""

    exit_code = 2


class FrameNotFoundError(Mp4dsError, LookupError):
    """No frame of a topic has the requested time.

    Args:
        topic: Topic of the frames.
        stamp_ns: The requested time, nanoseconds.
        wanted: Which frame, such as "at or before"; a phrase.
        nearest_ns: Stamp of the nearest frame, nanoseconds.
    """

    exit_code = 2

    def __init__(self, topic: str, stamp_ns: int, wanted: str, nearest_ns: int) -> None:
        self.topic = topic
        self.stamp_ns = stamp_ns
        self.nearest_ns = nearest_ns
        super().__init__(
            f"{topic} has no frame {wanted} {stamp_ns} ns; the nearest is at {nearest_ns} ns, "
            f"{abs(nearest_ns - stamp_ns)} ns {'later' if nearest_ns > stamp_ns else 'earlier'}."
        )


class FormatError(Mp4dsError, ValueError):
    """A dataset breaks a rule of the format.

    Args:
        code: A problem code of spec/registry.md.
        place: File, with key where known.
        problem: What is wrong, without a full stop.
        frame: Number of the frame that it is wrong with, if it is one.
        name: What the frame is called, with its topic and times where they are known.
    """

    def __init__(
        self,
        code: str,
        place: Path | str,
        problem: str,
        *,
        frame: int | None = None,
        name: str = "",
    ) -> None:
        self.code = code
        self.place = str(place)
        self.frame = frame
        self.name = name
        self.what = problem
        if name:
            problem = f"{name}: {problem}"
        elif frame is not None:
            problem = f"frame {frame} {problem}"
        self.problem = problem
        super().__init__(f"{path_text(place)}: {self.problem} [{code}].")


@contextmanager
def advising(remedy: str) -> Iterator[None]:
    """Add to the error of a damaged dataset what the user can do; a newer version is no damage."""
    try:
        yield
    except VersionError:
        raise
    except FormatError as error:
        error.args = (f"{error} {remedy}",)
        raise


class VersionError(FormatError):
    """The dataset was written in a newer major version of the format."""

    def __init__(self, place: Path | str, found: str, supported: str) -> None:
        super().__init__(
            "version-unsupported",
            place,
            f"has format version {found!r}; this mp4ds reads versions up to {supported!r}: "
            "install a newer mp4ds",
        )


class VideoError(FormatError):
    """A video cannot be decoded as its sidecar says."""


class ConversionError(Mp4dsError, ValueError):
    """A message that the target cannot hold."""

    def __init__(self, topic: str, problem: str, remedy: str = "") -> None:
        self.topic = topic
        self.problem = problem
        super().__init__(f"topic {topic}: {problem}." + (f" {remedy}" if remedy else ""))


class WriteError(PathError, OSError):
    """An output could not be written, since the disk is full, for example.

    Args:
        path: The output.
        cause: Why.
        left: What is left of it, a sentence.
    """

    def __init__(
        self, path: Path | str, cause: BaseException, left: str = "The partial output was removed."
    ) -> None:
        super().__init__(path, f"could not be written: {reason_of(cause)}", left)


class PartsFailedError(Mp4dsError):
    """Parts of a pack failed; finished parts are kept, so that the same command resumes.

    Args:
        dataset: What was being made.
        failures: Name and sentence of each part that failed.
        total: Number of parts.
        exit_code: That of the first failure.
    """

    def __init__(
        self, dataset: Path | str, failures: Sequence[tuple[str, str]], total: int, exit_code: int
    ) -> None:
        self.dataset = dataset
        self.failures = list(failures)
        self.exit_code = exit_code
        listed = " ".join(
            f"Part {name}: {sentence.rstrip('.')}." for name, sentence in failures[:5]
        )
        more = f" And {len(failures) - 5} more." if len(failures) > 5 else ""
        super().__init__(
            f"{path_text(dataset)}: {len(failures)} of {total} parts could not be packed. "
            f"{listed}{more} Finished parts are kept: run the same command again to resume."
        )


class RemoteError(PathError):
    """A store, web server, cluster or ROS is missing, does not answer, or was lost.

    It is neither a `ValueError` nor an `OSError` on purpose: handlers of a damaged recording or a
    full disk must not catch it.
    """


class ScoringError(Mp4dsError):
    """Frames cannot be scored: libvmaf is missing or failed, or the frames do not match."""


class SampleError(Mp4dsError, RuntimeError):
    """Frames of a sample cannot be read; names the dataset, topic and frame.

    A DataLoader re-creates a worker's error in the main process from its text alone. So this error
    has only a text, and is the same with and without workers.
    """


class EncoderRefusedError(Mp4dsError):
    """The encoder does not support pictures of this kind or size; the message says why."""
