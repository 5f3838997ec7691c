"""What the adapters of other people's source checkouts share."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import types
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, install, one_line
from lae_sim.errors import explained as raised

_PACKAGES = {
    "cv2": "opencv-python",
    "yaml": "pyyaml",
    "PIL": "pillow",
}  # module -> what pip calls it


def existing(path: str | os.PathLike[str], what: str, folder: bool = False) -> Path:
    """The absolute path of a file or folder that is there.

    Raises:
        LaeError: if it is not.
    """
    try:
        absolute = Path(path).expanduser().resolve()
    except (OSError, RuntimeError, TypeError, ValueError) as error:  # none, or a loop of links
        raise LaeError(f"{path}: no path ({what}): {one_line(str(error))}") from error
    if not (absolute.is_dir() if folder else absolute.is_file()):
        raise LaeError(f"{absolute}: no such {'folder' if folder else 'file'} ({what})")
    return absolute


def torch_on(device: str) -> Any:
    """PyTorch, with ``device`` (``cpu``, ``cuda`` or ``cuda:N``) made its current one.

    Raises:
        LaeError: if PyTorch is not installed or has no such device.
    """
    try:
        import torch
    except ImportError as error:
        raise LaeError(f"this tracker needs PyTorch: {install('torch')}") from error
    kind, _, index = device.partition(":")
    if kind not in ("cpu", "cuda") or (index and not index.isdigit()):
        raise LaeError(f"device {device!r}: it is cpu, cuda or cuda:N")
    if kind == "cuda":
        if int(index or 0) >= torch.cuda.device_count():
            raise LaeError(f"device {device!r}: PyTorch {torch.__version__} finds no such device")
        torch.cuda.set_device(int(index or 0))
    return torch


def import_from(checkout: Path, module: str) -> types.ModuleType:
    """Import a module of a checkout.

    Raises:
        LaeError: if this process has imported a package of that name from elsewhere.
    """
    package = sys.modules.get(module.partition(".")[0])
    if package is not None:
        folders = [Path(folder).resolve() for folder in getattr(package, "__path__", [])]
        if all(folder.parent != checkout for folder in folders):
            raise LaeError(
                f"{checkout}: this process has imported another {package.__name__!r}; "
                "run each checkout in a process of its own"
            )
    if str(checkout) not in sys.path:
        sys.path.insert(0, str(checkout))
        importlib.invalidate_caches()
    return importlib.import_module(module)


@contextmanager
def explained(what: str) -> Iterator[None]:
    """As :func:`lae_sim.errors.explained`, and name the package of a missing module."""
    with raised(what):
        try:
            yield
        except ModuleNotFoundError as error:
            module = (error.name or "").partition(".")[0]
            package = _PACKAGES.get(module, module)
            raise LaeError(f"{what}: it needs {module}: pip install {package}") from error


@contextmanager
def replaced(*items: tuple[Any, str, Any]) -> Iterator[None]:
    """Set attributes, given as (owner, name, value), for a while."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in items]
    for owner, name, value in items:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


class _Attributes(type):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Attributes(name, (_Inert,), {})


class _Inert(metaclass=_Attributes):
    """A class of a package that is not installed; it can be subclassed and made."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass


class _StandIn(types.ModuleType):
    def __getattr__(self, name: str) -> Any:
        return getattr(_Inert, name)


class _Finder(MetaPathFinder, Loader):
    def __init__(self, names: Sequence[str]) -> None:
        self.names = names

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if fullname.partition(".")[0] not in self.names:
            return None
        return ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: ModuleSpec) -> types.ModuleType:
        return _StandIn(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        pass


@contextmanager
def stand_ins(names: Sequence[str]) -> Iterator[list[str]]:
    """Empty modules in place of those of ``names`` that are not installed.

    Checkouts import drawing, annotation and data set packages that tracking never calls. Yields
    the names that stand-ins are given for.
    """
    absent = [n for n in names if n not in sys.modules and importlib.util.find_spec(n) is None]
    finder = _Finder(absent)
    sys.meta_path.append(finder)
    try:
        yield absent
    finally:
        sys.meta_path.remove(finder)


def commit(checkout: Path) -> str | None:
    """The git commit that is checked out in a folder, read from its ``.git``; None without one."""
    try:
        git = checkout / ".git"
        if git.is_file():  # a submodule or a further work tree: "gitdir: PATH"
            git = checkout / git.read_text("utf-8").partition(":")[2].strip()
        head = (git / "HEAD").read_text("utf-8").strip()
        if not head.startswith("ref:"):
            return head
        name = head.partition(":")[2].strip()
        common = git / "commondir"  # refs of a further work tree lie in the main one's folder
        folders = [git, git / common.read_text("utf-8").strip()] if common.is_file() else [git]
        for folder in folders:
            if (folder / name).is_file():
                return (folder / name).read_text("utf-8").strip()
            packed = folder / "packed-refs"
            for line in packed.read_text("utf-8").splitlines() if packed.is_file() else ():
                if line.endswith(" " + name):
                    return line.split()[0]
    except (OSError, ValueError):
        pass
    return None
