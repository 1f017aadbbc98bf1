"""Griffe extension: the comment beside a field is its documentation.

The fields of the library's dataclasses and named tuples state their unit, shape and source in a comment, on the line of
the field or in the lines above it. The API reference shows these comments.
"""

import tokenize
from io import StringIO
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Gives every attribute without a docstring the comment beside it."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called for each attribute that Griffe finds."""
        if attr.docstring is not None or attr.lineno is None or not attr.lines_collection:
            return
        lines = attr.lines_collection[attr.filepath]
        text = [_comment(lines[attr.lineno - 1])]
        for line in reversed(lines[: attr.lineno - 1]):
            if not line.lstrip().startswith("#"):
                break
            text.insert(0, line.strip("# \n"))
        said = " ".join(part for part in text if part)
        if said:
            attr.docstring = griffe.Docstring(said, lineno=attr.lineno, parent=attr)


def _comment(line: str) -> str:
    """The comment at the end of a line of code."""
    try:
        tokens = list(tokenize.generate_tokens(StringIO(line.strip()).readline))
    except tokenize.TokenError:  # the statement goes on in the next line
        return ""
    return next((token.string.strip("# ") for token in tokens if token.type == tokenize.COMMENT), "")
