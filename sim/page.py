"""Pages of reports: one look for all, self-contained, with neither script nor network. ``page.html`` and ``page.css`` are the frame."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

import jinja2

from sim.errors import InputError

_MEDIA = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".svg": "image/svg+xml", ".mp4": "video/mp4"}


def words(value: object) -> str:
    """A JSON value for reading: lists by commas, mappings as "key value", an en dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {words(inner)}" for key, inner in value.items()) or "–"
    if isinstance(value, list | tuple):
        return ", ".join(words(inner) for inner in value) or "–"
    return str(value)


def data_uri(content: bytes, suffix: str) -> str:
    """A picture or film as a data URI; suffix: of its file, among those of ``_MEDIA``."""
    return f"data:{_MEDIA[suffix]};base64,{base64.b64encode(content).decode()}"


def file_uri(path: str | Path) -> str:
    """The file as a data URI; ``InputError`` where it is missing or of an unknown kind."""
    path = Path(path)
    if path.suffix.lower() not in _MEDIA:
        raise InputError(path, "suffix", path.suffix, f"a report embeds {', '.join(_MEDIA)}")
    try:
        return data_uri(path.read_bytes(), path.suffix.lower())
    except OSError as error:
        raise InputError(path, "file", error.strerror, "make the picture first or leave it out") from None


def render(template: Path, **content: object) -> bytes:
    """A page from a template that extends ``page.html``, which wants title and provenance (name -> text, list or mapping; may be empty)."""
    loader = jinja2.FileSystemLoader([template.parent, Path(__file__).parent])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["words"] = words
    return environment.get_template(template.name).render(**content).encode()
