"""Trackers of a registry of the VOT toolkit: what a ``trackers.ini`` names, over TraX.

The file has a section for each tracker, as `vot.tracker.Registry` of that toolkit reads it:

    [NCCPython]
    label = PyNCC
    protocol = traxpython
    command = python_ncc
    paths = /home/me/trackers/ncc
    env_CUDA_VISIBLE_DEVICES = 0

What the toolkit ignores for TraX is ignored here too (tags, ``meta_*``, storage). TraX goes through
a socket always, so ``socket`` says nothing here.
"""

from __future__ import annotations

import configparser
import os
import re
import shlex
import sys
from dataclasses import dataclass
from typing import Any, Mapping

from lae_sim.errors import LaeError, hint, listed, one_line, shown
from lae_sim.trackers.trax import Program, Trax

INI = "trackers.ini"
"""The registry of a workspace, in its folder."""

PROTOCOLS = ("trax", "traxpython")

_MODULE = re.compile(r"[a-zA-Z_][a-zA-Z0-9_.]*")
_SECONDS = re.compile(r"0*[1-9][0-9]{0,8}")
_YES = ("true", "1", "t", "y", "yes")


def vot_tracker(name: str, ini: str = INI, **parameters: Any) -> Trax:
    """A tracker that a registry names.

    Args:
        name: its section, which may be followed by ``@VERSION``, as the toolkit has it.
        ini: the registry, or the folder that holds it.
        parameters: given to the program at each initialisation, as text, with the entry's
            ``arg_*``.

    Raises:
        LaeError: as of `find_entry`, `Entry.program` and `lae_sim.trackers.trax.Trax`.
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
        raise LaeError(f"{path}: no such file: ini is a registry of the VOT toolkit") from error
    except OSError as error:
        raise LaeError(f"{path}: {error.strerror}") from error
    except (configparser.Error, ValueError) as error:
        reason = one_line(str(error))
        raise LaeError(f"{path}: not a trackers.ini of the VOT toolkit: {reason}") from error
    return registry


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
            paths = self._paths("paths") or [self._folder]
            command = _python(command, paths, self.values.get("python"))
            environment["PYTHONPATH"] = _joined(*paths, _value("PYTHONPATH", environment))
            environment["PYTHONUNBUFFERED"] = "1"
        if "linkpaths" in self.values:
            own = _value("LD_LIBRARY_PATH", environment)
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
            self._folder,
            lasting=self.values.get("restart", "").lower() not in _YES,
            facts=facts,
        )

    @property
    def _folder(self) -> str:
        return os.path.dirname(os.path.abspath(self.ini))

    def _paths(self, key: str) -> list[str]:
        """The folders of a list, from the registry's own."""
        paths = filter(None, self.values.get(key, "").split(os.pathsep))
        return [os.path.normpath(os.path.join(self._folder, path)) for path in paths]

    def _wrong(self, what: str) -> LaeError:
        return LaeError(f"{self.ini}: [{self.name}]: {what}")


def _python(command: str, paths: list[str], python: str | None) -> str:
    """The command for Python that runs a module by its name, or code."""
    interpreter = python or shlex.quote(sys.executable)
    if _MODULE.fullmatch(command):
        return f"{interpreter} -m {command}"
    code = f"import sys; sys.path[:0] = {paths!r}; {command}"
    return f"{interpreter} -c {shlex.quote(code)}"


def _value(name: str, environment: Mapping[str, str]) -> str:
    return environment.get(name, os.environ.get(name, ""))


def _joined(*folders: str) -> str:
    return os.pathsep.join(filter(None, folders))
