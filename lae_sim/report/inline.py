"""SVG files as part of a page: they follow its colours, and nothing in them runs or is fetched."""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.etree import ElementTree

_KEPT = {"svg", "g", "defs", "clipPath", "path", "rect", "use", "text", "tspan"}
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}\b")
_REFERENCE = re.compile(r"(?<=url\(#)[^)]+|(?<=^#).+")
_FRACTION = re.compile(r"(?<=\.\d\d)\d+")
_PIXELS = 4 / 3
"""Of a point."""
_PAGE, _INK = "#14181f", "#e4e8ef"
_CONTRAST = 4.5
"""Of colours on a dark page, at least: what WCAG 2.2 asks of text (AA)."""


def inlined(svg: bytes, label: str, prefix: str) -> str:
    """An SVG file of Matplotlib as an element of HTML, as wide as there is room for it.

    Each colour is a variable of CSS, ``--c0072b2``, with itself as the fallback.

    Args:
        svg: the file.
        label: what it shows, for those who do not see it.
        prefix: of its identifiers, which are to differ from all others of the page.
    """
    root = ElementTree.fromstring(svg)
    for parent in root.iter():
        parent.tag = parent.tag.rpartition("}")[2]
        parent[:] = [each for each in parent if each.tag.rpartition("}")[2] in _KEPT]
        parent.attrib = {key.rpartition("}")[2]: parent.attrib[key] for key in parent.attrib}
    referred = {
        name for each in root.iter() for value in each.attrib.values()
        for name in _REFERENCE.findall(value)
    }  # fmt: skip
    for each in root.iter():
        found = {}
        for key, value in each.attrib.items():
            if key == "id":
                if value in referred:
                    found[key] = f"{prefix}-{value}"
            elif key in ("d", "x", "y"):
                found[key] = _FRACTION.sub("", " ".join(value.split()))
            elif not key.startswith("on"):
                value = _REFERENCE.sub(lambda name: f"{prefix}-{name[0]}", value)
                found[key] = _COLOUR.sub(lambda colour: variable(colour[0]), value)
        each.attrib = found
    points = root.attrib["viewBox"].split()[2:]
    width, height = (str(round(float(end) * _PIXELS)) for end in points)
    root.attrib = {
        "xmlns": "http://www.w3.org/2000/svg",
        "viewBox": root.attrib["viewBox"],
        "width": width,
        "height": height,
        "stroke-linejoin": "round",
        "role": "img",
        "aria-label": label,
    }
    return ElementTree.tostring(root, "unicode")


def variable(colour: str) -> str:
    """The variable of CSS that stands for a colour ``"#rrggbb"``, itself being the fallback."""
    return f"var(--c{colour[1:].lower()}, {colour.lower()})"


def dark_colours(texts: Iterable[str]) -> dict[str, str]:
    """What the variables of all colours in some texts are on a dark page."""
    colours = dict.fromkeys(each.lower() for text in texts for each in _COLOUR.findall(text))
    return {f"--c{colour[1:]}": in_the_dark(colour) for colour in colours}


def in_the_dark(colour: str) -> str:
    """A colour on a dark page: as it is, or as much lighter as it takes to be seen as well.

    White and black, which are paper and ink, are those of the page.
    """
    if colour in ("#ffffff", "#000000"):
        return _PAGE if colour == "#ffffff" else _INK
    whiter = (f"#{''.join(f'{c + (255 - c) * k // 20:02x}' for c in bytes.fromhex(colour[1:]))}"
              for k in range(20))  # fmt: skip
    return next((each for each in whiter if contrast(each, _PAGE) >= _CONTRAST), "#ffffff")


def contrast(one: str, other: str) -> float:
    """The contrast ratio of two colours, 1 to 21 (WCAG 2.2)."""
    high, low = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: str) -> float:
    """The relative luminance of a colour, 0 to 1 (WCAG 2.2)."""
    parts = [c / 255 for c in bytes.fromhex(colour[1:])]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
