"""The recipes: which files of which public repositories make which trace.

They are data. ``repositories.toml`` names the repositories, each at one commit. ``<dataset>.toml``
says where a dataset's ground truth lies, and the results of which trackers on it. What files there
are, and their digests, is in ``digests/<repository>.txt``, whose lines are::

    # a comment
    anno/                                          the folder of the lines that follow
    3f0a...c2 15312 Biker.txt                      SHA-256, bytes, name
    77b1...09 8031 basketball.txt Basketball.txt   and what it is called here
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, hint, listed, shown

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PACKAGED = Path(__file__).parent
"""The folder of the recipes that come with the package."""

STAND_IN = "constant:47ms"
"""What stands for times that were never published: they must be something, and none is right."""

_TIMES = {
    "frame": "measured per frame",
    "sequence": "mean fps of each sequence",
    "none": "not published",
}


@dataclass(frozen=True)
class Repository:
    """A public repository at one commit.

    Attributes:
        url: its page, ``https://github.com/OWNER/NAME``.
        commit: 40 hexadecimal digits.
        licence: what it says of its files' licence, in words.
        citation: what it asks to cite.
        device: what its trackers ran on, where it says so.
    """

    url: str
    commit: str
    licence: str
    citation: str
    device: str | None = None

    @property
    def root(self) -> str:
        """Where its files lie below ``https://raw.githubusercontent.com/``, or in a mirror."""
        return f"{self.url.removeprefix('https://github.com/')}/{self.commit}"


@dataclass(frozen=True)
class RemoteFile:
    """A file of a repository.

    Attributes:
        path: below :data:`lae_sim.recipes.download.HOME`, and in a mirror.
        size: bytes.
        sha256: its digest, hexadecimal.
        name: what it is called here, in its folder.
    """

    path: str
    size: int
    sha256: str
    name: str


@dataclass(frozen=True)
class Source:
    """Files of one repository that belong together.

    Attributes:
        repository: where they lie.
        path: a folder there, which ends with a slash, or a zip archive.
        inside: the folder in the archive.
        files: what there is to download.
    """

    repository: Repository
    path: str
    inside: str
    files: tuple[RemoteFile, ...]

    @classmethod
    def of(
        cls, repository: Repository, files: Iterable[RemoteFile], path: str, inside: str = ""
    ) -> Source:
        """The files of a repository that lie at a path.

        Raises:
            LaeError: if none does.
        """
        within = f"{repository.root}/{path}"
        folder = within[: within.rindex("/") + 1]
        found = tuple(
            replace(file, name=file.name.removeprefix(folder))
            for file in files
            if file.path == within or (path.endswith("/") and file.path.startswith(within))
        )
        if not found:
            raise LaeError(f"{repository.url}: no digests of {path}")
        return cls(repository, path, inside, found)

    def document(self) -> dict[str, str]:
        """What a trace's metadata says of it."""
        return {
            "repository": self.repository.url,
            "commit": self.repository.commit,
            "path": self.path,
            **({"inside": self.inside} if self.inside else {}),
            "licence": self.repository.licence,
        }


@dataclass(frozen=True)
class Recipe:
    """How a trace is made of public files.

    Attributes:
        name: ``dataset/tracker``, by which it is asked for.
        tracker, dataset: their names in the trace.
        sequences: how many there are.
        fps: world frames per second, exact text.
        times: what is known of processing times, in words.
        time: where times come from, as ``--time`` of ``lae-sim convert`` says it.
        boxes, truth: the tracker's results and the ground truth.
        citation: of the dataset.
        auc, dp20: what the boxes score on every frame, latency not counted, in the convention
            ``pysot``: to tell that a trace is right.
        note: what else is to be known, or None.
    """

    name: str
    tracker: str
    dataset: str
    sequences: int
    fps: str
    times: str
    time: str
    boxes: Source
    truth: Source
    citation: str
    auc: float
    dp20: float
    note: str | None = None

    @property
    def files(self) -> tuple[RemoteFile, ...]:
        """All there is to download."""
        return (*self.boxes.files, *self.truth.files)

    @property
    def file_name(self) -> str:
        """What the trace is called if nothing else is said."""
        return f"{self.name.replace('/', '-')}.parquet"

    @property
    def citations(self) -> list[str]:
        """What those who use the trace should cite."""
        asked = (self.boxes.repository.citation, self.truth.repository.citation, self.citation)
        return list(dict.fromkeys(asked))

    def document(self) -> dict[str, Any]:
        """The recipe as JSON values."""
        return {
            "name": self.name,
            "tracker": self.tracker,
            "dataset": self.dataset,
            "sequences": self.sequences,
            "fps": self.fps,
            "times": self.times,
            "device": self.boxes.repository.device,
            "auc": self.auc,
            "dp20": self.dp20,
            "files": len(self.files),
            "bytes": sum(file.size for file in self.files),
            "note": self.note,
            "origin": self.origin(),
        }

    def origin(self) -> dict[str, Any]:
        """What a trace's metadata says of where it is from."""
        return {
            "recipe": self.name,
            "cite": self.citations,
            "boxes": self.boxes.document(),
            "truth": self.truth.document(),
        }


