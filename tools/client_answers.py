"""Write the types of the client's answers from what /openapi.json says of them.

    .venv/bin/python -m tools.client_answers

Each model of an answer becomes a TypedDict, so that a type checker knows what ``client.status()["joints"]``
is, and the client still loads nothing but the standard library for it. What is written is committed; a test
asks whether it still comes of its source.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import Any

from mastctl.web.described import answer_schemas
from tools.arguments import end
from tools.async_client import FOLDER, tidy

TARGET = FOLDER / "answers.py"
HEAD = '''# Made by tools/client_answers.py; what is to be changed is changed in mastctl/web/answers.py.
"""What a daemon answers, as a type checker reads it; made from what /openapi.json says."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

'''
PLAIN = {"string": "str", "number": "float", "integer": "int", "boolean": "bool", "null": "None"}


def written() -> str:
    """Return the module."""
    schemas = answer_schemas()
    forms = {name: one for name, one in schemas.items() if "properties" in one}
    unions = {name: one for name, one in schemas.items() if name not in forms}
    classes = [line for name, one in forms.items() for line in _class(name, one)]
    aliases = [f"{name} = {_type(one)}\n" for name, one in unions.items()]
    return tidy(HEAD + "\n".join([*classes, *aliases]))


def _class(name: str, schema: Mapping[str, Any]) -> Iterator[str]:
    """The lines of one TypedDict."""
    yield f"class {name}(TypedDict):"
    yield (
        f'    """{schema["description"]}\n    """\n'
        if "\n" in schema["description"]
        else (f'    """{schema["description"]}"""\n')
    )
    for key, value in schema["properties"].items():
        kind = _type(value)
        yield f"    {key}: {kind if key in schema.get('required', ()) else f'NotRequired[{kind}]'}"
    yield "\n"


def _type(schema: Mapping[str, Any]) -> str:
    """The annotation of a value."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return " | ".join(dict.fromkeys(_type(one) for one in schema[several]))
    if "const" in schema:
        return f"Literal[{schema['const']!r}]"
    if "enum" in schema:
        return f"Literal[{', '.join(repr(one) for one in schema['enum'])}]"
    match schema.get("type"):
        case "array":
            return f"list[{_type(schema.get('items', {}))}]"
        case "object":
            inner = schema.get("additionalProperties")
            return f"dict[str, {_type(inner) if isinstance(inner, Mapping) else 'Any'}]"
        case None:
            return "Any"
        case plain:
            return PLAIN[plain]


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description="Write the types of the client's answers.").parse_args()
    TARGET.write_text(written())


if __name__ == "__main__":
    end(main)
