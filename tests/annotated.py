"""Files of annotations."""

from __future__ import annotations

from pathlib import Path

BOXES = "10,20,30,40\n11,21,30,40\n"


def make(root: Path, *files: str, text: str = BOXES) -> Path:
    """Write a text to files below a folder, and give the folder."""
    for file in files:
        path = root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root
