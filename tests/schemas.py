"""The JSON Schemas of what commands print, as strict as a test wants them."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator
from places import REPOSITORY
from referencing import Registry, Resource

FOLDER = REPOSITORY / "docs" / "reference" / "schemas"


@cache
def schemas() -> dict[str, Any]:
    """All of them by the name of their file."""
    return {path.name: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.json")}


def closed(schema: Any) -> Any:
    """A schema that allows no key which it does not describe.

    Those of the files do: a later version may add keys, and each must then be described.
    """
    if isinstance(schema, dict):
        least = {"additionalProperties": False} if schema.get("type") == "object" else {}
        made = {key: closed(value) for key, value in schema.items()}
        return {**least, **made} if "properties" in made else made
    return [closed(each) for each in schema] if isinstance(schema, list) else schema


@cache
def validator(name: str) -> Draft202012Validator:
    """What checks a document of a command by its name, such as ``"replay"``."""
    made = {file: closed(schema) for file, schema in schemas().items()}
    resources = [(file, Resource.from_contents(schema)) for file, schema in made.items()]
    return Draft202012Validator(
        made[f"{name}.schema.json"], registry=Registry().with_resources(resources)
    )


def check(document: Any, name: str) -> None:
    """Assert that a document is as the schema says."""
    errors = [f"{each.json_path}: {each.message}" for each in validator(name).iter_errors(document)]
    assert not errors, "\n".join(errors[:5])
