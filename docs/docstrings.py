"""How docstrings become Markdown: examples are code, and what Sphinx would link is linked."""

from __future__ import annotations

import re
from typing import Any

import griffe

import lae_sim

ROLE = re.compile(r":[a-z]+:`~?\.?([\w.]+)`")


class Docstrings(griffe.Extension):
    """Writes the docstrings anew before they are parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Write those of one object."""
        if obj.docstring:
            text = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = ROLE.sub(reference, text)


def reference(role: re.Match[str]) -> str:
    """The name, linked if it is one that ``lae_sim`` shows."""
    name = role[1].rpartition(".")[2]
    return f"[`{name}`][lae_sim.{name}]" if name in lae_sim.__all__ else f"`{role[1]}`"
