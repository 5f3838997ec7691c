"""Any program that speaks TraX, the protocol of the VOT challenge (extra ``trax``).

It is started by its command, or as a registry of the VOT toolkit names it, a ``trackers.ini``.

L. Čehovin, "TraX: The visual Tracking eXchange protocol and library", Neurocomputing 260 (2017).
"""

from __future__ import annotations

import configparser
import contextlib
import glob
import os
import re
import select
import shlex
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from typing import Any, Mapping

import numpy as np

from lae_sim.errors import LaeError, hint, install, listed, one_line, shown
from lae_sim.trackers.protocol import Box, Image, Output, box_of

FOLDER = "lae-sim-trax-"
PATIENCE_S = 1.0

INI = "trackers.ini"
"""The registry of a workspace, in its folder."""

PROTOCOLS = ("trax", "traxpython")

_MODULE = re.compile(r"[a-zA-Z_][a-zA-Z0-9_.]*")
_SECONDS = re.compile(r"0*[1-9][0-9]{0,8}")
_YES = ("true", "1", "t", "y", "yes")


def trax_program(command: str, **parameters: Any) -> Trax:
    """A program that speaks TraX, by its command.

    Args:
        command: the program and its arguments, as in a shell but without one; ``env X=1 command``
            sets a variable.
        parameters: given to the program at each initialisation, as text.

    Raises:
        LaeError: as of `Trax`.
    """
    return Trax(Program(f"trax:{command}", command), parameters)


def vot_tracker(name: str, ini: str = INI, **parameters: Any) -> Trax:
    """A tracker that a registry names.

    Args:
        name: its section, which may be followed by ``@VERSION``, as the toolkit has it.
        ini: the registry, or the folder that holds it.
        parameters: given to the program at each initialisation, as text, with the entry's
            ``arg_*``.

    Raises:
        LaeError: as of `find_entry`, `Entry.program` and `Trax`.
    """
    entry = find_entry(name, ini)
    return Trax(entry.program(), {**entry.part("arg_"), **parameters})


def find_entry(name: str, ini: str = INI) -> Entry:
    """What a registry says of a tracker.

    Args:
        name, ini: as of `vot_tracker`.

    Raises:
        LaeError: if there is no such file, it is damaged, or it has no such tracker.
    """
    path = str(ini)
    if os.path.isdir(path):
        path = os.path.join(path, INI)
    registry = _read(path)
    section, version = name, None
    if name not in registry.sections():
        section, _, version = name.partition("@")
    if section not in registry.sections():
        there = registry.sections()
        are = f"there are {listed(there, 20)}" if there else "it names none"
        raise LaeError(f"{path}: no tracker {shown(section)}: {are}{hint(section, there)}")
    try:
        values = dict(registry[section])
    except configparser.Error as error:
        raise LaeError(f"{path}: [{section}]: {one_line(str(error))}") from error
    if version:
        values["version"] = version
    return Entry(path, section, values)


def _read(path: str) -> configparser.ConfigParser:
    registry = configparser.ConfigParser()
    try:
        with open(path, encoding="utf-8-sig") as file:
            registry.read_file(file, path)
    except FileNotFoundError as error:
        raise LaeError(
            f"{path}: no such file: name a registry of the VOT toolkit (option ini)"
        ) from error
    except OSError as error:
        raise LaeError(f"{path}: {error.strerror}") from error
    except (configparser.Error, ValueError) as error:
        reason = one_line(str(error))
        raise LaeError(f"{path}: not a trackers.ini of the VOT toolkit: {reason}") from error
    return registry


