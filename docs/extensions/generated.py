"""Pages that are made of the program itself: the HTTP API, the command line, and the README.

They are written below ``docs/generated`` before Sphinx reads its sources.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import typer

from service.app import create_app
from service.cli import app as command_line
from service.problems import CATALOGUE
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ROOT / "docs" / "generated"
_METHODS = ("get", "head", "post", "put", "patch", "delete", "options")

_ABOUT_HTTP = """\
Made from the OpenAPI document that a server has at `/openapi.json`; at `/docs` it can be tried out.
Errors are problem documents (RFC 9457): their [types](#problem-types) are stable. Where the service
needs an API key, it is sent as `Authorization: Bearer`."""

_Schema = dict[str, Any]


def _cell(text: object) -> str:
    """Return text as it may stand in a cell of a table."""
    return " ".join(str(text or "").split()).replace("|", "\\|")


def _type(schema: _Schema) -> str:
    """Describe a JSON Schema in a few words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#schema-{name.lower()})"
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(_type(one) for one in schema[key])
    kind = schema.get("type", "any")
    if kind == "array":
        return f"array of {_type(schema.get('items', {}))}"
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"object of {_type(schema['additionalProperties'])}"
    return f"{kind} ({schema['format']})" if "format" in schema else str(kind)


def _members(schema: _Schema) -> Iterator[str]:
    required = set(schema.get("required", ()))
    yield "| member | type | meaning |\n|---|---|---|"
    for name, member in schema.get("properties", {}).items():
        shown = f"`{name}`" + (" (required)" if name in required else "")
        yield f"| {shown} | {_cell(_type(member))} | {_cell(member.get('description'))} |"


def _operation(path: str, method: str, operation: _Schema) -> Iterator[str]:
    yield f"### {method.upper()} {path}".replace("{", "\\{")
    yield f"**{operation.get('summary', '')}**"
    if operation.get("description"):
        yield operation["description"]
    parameters = operation.get("parameters", ())
    if parameters:
        rows = [
            f"| `{one['name']}` | {one['in']} | {_cell(_type(one.get('schema', {})))} "
            f"| {_cell(one.get('description'))} |"
            for one in parameters
        ]
        yield "\n".join(["| parameter | in | type | meaning |\n|---|---|---|---|", *rows])
    for media, content in operation.get("requestBody", {}).get("content", {}).items():
        schema = content.get("schema", {})
        yield f"Body, `{media}`: {_type(schema) if '$ref' in schema else ''}"
        if schema.get("properties"):
            yield "\n".join(_members(schema))
    yield "\n".join(_answers(operation.get("responses", {})))


def _answers(responses: Mapping[str, _Schema]) -> Iterator[str]:
    yield "| answer | body | meaning |\n|---|---|---|"
    for status, answer in responses.items():
        if status == "default":
            continue
        content = answer.get("content", {})
        if "application/problem+json" in content:
            slugs = answer["description"].split(", ")
            meaning = ", ".join(
                f"[{slug}](#problem-{slug})" if slug in CATALOGUE else slug for slug in slugs
            )
            yield f"| {status} | problem | {_cell(meaning)} |"
            continue
        bodies = [
            _type(found["schema"]) if "$ref" in found.get("schema", {}) else f"`{media}`"
            for media, found in content.items()
        ]
        yield f"| {status} | {_cell(', '.join(bodies))} | {_cell(answer.get('description'))} |"


def http_page() -> str:
    """Return the reference of the HTTP API, from its OpenAPI document and the problem types."""
    with TemporaryDirectory() as folder:
        settings = Settings(data_dir=Path(folder), redis_url="redis://127.0.0.1:1")
        document = create_app(settings).openapi()
    parts = [
        "# HTTP API",
        _ABOUT_HTTP,
    ]
    by_tag: dict[str, list[str]] = {}
    for path, operations in document["paths"].items():
        for method in _METHODS:
            if method in operations:
                operation = operations[method]
                tag = operation.get("tags", ["other"])[0]
                by_tag.setdefault(tag, []).extend(_operation(path, method, operation))
    for tag, operations in by_tag.items():
        parts += [f"## {tag.capitalize()}", *operations]
    parts.append("## Documents")
    for name, schema in sorted(document["components"]["schemas"].items()):
        parts += [f"(schema-{name.lower()})=\n### {name}", schema.get("description", "")]
        parts.append("\n".join(_members(schema)) if "properties" in schema else _type(schema))
    parts.append("## Problem types")
    for slug, kind in sorted(CATALOGUE.items()):
        parts.append(f"(problem-{slug})=\n### {slug}")
        parts.append(f"{kind.status}, **{kind.title}.** {kind.meaning} *{kind.remedy}*")
    return "\n\n".join(parts) + "\n"


def _command(command: Any, path: str, depth: int) -> Iterator[str]:
    """Write a command and those below it; typer's own copy of Click has no public name."""
    context = command.context_class(command, info_name=path)
    yield f"{'#' * depth} {path}"
    if command.help:
        yield inspect.cleandoc(command.help)
    subcommands = getattr(command, "commands", None)
    pieces = " ".join(command.collect_usage_pieces(context))
    yield f"```text\n{path} {pieces}\n```"
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is None or "--help" in parameter.opts:
            continue
        name, text = record
        name = re.sub(r" <.*>$", "", name)  # the type of an argument, as Python writes it
        rows.append(f"| `{_cell(name)}` | {_cell(text)} |")
    if rows:
        yield "\n".join(["| option | meaning |\n|---|---|", *rows])
    for name, sub in (subcommands or {}).items():
        yield from _command(sub, f"{path} {name}", depth + 1)


def command_page() -> str:
    """Return the reference of the command line."""
    command = typer.main.get_command(command_line)
    parts = [
        "# Command line",
        *_command(command, "smsr", 2),
        inspect.cleandoc(command.epilog or ""),
    ]
    # Brackets of Rich's markup are not Markdown's links.
    return re.sub(r"\[(default|env var|required)", r"\\[\1", "\n\n".join(parts)) + "\n"


def copied(name: str) -> str:
    """Return a page of the root, with its links as seen from ``docs/generated``."""
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"\]\(docs/", "](../", text)
    return re.sub(r"\]\((CONTRIBUTING|CHANGELOG)\.md", lambda m: f"]({m[1].lower()}.md", text)


def pages() -> dict[str, str]:
    """Return the text of each generated page by its name."""
    return {
        "http.md": http_page(),
        "command-line.md": command_page(),
        "readme.md": copied("README.md"),
        "contributing.md": copied("CONTRIBUTING.md"),
        "changelog.md": copied("CHANGELOG.md"),
    }


def write(_: Sphinx) -> None:
    """Write the pages, touching only those that changed."""
    GENERATED.mkdir(exist_ok=True)
    for name, text in pages().items():
        path = GENERATED / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def mend_links(_: Sphinx, __: str, source: list[str]) -> None:
    """Lead links from a page to the README to its copy in the site."""
    source[0] = source[0].replace("](../README.md", "](generated/readme.md")


def setup(app: Sphinx) -> dict[str, bool]:
    """Have the pages written before sources are looked for."""
    app.connect("builder-inited", write)
    app.connect("source-read", mend_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
