"""The code of `docs/extending.md` and of other pages, for the tests that execute it."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def blocks(title: str, page: str = "extending") -> list[str]:
    """The blocks of Python in the section of this title on a page of the documentation."""
    parts = (DOCS / f"{page}.md").read_text().split("\n## ")[1:]
    (section,) = [part for part in parts if part.startswith(f"{title}\n")]
    return re.findall(r"```python\n(.*?)```", section, re.DOTALL)
