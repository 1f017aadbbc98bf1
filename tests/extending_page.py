"""The code of `docs/extending.md`, for the tests that execute it."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"


def blocks(title: str) -> list[str]:
    """The blocks of Python in the section of this title."""
    (section,) = [part for part in PAGE.read_text().split("\n## ")[1:] if part.startswith(f"{title}\n")]
    return re.findall(r"```python\n(.*?)```", section, re.DOTALL)
