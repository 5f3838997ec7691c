"""What a profile has finished so far, kept beside its trace until it is complete.

Every finished sequence is a small trace of its own, written whole or not at all, so that a killed
run loses no more than the sequence that it was in. A sequence may have any name: its file is called
by a digest of it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError
from lae_sim.files import text_digest, written_whole
from lae_sim.trace.file import Trace, read_trace, validate, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

_SETTINGS = "settings.json"
_SEQUENCES = "[0-9a-f]" * 32 + ".parquet"


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
        for part in folder.glob(f"*/{_SEQUENCES}"):
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

    def holds(self, name: str, sequence: str) -> bool:
        """Whether a sequence of a pass is finished."""
        return self._file(name, sequence).exists()

    def add(
        self, name: str, sequence: str, recordings: Sequence[Recording], metadata: Metadata
    ) -> None:
        """Keep a finished sequence of a pass: one recording, or those of its restarts."""
        path = self._file(name, sequence)
        _made(path.parent)
        in_order = sorted(recordings, key=lambda recording: recording.name)
        write_trace(Trace(metadata, in_order), path)

    def traces(self, name: str) -> list[Trace]:
        """The finished sequences of a pass, sorted by name."""
        traces = map(read_trace, (self._folder / name).glob(_SEQUENCES))
        return sorted(traces, key=lambda trace: trace.names)

    def remove(self) -> None:
        """Remove the folder: all of it is in traces now."""
        shutil.rmtree(self._folder)

    def _file(self, name: str, sequence: str) -> Path:
        return self._folder / name / f"{text_digest(sequence)}.parquet"


def _made(folder: Path) -> bool:
    """Make a folder; whether it was not there yet."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    except OSError as error:
        raise LaeError(f"cannot make the folder {folder}: {error.strerror or error}") from error
    return True
