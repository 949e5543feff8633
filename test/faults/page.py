# SPDX-License-Identifier: Apache-2.0
"""docs/faults.md: one page, whose parts are printed by different programs."""

from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


def read_section(name: str, page: Path = PAGE) -> str:
    """What stands between the marks of a part.

    :raises ValueError: the page has no such part.
    """
    return _parts(name, page)[1].strip()


def write_section(name: str, text: str, page: Path = PAGE) -> None:
    """Replace what stands between the marks of a part.

    :raises ValueError: the page has no such part.
    """
    before, _, after = _parts(name, page)
    page.write_text(f"{before}\n{text.strip()}\n{after}", encoding="utf-8")


def _parts(name: str, page: Path) -> tuple[str, str, str]:
    """The page before, between and after a part's marks, which stay outside."""
    begin, end = (f"<!-- {name}: {what} -->" for what in ("begin", "end"))
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    text, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page.name} has no part {name!r}")
    return before + begin, text, end + after
