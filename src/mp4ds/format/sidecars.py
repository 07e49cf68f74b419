"""Reading and writing the YAML files, through the tiers schema and model; older versions."""

from __future__ import annotations

import re
import warnings
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar

import xxhash
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from mp4ds import yamlio
from mp4ds.errors import FormatError, OptionError, SourceError, VersionError
from mp4ds.files.outputs import digest_file
from mp4ds.files.urls import location
from mp4ds.format.fields import FORMAT_VERSION, document_of, parse_version
from mp4ds.format.manifest import About, FileEntry, Manifest
from mp4ds.format.models import EXACT_SUFFIX, StreamSidecar
from mp4ds.options import Time, parse_time

Document = dict[str, Any]


def version_of(document: Document) -> str | None:
    """The version that a document claims; None if it claims none."""
    version = document.get("mp4ds")
    return version if isinstance(version, str) else None


MIGRATIONS = {"1.0": ("1.1", "headers", "padding"), "1.1": ("2.0", "streams", "view")}
"""An older version -> the next one, and the key that this adds, also in the maps of a list."""


def migrate(document: Document, place: str) -> Document:
    """Bring a document of any older version to the current one, of which it has no new key.

    Raises:
        FormatError: ``migration-failed``: it has one.
    """
    while (version := version_of(document)) in MIGRATIONS:
        later, name, key = MIGRATIONS[str(version)]
        entries = document.get(name)
        listed = entries if isinstance(entries, list) else []
        if any(isinstance(item, dict) and key in item for item in (document, *listed)):
            problem = f"is not a file of version {version}: {key} needs version {later}"
            raise FormatError("migration-failed", place, problem)
        document = {**document, "mp4ds": later}
    return document


# ---------------------------------------------------------------- files

MANIFEST_NAME = "dataset.yaml"
THE_TOP = "the top"
"""Where a problem of a whole document is."""

_COMMENTS = {
    "stream": "One camera stream, packed by mp4ds: frame n of the video is entry n of each column.",
    "dataset": "A robot recording, packed by mp4ds: `mp4ds unpack` gives it back.",
}
MODELS: dict[str, type[StreamSidecar] | type[Manifest]] = {
    "stream": StreamSidecar,
    "dataset": Manifest,
}
"""Kind of a document -> its model."""

_NEWS_LISTED = 5
_ModelT = TypeVar("_ModelT", bound=BaseModel)


def names_dataset(path: Path) -> bool:
    """Whether a path is that of a dataset, a sidecar or a video, not of a recording."""
    if path.is_dir() and (path / MANIFEST_NAME).is_file():
        return True
    return path.suffix in (".yaml", ".yml", ".mp4") and path.exists()


def sidecar_of(video: Path) -> Path:
    """Where the sidecar of a video is."""
    beside = video.with_suffix(".yaml")
    if video.name.endswith(EXACT_SUFFIX) and not beside.exists():
        return video.with_name(f"{video.name.removesuffix(EXACT_SUFFIX)}.yaml")
    return beside


def dump_document(model: StreamSidecar | Manifest) -> bytes:
    """The YAML file of a model."""
    return yamlio.dump(document_of(model), comment=_COMMENTS[model.kind])


