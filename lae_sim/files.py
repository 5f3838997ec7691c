"""Files that appear whole or not at all; their locks, names and digests."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import tempfile
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, shown, visible

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NAME_MAX = 255
"""Bytes of the longest file name that the usual file systems hold."""

_SPECIAL = '<>:"/\\|?*'
_RESERVED = frozenset(
    ["", "con", "prn", "aux", "nul", *(f"{kind}{n}" for kind in ("com", "lpt") for n in range(10))]
)
_LEFT = f".{'[0-9a-f]' * 16}*.part*"


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside ``path``, of the same suffix; on success it takes its place.

    If the block fails, or the process is killed, ``path`` is as it was; what a killed process left
    of its temporary file is removed when ``path`` is written again.

    Raises:
        LaeError: if the file cannot be written there.
    """
    _check_place(path)
    target = Path(os.path.realpath(path))  # write where a link points
    with _explained(target), _temporary(target) as temporary:
        yield temporary
        _sync(temporary)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
        _sync(target.parent)


@contextmanager
def staged_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder in a folder, to fill with what is then moved out of it.

    What a killed process left of its own is removed with the next.

    Raises:
        LaeError: if it cannot be made, or something cannot be written in the block.
    """
    with _explained(folder), _temporary(folder / "staged", is_folder=True) as temporary:
        yield temporary


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder."""
    for path in folder.glob(_LEFT):
        _remove_left(path)


@contextmanager
def locked(target: Path, what: str) -> Iterator[None]:
    """Hold a lock while the block runs, where the system has any.

    It is a file beside the target that is removed afterwards; one that a killed process left holds
    nobody up.

    Args:
        target: what is written in the block.
        what: what another process that holds it would be, to begin a message with.

    Raises:
        LaeError: if another process holds it, which is named, or there can be no file.
    """
    if fcntl is None:
        yield
        return
    path = target.with_name(f".{text_digest(target.name)[:16]}.lock")
    with _explained(path):
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            if _held(descriptor, path, what):
                break
            os.close(descriptor)
    try:
        with suppress(OSError):  # of a full disk
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {os.uname().nodename}".encode(), 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _held(descriptor: int, path: Path, what: str) -> bool:
    """Whether this process has come to hold an open lock file that is still there."""
    try:
        return _lock(descriptor, path)
    except BlockingIOError:
        holder = os.pread(descriptor, NAME_MAX, 0).decode(errors="replace") or "another process"
        os.close(descriptor)
        raise LaeError(
            f"{what} is at work there ({holder}): wait until it has ended, or end it"
        ) from None
    except OSError:  # a file system without locks
        return True


def _lock(descriptor: int, path: Path) -> bool:
    """Lock an open file for as long as its descriptor is open; False if it has been removed.

    Raises:
        OSError: if another process holds it (BlockingIOError), or files cannot be locked there.
    """
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    return False


@contextmanager
def _temporary(target: Path, is_folder: bool = False) -> Iterator[Path]:
    """A new temporary file or folder beside a target, locked for as long as the block runs."""
    path, descriptor = _claimed(target, is_folder)
    try:
        yield path
    finally:
        _removed(path)
        if descriptor is not None:
            os.close(descriptor)


def _claimed(target: Path, is_folder: bool) -> tuple[Path, int | None]:
    """A new temporary file or folder beside a target, and the descriptor that holds its lock.

    Its name is short whatever the target's is, and the same in every run, so that the next one
    finds what a killed one left.
    """
    suffix = target.suffix if len(os.fsencode(target.suffix)) <= 16 else ""
    if fcntl is None:
        if is_folder:
            return Path(tempfile.mkdtemp(prefix=".part-", dir=target.parent)), None
        descriptor, name = tempfile.mkstemp(f".part{suffix}", ".", target.parent)
        os.close(descriptor)  # or it could not be renamed
        return Path(name), None
    key = text_digest(target.name)[:16]
    for number in count():
        path = target.with_name(f".{key}{f'-{number}' if number else ''}.part{suffix}")
        _remove_left(path)
        try:
            if is_folder:
                path.mkdir()
            descriptor = os.open(
                path, os.O_RDONLY if is_folder else os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600
            )
        except FileExistsError:  # of a process at work
            continue
        try:
            if _lock(descriptor, path):
                break
        except BlockingIOError:  # another process takes it for something left
            pass
        except OSError:  # a file system without locks
            break
        os.close(descriptor)
    return path, descriptor


def _remove_left(path: Path) -> None:
    """Remove a temporary file or folder unless a process is at work on it."""
    if fcntl is None:
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        try:
            if _lock(descriptor, path):
                _removed(path)
        finally:
            os.close(descriptor)


def _removed(path: Path) -> None:
    """Remove a file, if it is there, or a folder and what is in it."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn what the system says into an error that names the file."""
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error  # Arrow adds words of its own
        raise LaeError(f"cannot write {path}: {reason}") from error


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
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:32]


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


def check_places(paths: Iterable[str | os.PathLike[str]]) -> None:
    """Refuse, before work that may take long, files that cannot be written where they should.

    Raises:
        LaeError: if a folder is missing or cannot be written to, something that is no file is
            there, or a name is too long.
    """
    for path in paths:
        _check_place(path)
        folder = Path(os.path.realpath(path)).parent
        if not folder.is_dir():
            raise LaeError(f"cannot write {path}: its folder is not there")
        if not os.access(folder, os.W_OK):
            raise LaeError(f"cannot write {path}: its folder cannot be written to")


def _check_place(path: str | os.PathLike[str]) -> None:
    """Refuse to write a file where one cannot be.

    Raises:
        LaeError: if a folder, a pipe or a device is there, or what this process prints goes there,
            or the name is too long.
    """
    length = len(os.fsencode(os.path.basename(os.path.realpath(path))))
    if length > NAME_MAX:
        raise LaeError(
            f"cannot write {path}: its name has {length} bytes, and {NAME_MAX} are possible"
        )
    if os.path.exists(path) and not os.path.isfile(path):
        raise LaeError(f"cannot write {path}: it is there already and is not a file")
    for stream in (1, 2):
        with suppress(OSError):
            if os.path.samestat(os.stat(path), os.fstat(stream)):
                raise LaeError(f"cannot write {path}: what is printed goes there")


def file_names(names: Iterable[str], suffix: str = "") -> list[str]:
    """File names for what has names: such as every system can hold, and no two of them the same.

    Args:
        names: distinct ones; each is kept where it can be.
        suffix: of each file.
    """
    made: dict[str, str] = {}  # as a system that ignores case tells them apart
    for name in names:
        plain = "".join(c if c.isprintable() and c not in _SPECIAL else "-" for c in name)
        plain = plain.strip(" .")
        room = NAME_MAX - len(os.fsencode(suffix))
        key = unicodedata.normalize("NFKC", plain).casefold()
        if key in made or key.partition(".")[0] in _RESERVED or len(plain.encode()) > room:
            mark = f"-{text_digest(name)[:8]}"
            plain = plain.encode()[: room - len(mark)].decode(errors="ignore") + mark
            key = plain.casefold()
        made[key] = plain + suffix
    return list(made.values())
