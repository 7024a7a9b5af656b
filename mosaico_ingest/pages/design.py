"""The common design of all pages: templates with autoescaping, the content security policy, and packed content."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Sequence
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mosaico_ingest.findings import one_line
from mosaico_ingest.report import units

SCRIPTS = ("page.js",)
PLOT_SCRIPTS = ("vendor/uPlot.iife.min.js", "plots.js")
"""The scripts of pages with plots, in addition to `SCRIPTS`."""


def render(template: str, *, has_plots: bool = False, **values: object) -> str:
    """Return a page. `has_plots` adds the plotting library, which has 50 kB."""
    names = (*(PLOT_SCRIPTS if has_plots else ()), *SCRIPTS)
    scripts = [_script(name) for name in names]
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts)
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; form-action 'self'; base-uri 'none'; "
        f"script-src {hashes}"
    )
    page = (
        _environment()
        .get_template(template)
        .render(policy=policy, scripts=[Markup(script) for script in scripts], has_plots=has_plots, **values)  # noqa: S704 - package data
    )
    return page if page.endswith("\n") else f"{page}\n"


def macro(template: str, name: str, *arguments: object) -> Markup:
    """Return the HTML that a macro of a template writes."""
    html: Markup = getattr(_module(template), name)(*arguments)
    return html.strip()


def pack(parts: Sequence[str]) -> Markup:
    """Return texts of HTML compressed for `unpack` in `page.js`, which is about a tenth of their size."""
    compressed = zlib.compress(json.dumps(list(parts), ensure_ascii=False).encode(), 6)
    return Markup(base64.b64encode(compressed).decode())  # noqa: S704 - Base64 has no special characters


def data_element(value: Any) -> Markup:  # noqa: ANN401 - any JSON value
    """Return a value as JSON that can stand inside a script element."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    escaped = text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return Markup(escaped)  # noqa: S704 - no character can end the script element


@cache
def _environment() -> Environment:
    """Return the templates with autoescaping. Control characters of values are replaced by escapes."""

    def finalize(value: object) -> object:
        if isinstance(value, Markup) or not isinstance(value, str):
            return value
        return "\n".join(map(one_line, value.split("\n")))

    environment = Environment(
        loader=PackageLoader("mosaico_ingest.pages"),
        autoescape=True,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    names = ("bytes_text", "count_text", "counted", "percent_text", "rate_text", "seconds_text", "time_text")
    environment.filters.update({name: getattr(units, name) for name in names})
    environment.filters["data"] = data_element
    return environment


@cache
def _module(template: str) -> Any:  # noqa: ANN401 - its attributes are the macros
    return _environment().get_template(template).module


@cache
def _script(name: str) -> str:
    environment = _environment()
    loader = environment.loader
    if loader is None:
        raise ValueError("the templates have no loader")
    return loader.get_source(environment, name)[0]


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
