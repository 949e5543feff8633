# SPDX-License-Identifier: Apache-2.0
"""docs/faults.md: one page, whose parts are printed by different programs."""

from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


def write_section(name: str, text: str, page: Path = PAGE) -> None:
    """Replace what stands between the marks of a part.

    :raises ValueError: the page has no such part.
    """
    begin, end = (f"<!-- {name}: {what} -->" for what in ("begin", "end"))
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page.name} has no part {name!r}")
    page.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}", encoding="utf-8")