@dataclass(frozen=True)
class Program:
    """How a program that speaks TraX is started.

    Attributes:
        name: what messages call it.
        command: the program and its arguments, as in a shell but without one.
        environment: variables beside those of this process.
        folder: where it runs; None is the current one.
        lasting: whether it can take more than one sequence.
        facts: what is said of it in a trace, such as its version.
    """

    name: str
    command: str
    environment: Mapping[str, str] = field(default_factory=dict)
    folder: str | None = None
    lasting: bool = True
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Entry:
    """A tracker of a registry.

    Attributes:
        ini: the registry's path.
        name: the tracker's section.
        values: what it says, as text.
    """

    ini: str
    name: str
    values: Mapping[str, str]

    @property
    def timeout(self) -> int | None:
        """Seconds that the tracker may take for an answer; None where it does not say.

        Raises:
            LaeError: if that is no whole number of seconds from 1.
        """
        value = self.values.get("timeout")
        if value is None:
            return None
        if not _SECONDS.fullmatch(value):
            raise self._wrong(f"timeout: {shown(value)} is no whole number of seconds from 1")
        return int(value)

    def part(self, prefix: str) -> dict[str, str]:
        """The values whose names have a prefix, by what follows it, in small letters."""
        size = len(prefix)
        named = self.values.items()
        return {k[size:]: v for k, v in named if k.startswith(prefix) and len(k) > size}

    def program(self) -> Program:
        """How the toolkit starts it; but it runs in the registry's folder.

        Raises:
            LaeError: if it has no command, or a protocol that is not of TraX.
        """
        protocol, command = self.values.get("protocol", ""), self.values.get("command", "")
        if protocol not in PROTOCOLS:
            wrong = f"protocol {shown(protocol)} is not supported" if protocol else "no protocol"
            raise self._wrong(f"{wrong}: there are {' and '.join(PROTOCOLS)}")
        if not command:
            raise self._wrong("no command")
        environment = {k.upper(): os.path.expandvars(v) for k, v in self.part("env_").items()}
        if protocol == "traxpython":
            paths = self._paths("paths") or [self._home]
            command = _python(command, paths, self.values.get("python"))
            environment["PYTHONPATH"] = _joined(*paths, _variable("PYTHONPATH", environment))
            environment["PYTHONUNBUFFERED"] = "1"
        if "linkpaths" in self.values:
            own = _variable("LD_LIBRARY_PATH", environment)
            environment["LD_LIBRARY_PATH"] = _joined(own, *self._paths("linkpaths"))
        said = {key: one_line(value) for key, value in self.values.items()}
        facts = {
            "name": said.get("label") or self.name,
            "settings": {"ini": self.ini, "section": self.name, "entry": said},
        }
        if "version" in said:
            facts["version"] = said["version"]
        return Program(
            f"{self.ini}: [{self.name}]",
            command,
            environment,
            self._home,
            lasting=self.values.get("restart", "").lower() not in _YES,
            facts=facts,
        )

    @property
    def _home(self) -> str:
        """The registry's folder."""
        return os.path.dirname(os.path.abspath(self.ini))

    def _paths(self, key: str) -> list[str]:
        """The folders of a list, from the registry's own."""
        paths = filter(None, self.values.get(key, "").split(os.pathsep))
        return [os.path.normpath(os.path.join(self._home, path)) for path in paths]

    def _wrong(self, what: str) -> LaeError:
        return LaeError(f"{self.ini}: [{self.name}]: {what}")


def _python(command: str, paths: list[str], python: str | None) -> str:
    """The command for Python that runs a module by its name, or code."""
    interpreter = python or shlex.quote(sys.executable)
    if _MODULE.fullmatch(command):
        return f"{interpreter} -m {command}"
    code = f"import sys; sys.path[:0] = {paths!r}; {command}"
    return f"{interpreter} -c {shlex.quote(code)}"


def _variable(name: str, environment: Mapping[str, str]) -> str:
    return environment.get(name, os.environ.get(name, ""))


def _joined(*folders: str) -> str:
    return os.pathsep.join(filter(None, folders))