def load_document(path: Path) -> dict[str, Any]:
    """Read a file of any version as a document of the current one.

    Raises:
        FormatError: ``file-missing``, ``yaml-invalid``, ``checksum-mismatch``,
            ``version-unsupported``, ``migration-failed`` or ``kind-unknown``.
    """
    try:
        if not path.is_file() and path.exists():
            raise FormatError("file-missing", path, "is not a regular file")
        if path.stat().st_size > yamlio.MAX_BYTES:
            raise FormatError("yaml-invalid", path, f"is larger than {yamlio.MAX_BYTES} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise FormatError("file-missing", path, f"cannot be read: {error.strerror}") from None
    document = migrate(yamlio.load(data, str(path)), str(path))
    version = version_of(document)
    if version is None and "img_timestamp" in document:
        raise FormatError(
            "version-unsupported",
            path,
            "was made by the tool published with the paper; `mp4ds import ros-mp4 VIDEO "
            f"{path.name} -o DATASET` makes a dataset of it and its video",
        )
    if version is None:
        raise FormatError(
            "version-unsupported",
            path,
            f'has no version such as `mp4ds: "{FORMAT_VERSION}"`, in quotes',
        )
    try:
        found = parse_version(version)
    except ValueError as error:
        raise FormatError("version-unsupported", path, str(error)) from None
    supported = parse_version(FORMAT_VERSION)
    if found[0] > supported[0]:
        raise VersionError(path, version, FORMAT_VERSION)
    if found < supported:
        raise FormatError(
            "version-unsupported", path, f"has version {version!r}, which does not exist"
        )
    if document.get("kind") not in list(MODELS):
        raise FormatError("kind-unknown", path, "is not a stream or a dataset")
    return document if found == supported else _without_news(document, path)


def cut_short(document: dict[str, Any]) -> str:
    """What the end of a document lacks, which `load_document` returned; empty if nothing.

    Keys are written in the order of the model, so the last one is missing from a file that ends
    early.
    """
    fields = MODELS[document["kind"]].model_fields
    required = [name for name, field in fields.items() if field.is_required()]
    if required[-1] in document:
        return ""
    missing = ", ".join(name for name in required if name not in document)
    return f"ends without {missing}: it was probably cut short"


def _without_news(document: dict[str, Any], path: Path) -> dict[str, Any]:
    """A document of a newer minor version without the keys that this one does not know."""
    unknown: list[tuple[int | str, ...]] = []
    try:
        MODELS[document["kind"]].model_validate(document)
    except ValidationError as error:
        unknown = [item["loc"] for item in error.errors() if item["type"] == "extra_forbidden"]
    for *above, last in unknown:
        node: Any = document
        for key in above:
            node = node[key]
        node.pop(last, None)
    dropped = [".".join(map(str, place)) for place in unknown]
    warnings.warn(
        f"{path} has format version {document['mp4ds']}, newer than {FORMAT_VERSION}; ignored: "
        f"{', '.join(dropped[:_NEWS_LISTED]) or 'nothing'}"
        + (f" and {len(dropped) - _NEWS_LISTED} more" if len(dropped) > _NEWS_LISTED else ""),
        stacklevel=2,
    )
    return document


def load_stream(path: Path) -> StreamSidecar:
    """Read a stream's sidecar.

    Raises:
        FormatError: Any code of `load_document`, or ``model-invalid``.
    """
    return _model(StreamSidecar, load_document(path), path)


def load_manifest(path: Path) -> Manifest:
    """Read a dataset's manifest.

    Raises:
        FormatError: Any code of `load_document`, or ``model-invalid``.
    """
    return _model(Manifest, load_document(path), path)


COPY_AGAIN = "`mp4ds validate --deep` lists what is damaged: copy it again from a good copy."
"""What to do about a damaged dataset that is to be packed again."""


def verify_file(
    path: Path,
    entry: FileEntry | None,
    *,
    found: tuple[int, str] | None = None,
    hashed: bool = True,
) -> None:
    """Check a dataset's file against its manifest.

    Args:
        path: The file.
        entry: What the manifest says of it; None: nothing.
        found: Its size and SHA-256 where they are known; else it is read.
        hashed: Whether to check more than its size.

    Raises:
        FormatError: ``file-missing``, ``size-mismatch``, ``hash-mismatch``, or
            ``manifest-inconsistent`` if the manifest does not list it.
    """
    if entry is None:
        raise FormatError(
            "manifest-inconsistent", path.with_name(MANIFEST_NAME), f"does not list {path.name}"
        )
    if found is None and not path.is_file():
        raise FormatError("file-missing", path, "is listed in the manifest but missing")
    size = found[0] if found else path.stat().st_size
    if size != entry.size:
        problem = f"has {size} bytes, but the manifest says {entry.size}"
        raise FormatError("size-mismatch", path, problem)
    if hashed and (found or digest_file(path))[1] != entry.sha256:
        raise FormatError("hash-mismatch", path, "does not match the SHA-256 in the manifest")


def _model(model: type[_ModelT], document: dict[str, Any], path: Path) -> _ModelT:
    if problem := cut_short(document):
        raise FormatError("model-invalid", path, problem)
    try:
        return model.model_validate(document)
    except ValidationError as error:
        problems = model_problems(error)
        place, problem = problems[0]
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise FormatError("model-invalid", f"{path} at {place}", problem + more) from None


def model_problems(error: ValidationError) -> list[tuple[str, str]]:
    """Place and sentence of each problem that a model found."""
    return [
        (".".join(map(str, item["loc"])) or THE_TOP, item["msg"].removeprefix("Value error, "))
        for item in error.errors(include_url=False, include_input=False)
    ]


@cache
def schema_text(kind: str) -> str:
    """The released JSON Schema of ``stream`` or ``dataset``, as shipped with the package."""
    name = f"v{FORMAT_VERSION}/{kind}.schema.json"
    shipped = files("mp4ds") / "schemas" / name
    if shipped.is_file():
        return shipped.read_text(encoding="utf-8")
    # a checkout: the wheel's copy is made from this folder
    return (Path(__file__).parents[3] / "schemas" / name).read_text(encoding="utf-8")


# ---------------------------------------------------------------- files of users

LEAST_SQUARE = 8
"""Pixels of a side of the squares that are blurred."""
PROVEN_TOGETHER = 300
"""Changed images of which untouched blocks are proven together, unless the rules say otherwise."""


def load_about(path: Path | str) -> About:
    """What a user tells of a recording, in a YAML file.

    Raises:
        SourceError: It cannot be read, or tells what has no place; says what.
    """
    place = location(path)
    remedy = "See spec/index.md, About the recording."
    try:
        told = yamlio.build(place.read_bytes().decode(), lambda event: event.value)
        return About.model_validate(told)
    except OSError as error:
        raise SourceError(place, f"cannot be read: {error.strerror}") from None
    except ValidationError as error:
        key, problem = model_problems(error)[0]
        raise SourceError(place, f"at {key}: {problem}", remedy) from None
    except ValueError as error:
        raise SourceError(place, f"is not valid YAML: {error}", remedy) from None


def _time(text: Any) -> Time | None:
    try:
        return None if text is None else parse_time(text)
    except OptionError as error:
        raise ValueError(str(error).rstrip(".")) from None


_TimeText = Annotated[Time | None, BeforeValidator(_time)]
_Place = Annotated[int, Field(ge=0, lt=2**31)]
_Side = Annotated[int, Field(ge=1, lt=2**31)]


class Rule(BaseModel):
    """A box of images of some topics, during a time."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str
    start: _TimeText = None
    end: _TimeText = None
    box: tuple[_Place, _Place, _Side, _Side]
    fill: float | tuple[float, ...] = 0.0
    blur: Annotated[int, Field(ge=LEAST_SQUARE, lt=2**31)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Rule:
        if self.blur is not None and "fill" in self.model_fields_set:
            raise ValueError("give blur or fill, not both")
        start, end = self.start, self.end
        if start and end and start.from_start == end.from_start and end.ns <= start.ns:
            raise ValueError(f"its range is empty: from {start} to {end}")
        return self


class Rules(BaseModel):
    """A file of rules."""

    model_config = ConfigDict(extra="forbid")

    rules: Annotated[list[Rule], Field(min_length=1)]
    proof: Annotated[int, Field(ge=0)] = PROVEN_TOGETHER
    keep_rules: bool = False


def load_rules(path: Path) -> tuple[Rules, bytes]:
    """Read a file of rules.

    Returns:
        The rules, and the file.

    Raises:
        OptionError: It cannot be read, or is not valid; says where.
    """
    most = yamlio.MAX_STRUCTURE_BYTES
    try:
        if path.exists() and not path.is_file():
            raise OptionError(f"{path} is not a file of rules.")
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise OptionError(f"{path} has more than {most} bytes: give a function instead.")
        found = Rules.model_validate(yamlio.build(data.decode(), _rule_scalar))
    except OSError as error:
        raise OptionError(f"{path} cannot be read: {error.strerror}.") from None
    except ValidationError as error:
        key, problem = model_problems(error)[0]
        names = key.split(".")
        if names[0] == "rules" and names[1:]:
            names[:2] = [f"rule {int(names[1]) + 1}"]
        if names[1:2] == ["box"] and names[2:]:
            names[1:] = ["box " + ("x", "y", "width", "height")[int(names[2])]]
        raise OptionError(f"{path}: {', '.join(names)}: {problem}.") from None
    except OptionError:
        raise
    except ValueError as error:
        raise OptionError(f"{path} is not valid YAML: {error}.") from None
    return found, data


def _rule_scalar(event: Any) -> str | None:
    """A value as written, such as a time with all of its digits; None for none."""
    is_none = not event.style and yamlio.WORDS.get(event.value, "") is None
    return None if is_none else event.value


# ---------------------------------------------------------------- file names (spec/index.md)

_MAX_NAME = 100
_RESERVED = {"dataset", "messages", "con", "prn", "aux", "nul"} | {
    f"{port}{number}" for port in ("com", "lpt") for number in range(10)
}


class FileNames:
    """Gives each stream a file name that no topic can turn into a path or take from another."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def name_for(self, topic: str) -> str:
        """A stem for the stream's files."""
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", topic.strip("/")).strip("._-") or "topic"
        if len(stem) > _MAX_NAME:
            stem = f"{stem[: _MAX_NAME - 17]}-{xxhash.xxh64(topic.encode()).hexdigest()}"
        if stem.casefold().endswith(".exact"):
            stem += "_"  # else its video would have the name of another's exact layer
        if stem.casefold().split(".")[0] in _RESERVED:
            stem = f"topic_{stem}"
        name, number = stem, 1
        while name.casefold() in self._taken:
            number += 1
            name = f"{stem}-{number}"
        self._taken.add(name.casefold())
        return name

    def release(self, name: str) -> None:
        """Take back a name of which no files were made."""
        self._taken.remove(name.casefold())
