# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A hook of MkDocs: search that opens fast and without a network, and docstrings without roles.

Every page and every heading stay findable. The index has text without markup and without code
blocks; of reference pages it has names, and the first paragraph under each heading.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from pathlib import Path
from typing import Any

BRIEF = {"benchmarks", "commands", "engine", "faults", "parameters"}
"""Pages of long tables and lists: a section's first paragraph and its names are indexed."""
REFERENCE = {"api", "commands", "errors", "parameters"}
"""Pages that rank below those that explain."""
ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):<code>(~?)([\w.]+)</code>")
"""A reference of a docstring, which Markdown does not know."""
LARGEST = 300_000
"""Largest size of the index, bytes."""
SHIM = re.compile(r"https://[^\"' ]*/iframe-worker/shim")
"""Script that the theme's search loads for pages opened as files."""
OWN_SHIM = "assets/javascripts/iframe_worker.js"


def brief(text: str) -> str:
    """Return the first paragraph and all names in backquotes."""
    return " ".join([paragraph(text), *dict.fromkeys(re.findall(r"<code>[^<]*</code>", text))])


def paragraph(text: str) -> str:
    """Return the first paragraph."""
    first = re.search(r"<p>.*?</p>", text, re.DOTALL)
    return first[0] if first else ""


def entry_text(page: str, text: str) -> str:
    """Return the indexed text of a section of a page (its file's stem), without markup.

    :param text: HTML of the search plugin.
    """
    text = re.sub(r"<pre>.*?</pre>", " ", text, flags=re.DOTALL)
    if page == "api":
        text = paragraph(text)
    elif page in BRIEF:
        text = brief(text)
    return " ".join(re.sub(r"<[^>]+>", " ", text).split())


def on_page_content(html: str, **_: Any) -> str:
    """Replace each reference in a page by its name, after ``~`` by the last part alone."""
    return ROLE.sub(lambda m: f"<code>{m[2].split('.')[-1] if m[1] else m[2]}</code>", html)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Let a page load the shim from the site."""
    return SHIM.sub("../" * page.url.count("/") + OWN_SHIM, output)


def on_post_build(config: Any) -> None:
    """Shorten the index that the search plugin wrote, and copy the shim.

    Logs a warning if it is still too large: an error in a strict build.
    """
    site = Path(config["site_dir"])
    (site / OWN_SHIM).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(Path(__file__).parent / "iframe_worker" / "shim.js", site / OWN_SHIM)
    path = site / "search" / "search_index.json"
    index = json.loads(path.read_text(encoding="utf-8"))
    for entry in index["docs"]:
        page = entry["location"].split("#")[0].removesuffix(".html")
        entry["text"] = entry_text(page, entry["text"])
        if page in REFERENCE:
            entry["boost"] = 0.2
        entry["title"] = " ".join(re.sub(r"<[^>]+>", "", entry["title"]).split())
    data = json.dumps(index, ensure_ascii=False, separators=(",", ":")).encode()
    path.write_bytes(data)
    if len(data) > LARGEST:
        logging.getLogger("mkdocs").warning("search index: %d bytes, above %d", len(data), LARGEST)
