"""``/docs``: every HTTP endpoint on one page without scripts, which loads nothing from anywhere else."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Any, Final

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
HEAD: Final = """<!doctype html><html lang="en"><meta charset="utf-8"><title>caphy: HTTP endpoints</title>
<meta name="viewport" content="width=device-width">
<style>body { font: 1rem/1.5 system-ui; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color-scheme: light dark }
h2 { font: 600 1rem/1.5 ui-monospace, monospace; margin: 2rem 0 0 } p, ul { margin: 0 }</style>
<h1>HTTP endpoints</h1><p>The same for programs, with all schemas: <a href="openapi.json">openapi.json</a></p>
"""


def add_endpoints_page(app: FastAPI) -> None:
    """Mount the page."""

    @app.get("/docs", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(HEAD + "\n".join(_described(app.openapi())), headers={"content-security-policy": POLICY})


def _described(document: dict[str, Any]) -> Iterator[str]:
    """HTML of each operation: method and path, what it does, what it takes and answers."""
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            yield f"<h2>{method.upper()} {escape(path)}</h2>"
            yield f"<p>{escape(operation.get('description', operation.get('summary', '')))}</p><ul>"
            for taken in operation.get("parameters", []):
                yield f"<li>{taken['in']} <code>{taken['name']}</code> {escape(taken.get('description', ''))}</li>"
            if kinds := operation.get("requestBody", {}).get("content"):
                yield f"<li>body <code>{escape(', '.join(kinds))}</code></li>"
            for status, answer in operation["responses"].items():
                yield f"<li>{status} {escape(answer.get('description', ''))}</li>"
            yield "</ul>"
