"""Files that appear whole or not at all; names and digests."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, shown, visible


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside ``path``, of the same suffix; on success it takes its place.

    If the block fails, or the process is killed, ``path`` is as it was.

    Raises:
        LaeError: if the file cannot be written there.
    """
    target = Path(os.path.realpath(path))  # write where a link points
    try:
        if target.exists() and not target.is_file():
            raise LaeError(f"cannot write {path}: it is there already and is not a file")
        handle, name = tempfile.mkstemp(
            prefix=f".{target.stem}.", suffix=f".part{target.suffix}", dir=target.parent
        )
    except OSError as error:
        raise LaeError(f"cannot write {target}: {error.strerror or error}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _sync(temporary)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
        _sync(target.parent)
    except OSError as error:
        raise LaeError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_distinct(
    outputs: Iterable[str | os.PathLike[str]], inputs: Iterable[str | os.PathLike[str]]
) -> None:
    """Check that no output would replace an input or another output.

    Files are compared by what they are on the disk, whatever names and links lead there. Of an
    input that is a folder everything in it counts as read.

    Raises:
        LaeError: if two of them are the same file, or an output is there already in such a folder.
    """
    inputs = list(inputs)
    taken = {_identity(path) for path in inputs}
    folders = {_identity(path): path for path in inputs if os.path.isdir(path)}
    for path in outputs:
        if _identity(path) in taken:
            raise LaeError(f"{path} would replace a file that is read, or another output")
        taken.add(_identity(path))
        if os.path.isfile(path):
            for parent in Path(os.path.realpath(path)).parents if folders else ():
                if folder := folders.get(_identity(parent)):
                    raise LaeError(
                        f"{path} would replace a file in {folder}, which is read: name another "
                        "place, or remove it"
                    )


def _identity(path: str | os.PathLike[str]) -> tuple[object, ...]:
    """What tells a file from others; of one that is not there, its folder and its name in it."""
    real = os.path.realpath(str(path).removeprefix("file://"))
    with suppress(OSError, ValueError):
        status = os.stat(real)
        return status.st_dev, status.st_ino
    with suppress(OSError, ValueError):
        status = os.stat(os.path.dirname(real))
        return status.st_dev, status.st_ino, os.path.basename(real)
    return (real,)


def _sync(path: Path) -> None:
    if path.is_dir() and os.name == "nt":
        return  # Windows cannot open a folder
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def text_digest(text: str) -> str:
    """The first 32 hexadecimal digits of a text's SHA-256, as a name of what it describes."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def labels(paths: Sequence[str]) -> list[str]:
    """File names, where they tell the files apart; otherwise the paths. All can be printed."""
    names = [visible(Path(path).name) for path in paths]
    return names if len(set(names)) == len(names) else [visible(path) for path in paths]


def csv_cell(value: Any) -> Any:
    """A value as a cell of a CSV file, of which no spreadsheet makes a formula.

    A text that begins with one of ``= + - @ '``, a tab or a line break has an apostrophe before it
    (a recipe of OWASP, "CSV Injection"), unless it is a number; one apostrophe taken from the front
    of a cell gives the text back. All other values stay what they are.
    """
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "'", *"\t\r\n")):
        return value
    try:
        Fraction(value)
    except (ValueError, ZeroDivisionError):
        return f"'{value}"
    return value


def sequence_names(sequences: str | Iterable[str]) -> list[str]:
    """Names of sequences: one, or several.

    Raises:
        LaeError: if there is none, or one is not text.
    """
    if isinstance(sequences, str) or not isinstance(sequences, Iterable):
        sequences = [sequences]
    names = list(sequences)
    for name in names:
        if not isinstance(name, str):
            raise LaeError(f"sequences: a sequence is named by text, not {shown(name)}")
    if not names:
        raise LaeError("sequences: name at least one")
    return names


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse to read what is there but no file, such as a pipe, which might never end.

    Raises:
        LaeError: if it is a folder, a pipe, a socket or a device.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return  # which reading it will tell
    if not stat.S_ISREG(mode):
        what = "folder" if stat.S_ISDIR(mode) else "pipe" if stat.S_ISFIFO(mode) else "device"
        raise LaeError(f"{path}: a {what}, not a file: write it to a file, and give that")


def check_folders(paths: Iterable[str]) -> None:
    """Refuse, before work that may take long, files whose folder is not there.

    Raises:
        LaeError: if a folder is missing.
    """
    for path in paths:
        if not Path(path).resolve().parent.is_dir():
            raise LaeError(f"cannot write {path}: its folder is not there")