class Trax:
    """A program that speaks TraX, on whatever interpreter and libraries it is started with.

    Frames are handed over as BMP files in shared memory; the time of a call includes writing and
    reading one. The program stays over sequences. One that ends with its first, as those made with
    the VOT wrapper do, is started again for each, by `prepare`. That wrapper also answers before
    its tracker has seen the first frame, so ``init`` has it track that frame once.

    Args:
        program: how it is started.
        parameters: given to the program at each initialisation, as text.

    Raises:
        LaeError: if the program does not start, or ends without speaking TraX; by each method, if
            the program ends. The next ``init`` then starts it again.
    """

    def __init__(self, program: Program, parameters: Mapping[str, Any]) -> None:
        try:
            import trax.client
        except ImportError as error:
            raise LaeError(f"TraX is missing ({error}): {install('trax')}") from error
        self._trax: Any = trax
        self._program = program
        self._parameters = {name: str(value) for name, value in parameters.items()}
        self._client: Any = None
        self._fresh, self._lasting = False, program.lasting
        self._session = contextlib.ExitStack()
        self._folder = _folder()
        self._bitmaps: list[tuple[str, Any]] = []
        self._shape: tuple[int, ...] = ()
        try:
            self.prepare()
        except BaseException:
            self.close()
            raise

    def prepare(self) -> None:
        """Start the program unless it is ready for ``init``, which does it too but is timed."""
        if self._client is None or not (self._fresh or self._lasting):
            self._end()
            self._start()

    def init(self, frame: Image, box: Box) -> None:
        """Start on a new sequence."""
        self.prepare()
        fresh, self._fresh = self._fresh, False
        region = self._trax.Rectangle.create(*box)
        images = self._hand_over(frame)
        try:
            self._ask(self._client.initialize, images, [(region, {})], self._parameters)
        except LaeError:
            if fresh:
                raise
            self.init(frame, box)
            self._lasting = False  # what a new process does, the old one could not
            return
        if self._wrapped:
            self._ask(self._client.frame, images, {}, [])

    def track(self, frame: Image) -> Output:
        """Find the target in the next frame."""
        if self._client is None:
            raise LaeError(f"{self._program.name} must be initialised first")
        region, properties = self._ask(self._client.frame, self._hand_over(frame), {}, [])
        box = _box(region)
        try:
            return box and (box, float(properties["confidence"]))
        except (KeyError, ValueError):
            return box

    def describe(self) -> dict[str, Any]:
        """What the program says of itself, and how it was started."""
        from importlib.metadata import version

        facts = dict(self._program.facts)
        settings = {"command": self._program.command, **facts.pop("settings", {})}
        return {
            **self._description,
            **facts,
            "settings": {**settings, **self._parameters},
            "libraries": {"trax": version("vot-trax")},
        }

    def close(self) -> None:
        """End the program."""
        self._end()
        self._bitmaps, self._shape = [], ()
        self._folder.cleanup()

    def _start(self) -> None:
        with socket.socket() as listener:  # not its standard output, on which it may print
            listener.bind(("127.0.0.1", 0))
            listener.listen(1)
            port = str(listener.getsockname()[1])
            self._log = self._session.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
            try:
                self._process = subprocess.Popen(
                    shlex.split(self._program.command),
                    cwd=self._program.folder,
                    stdin=subprocess.DEVNULL,
                    stdout=self._log,
                    stderr=self._log,
                    env={
                        **os.environ,
                        **self._program.environment,
                        "TRAX": "1",
                        "TRAX_SOCKET": port,
                    },
                )
            except (OSError, ValueError, IndexError) as error:
                raise LaeError(f"{self._program.name} does not start: {error}") from error
            self._session.callback(_end, self._process)
            while not select.select([listener], [], [], 0.05)[0]:
                if self._process.poll() is not None:
                    raise self._failure("it did not speak TraX")
            try:
                client = self._trax.client.Client(listener.fileno(), log=str)
            except self._trax.TraxException as error:
                raise self._failure(str(error)) from error
        self._session.callback(client.quit)  # without it, the library's own clean-up crashes
        self._client, self._fresh = client, True
        self._wrapped = client.get("vot") is not None
        self._lasting = self._lasting and not self._wrapped
        texts = {k: getattr(client, f"tracker_{k}") for k in ("name", "family", "description")}
        self._description = {key: text for key, text in texts.items() if text}

    def _hand_over(self, frame: Image) -> dict[str, Any]:
        """The frame as the program takes it; a file stays as it is until the frame after next."""
        if self._trax.Image.PATH not in self._client.image_formats:
            return {"color": self._trax.MemoryImage.create(frame[:, :, ::-1])}
        if frame.shape != self._shape:
            paths = [os.path.join(self._folder.name, name) for name in ("even.bmp", "odd.bmp")]
            self._bitmaps = [(path, _bitmap(path, *frame.shape[:2])) for path in paths]
            self._shape = frame.shape
        self._bitmaps.reverse()
        path, rows = self._bitmaps[0]
        rows[:] = frame.reshape(rows.shape)
        return {"color": self._trax.FileImage.create(path)}

    def _ask(self, call: Any, *arguments: Any) -> tuple[Any, dict[str, str]]:
        """The first region, and its properties, that the program answers with."""
        try:
            objects, _ = call(*arguments)
            if not objects:
                raise self._trax.TraxException("no answer")
        except self._trax.TraxException as error:
            raise self._failure(str(error)) from error
        except BaseException:  # the answer would be taken for that of the next call
            self._end()
            raise
        region: tuple[Any, dict[str, str]] = objects[0]
        return region

    def _failure(self, reason: str) -> LaeError:
        """End the program; why."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            reason = f"it ended with status {self._process.wait(PATIENCE_S)} ({reason})"
        self._log.seek(max(self._log.seek(0, os.SEEK_END) - 1000, 0))
        lines = self._log.read().decode(errors="replace").split("\n")
        printed = [line.strip() for line in lines if line.strip()]
        self._end()
        return LaeError(": ".join([self._program.name, reason, *printed[-1:]]))

    def _end(self) -> None:
        self._client = None
        self._session.close()


def _bitmap(path: str, height: int, width: int) -> Any:
    """Make a BMP file; its rows from the top, uint8 [height, 3 * width], to write frames to."""
    stride = (3 * width + 3) // 4 * 4
    file: Any = np.memmap(path, np.uint8, "w+", shape=(54 + height * stride,))
    sizes = file.size, 0, 54, 40, width, height, 1, 24, 0, height * stride, 2835, 2835, 0, 0
    file[:54] = np.frombuffer(b"BM" + struct.pack("<IIIIiiHHIIiiII", *sizes), np.uint8)
    return file[54:].reshape(height, stride)[::-1, : 3 * width]


def _box(region: Any) -> tuple[float, float, float, float] | None:
    """The box around a region; None for one that is empty or special."""
    if region.type == "rectangle":
        x, y, w, h = region.bounds()
    elif region.type == "polygon":
        points = np.array(list(region))
        (x, y), (w, h) = points.min(axis=0), np.ptp(points, axis=0)
    elif region.type == "mask":
        within = box_of(region.array())
        if within is None:
            return None
        (left, top), (x, y, w, h) = region.offset(), within
        x, y = x + left, y + top
    else:
        return None
    return (float(x), float(y), float(w), float(h)) if w > 0 and h > 0 else None


def _folder() -> Any:
    """A folder in shared memory; those of processes that were killed are removed."""
    for old in glob.glob(f"/dev/shm/{FOLDER}*"):
        if not os.path.exists(f"/proc/{old.split('-')[-2]}"):
            shutil.rmtree(old, ignore_errors=True)
    parent = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    return tempfile.TemporaryDirectory(prefix=f"{FOLDER}{os.getpid()}-", dir=parent)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait a moment for a process that was told to end, then kill it."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE_S)
    process.kill()
    process.wait()
