# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The site's search index is short, and every page, heading, option and key stays in it."""

from __future__ import annotations

import json
import logging
import re
from types import SimpleNamespace

import pytest

from tools.pages import search

SECTION = (
    "<p>Size the <strong>drives</strong> &amp; gears, see <code>size</code>.</p>"
    "<p>Long words of no use here.</p><pre><code>$ pkm-twin size</code></pre>"
    "<ul><li><code>--motor TEXT</code>: compare only this motor</li>"
    "<li><code>--json</code>: machine-readable</li></ul> key unit <code>lead</code> m per turn"
)


def shortened(folder, entries):
    """The index after the hook."""
    path = folder / "search" / "search_index.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"config": {}, "docs": entries}), encoding="utf-8")
    search.on_post_build({"site_dir": str(folder)})
    return json.loads(path.read_text(encoding="utf-8"))["docs"]


@pytest.mark.parametrize("page", ["commands", "parameters", "api", "drives", "nodes"])
def test_each_section_stays_and_its_names(page, tmp_path):
    entries = [
        {"location": f"{page}.html{anchor}", "title": "<code>size</code>", "text": SECTION}
        for anchor in ("", "#a", "#b")
    ]
    found = shortened(tmp_path, entries)
    assert [one["location"] for one in found] == [one["location"] for one in entries]
    for one in found:
        assert one["title"] == "size"
        assert not re.search(r"<\w", one["text"])
        assert "Size the drives &amp; gears" in one["text"]
        assert "$ pkm-twin" not in one["text"]
        # The functions of the Python page are titles.
        assert page == "api" or {"--motor", "--json", "lead"} <= set(one["text"].split())
        assert ("Long words" in one["text"]) == (page in ("drives", "nodes"))


def test_an_index_that_is_too_large_is_an_error_in_a_strict_build(tmp_path, caplog):
    text = "<p>" + "word " * (search.LARGEST // 5) + "</p>"
    with caplog.at_level(logging.WARNING, "mkdocs"):
        shortened(tmp_path, [{"location": "maps.html", "title": "Maps", "text": text[:900]}])
        assert not caplog.records
        shortened(tmp_path, [{"location": "maps.html", "title": "Maps", "text": text}])
    assert len(caplog.records) == 1


@pytest.mark.parametrize("url", ["index.html", "api/robot.html"])
def test_search_in_pages_that_are_opened_as_files_needs_no_network(url, tmp_path):
    script = '<script src="https://cdn.example/iframe-worker/shim"></script>'
    found = search.on_post_page(f"<head>{script}</head>", page=SimpleNamespace(url=url))
    shortened(tmp_path, [])
    address = re.search(r'src="([^"]+)"', found)[1]
    assert (tmp_path / url).parent.joinpath(address).resolve().stat().st_size > 500


def test_references_of_docstrings_become_names():
    html = "errors as :func:<code>~a.b.modes</code>, :class:<code>a.Robot</code> <code>~/topic</code>"
    assert search.on_page_content(html) == ("errors as <code>modes</code>, <code>a.Robot</code> <code>~/topic</code>")
