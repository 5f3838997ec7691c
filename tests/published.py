"""A made-up public repository with results and ground truth, recipes for it, and its server."""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import patch
from zipfile import ZipFile

from lae_sim.recipes.catalogue import Recipe, list_recipes

COMMIT = "0123456789abcdef0123456789abcdef01234567"
ROOT = f"someone/results/{COMMIT}"
SEQUENCES = ("bike", "boat", "car")
FRAMES = 20


def publish(folder: Path) -> Path:
    """Lay out what the repository holds as a mirror has it; the mirror's folder."""
    mirror = folder / "mirror"
    root = mirror / ROOT
    for name in ("anno", "kcf/times"):
        (root / name).mkdir(parents=True)
    for number, sequence in enumerate(SEQUENCES):
        truth = [f"{10 + 3 * i},{20 + number},30,40" for i in range(FRAMES)]
        boxes = [f"{12 + 3 * i},{20 + number},30,40" for i in range(FRAMES)]
        (root / "anno" / f"{sequence.title()}.txt").write_text("\n".join(truth) + "\n", "utf-8")
        (root / "kcf" / f"{sequence}.txt").write_text("\n".join(boxes) + "\n", "utf-8")
        times = "\n".join(["0.500", *["0.020"] * (FRAMES - 1)])
        (root / "kcf" / "times" / f"{sequence}_time.txt").write_text(times + "\n", "utf-8")
    with ZipFile(root / "nano.zip", "w") as archive:
        for sequence in SEQUENCES:
            archive.write(root / "kcf" / f"{sequence}.txt", f"All/DTB/nano/{sequence}.txt")
        archive.writestr("All/DTB/nano/pictures/car.txt", "no box")
        archive.writestr("All/DTB/other/car.txt", "1,2,3,4")
    return mirror


def write_recipes(folder: Path, mirror: Path) -> Path:
    """Recipes for all that a mirror holds, ``made-up/kcf`` and ``made-up/nano``; their folder."""
    recipes = folder / "recipes"
    (recipes / "digests").mkdir(parents=True)
    root = mirror / ROOT
    lines = ["# a comment"]
    for folder in (root, root / "anno", root / "kcf", root / "kcf" / "times"):
        lines += [f"{folder.relative_to(root).as_posix()}/"] if folder != root else []
        for path in sorted(file for file in folder.iterdir() if file.is_file()):
            content = path.read_bytes()
            renamed = f" {path.name.lower()}" if folder.name == "anno" else ""
            digest = hashlib.sha256(content).hexdigest()
            lines.append(f"{digest} {len(content)} {path.name}{renamed}")
    (recipes / "digests" / "results.txt").write_text("\n".join(lines) + "\n", "utf-8")
    (recipes / "repositories.toml").write_text(
        f"""
[results]
url = "https://github.com/someone/results"
commit = "{COMMIT}"
licence = "CC BY 4.0"
citation = "Someone, Results, 2020"
device = "a desk"
""",
        "utf-8",
    )
    (recipes / "made-up.toml").write_text(
        """
name = "MadeUp"
sequences = 3
fps = "30"
citation = "Another, A Dataset, 2019"
truth = { repository = "results", path = "anno/" }

[trackers.kcf]
name = "KCF"
times = "frame"
boxes = { repository = "results", path = "kcf/" }
auc = 0.8571
dp20 = 1.0

[trackers.nano]
name = "Nano"
times = "none"
boxes = { repository = "results", path = "nano.zip", inside = "All/DTB/nano/" }
auc = 0.8571
dp20 = 1.0
""",
        "utf-8",
    )
    return recipes


def made_up(folder: Path) -> tuple[Path, tuple[Recipe, ...]]:
    """A mirror, and the recipes for what it holds: ``kcf`` and ``nano``."""
    mirror = publish(folder)
    return mirror, list_recipes(write_recipes(folder, mirror))


@dataclass
class Server:
    """A server of a mirror.

    Attributes:
        url: where it is.
        asked: the paths that it was asked for.
        broken: names of files of which it sends a half, and then closes the connection.
        busy: names of files that it has no time for.
    """

    url: str = ""
    asked: list[str] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)
    busy: set[str] = field(default_factory=set)


@contextlib.contextmanager
def served(mirror: Path) -> Iterator[Server]:
    """Serve a mirror on this machine."""
    server = Server()

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            server.asked.append(self.path)
            name = self.path.rpartition("/")[2]
            if name in server.busy:
                self.send_error(503)
            elif name in server.broken:
                content = (mirror / self.path.lstrip("/")).read_bytes()
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[: len(content) // 2])
                self.close_connection = True
            else:
                super().do_GET()

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    make: Callable[..., Handler] = partial(Handler, directory=str(mirror))
    here = patch.dict(os.environ, NO_PROXY="127.0.0.1", no_proxy="127.0.0.1")
    with here, ThreadingHTTPServer(("127.0.0.1", 0), make) as http:
        thread = threading.Thread(target=http.serve_forever, daemon=True)
        thread.start()
        server.url = f"http://127.0.0.1:{http.server_address[1]}"
        try:
            yield server
        finally:
            http.shutdown()
            thread.join()
