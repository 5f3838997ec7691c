"""What a profile has finished so far, kept beside its trace until it is complete.

Every finished sequence is a small trace of its own, written whole or not at all, so that a killed
run loses no more than the sequence that it was in.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from lae_sim.errors import LaeError
from lae_sim.files import written_whole
from lae_sim.trace.file import Trace, read_trace, validate, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

_SETTINGS = "settings.json"


class Journal:
    """The finished sequences of one profile, in passes."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], resume: bool) -> None:
        """Open the folder, or go on with it.

        Args:
            folder: where to keep them.
            settings: all that decides the results, as JSON values.
            resume: whether to go on with what is there.

        Raises:
            LaeError: if it is there and not to be resumed, or is of other settings.
        """
        self._folder = folder
        text = json.dumps(settings, indent=2, sort_keys=True)
        if _made(folder):
            with written_whole(folder / _SETTINGS) as path:
                path.write_text(text, "utf-8")
            return
        if not resume:
            raise LaeError(
                f"{folder} holds an unfinished profile: go on with it by --resume, or remove it"
            )
        try:
            before = dict(json.loads((folder / _SETTINGS).read_text("utf-8")))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise LaeError(
                f"{folder}: cannot be resumed, remove it to start anew: {error}"
            ) from error
        now = json.loads(text)
        changed = [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]
        if changed:
            key = changed[0]
            raise LaeError(
                f"{folder} is a profile with {key} {before.get(key)!r:.200}, "
                f"not {now.get(key)!r:.200}: "
                "resume it with the same settings, or remove it"
            )
        for part in folder.glob("*/[!.]*.parquet"):
            try:
                validate(part)
            except LaeError:  # it is run again
                part.unlink()

    def decided(self, name: str, decide: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """What was decided under a name before, or is now and will be when it is resumed.

        Args:
            name: of a file.
            decide: makes a JSON object.
        """
        path = self._folder / f"{name}.json"
        with suppress(OSError, ValueError, TypeError, RecursionError):
            return dict(json.loads(path.read_text("utf-8")))
        decision = decide()
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(decision), "utf-8")
        return dict(decision)

    def finished(self, name: str) -> list[str]:
        """The finished sequences of a pass, sorted."""
        return sorted(unquote(path.stem) for path in (self._folder / name).glob("[!.]*.parquet"))

    def add(
        self, name: str, sequence: str, recordings: Sequence[Recording], metadata: Metadata
    ) -> None:
        """Keep a finished sequence of a pass: one recording, or those of its restarts."""
        folder = self._folder / name
        _made(folder)
        in_order = sorted(recordings, key=lambda recording: recording.name)
        write_trace(Trace(metadata, in_order), folder / _file_name(sequence))

    def metadata(self, name: str) -> list[Metadata]:
        """What was kept with each finished sequence of a pass."""
        return [
            read_trace(self._folder / name / _file_name(sequence)).metadata
            for sequence in self.finished(name)
        ]

    def columns(self, name: str) -> frozenset[str]:
        """The optional columns that any of a pass's recordings has."""
        parts = [self._folder / name / _file_name(sequence) for sequence in self.finished(name)]
        return frozenset(column for part in parts for column in read_trace(part).columns)

    def recordings(self, name: str) -> Iterator[Recording]:
        """The recordings of a pass, sequence by sequence, sorted by name."""
        for sequence in self.finished(name):
            yield from read_trace(self._folder / name / _file_name(sequence))

    def remove(self) -> None:
        """Remove the folder: all of it is in traces now."""
        shutil.rmtree(self._folder)


def _file_name(sequence: str) -> str:
    return quote(sequence, safe=" ").replace(".", "%2E") + ".parquet"


def _made(folder: Path) -> bool:
    """Make a folder; whether it was not there yet."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    except OSError as error:
        raise LaeError(f"cannot make the folder {folder}: {error.strerror or error}") from error
    return True