def list_recipes(folder: Path = PACKAGED) -> tuple[Recipe, ...]:
    """All recipes, those of a dataset together.

    Args:
        folder: where they lie; by default those of the package.

    Raises:
        LaeError: if one names a repository or files that are not there.

    Example:
        >>> import lae_sim
        >>> recipe = next(r for r in lae_sim.list_recipes() if r.name == "dtb70/nanotrackv3")
        >>> recipe.sequences, recipe.times, recipe.truth.repository.url
        (70, 'not published', 'https://github.com/flyers/drone-tracking')
    """
    entries = _toml(folder / "repositories.toml")
    repositories = {key: Repository(**entry) for key, entry in entries.items()}
    files = {
        key: list(_digests(folder / "digests" / f"{key}.txt", repository.root))
        for key, repository in repositories.items()
    }

    def source(repository: str, **where: str) -> Source:
        return Source.of(repositories[repository], files[repository], **where)

    recipes = []
    for path in sorted(folder.glob("*.toml")):
        if path.stem == "repositories":
            continue
        dataset = _toml(path)
        truth = source(**dataset["truth"])
        for key, entry in dataset["trackers"].items():
            recipe = Recipe(
                name=f"{path.stem}/{key}",
                tracker=entry["name"],
                dataset=dataset["name"],
                sequences=dataset["sequences"],
                fps=dataset["fps"],
                times=_TIMES[entry["times"]],
                time=STAND_IN if entry["times"] == "none" else "measured",
                boxes=source(**entry["boxes"]),
                truth=truth,
                citation=dataset["citation"],
                auc=entry["auc"],
                dp20=entry["dp20"],
                note=dataset.get("note"),
            )
            recipes.append(recipe)
    return tuple(recipes)


def find_recipe(name: str, recipes: Iterable[Recipe] | None = None) -> Recipe:
    """The recipe of a name, such as ``dtb70/nanotrackv3``; capitals do not matter.

    Args:
        name: the recipe's name.
        recipes: where to look; by default those of the package.

    Raises:
        LaeError: if there is none.
    """
    known = {recipe.name: recipe for recipe in recipes or list_recipes()}
    folded = name.casefold() if isinstance(name, str) else ""
    if folded not in known:
        within = [each for each in known if each.startswith(f"{folded.rstrip('/*')}/")]
        if within:
            raise LaeError(f"{shown(name)} is a dataset; name its trackers: {listed(within)}")
        meant = hint(folded, known) or "; lae-sim get lists those there are"
        raise LaeError(f"no recipe {shown(name)}{meant}")
    return known[folded]


def _digests(path: Path, root: str) -> Iterator[RemoteFile]:
    """The files of a list of digests; their names are their paths, but for the last part."""
    folder = f"{root}/"
    for line in path.read_text("utf-8").splitlines():
        if line.startswith("#"):
            continue
        if line.endswith("/"):
            folder = f"{root}/{line}"
            continue
        sha256, size, name, *renamed = line.split(" ")
        yield RemoteFile(folder + name, int(size), sha256, folder + (renamed or [name])[0])


def _toml(path: Path) -> Mapping[str, Any]:
    return tomllib.loads(path.read_text("utf-8"))
