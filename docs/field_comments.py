"""Griffe extensions: the comment beside a field is shown in the API reference, and `import b as b` makes `b` public.

The fields of the library's dataclasses and named tuples have comments with their unit, shape and source, on the line of
the field or in the lines above it.
"""

import tokenize
from io import StringIO
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Use the comment beside an attribute as its docstring, unless it has a docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Set the docstring of an attribute. Griffe calls this method for each attribute that it finds."""
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


class PublicImports(griffe.Extension):
    """Names that a package imports under their own names, `from a import b as b`, are its public ones (PEP 484)."""

    def on_module_members(self, *, mod: griffe.Module, **_: Any) -> None:
        """Set the public names of a module. Griffe calls this method for each module that it has read."""
        if mod.exports is None:
            lines = mod.lines_collection[mod.filepath]
            names = [name for name, one in mod.members.items() if one.is_alias]
            mod.exports = [
                name for name in names if any(line.endswith(f"import {name} as {name}") for line in lines)
            ] or None


def _comment(line: str) -> str:
    """Return the comment at the end of a line of code, or an empty string."""
    try:
        tokens = list(tokenize.generate_tokens(StringIO(line.strip()).readline))
    except tokenize.TokenError:  # the statement continues on the next line
        return ""
    return next((token.string.strip("# ") for token in tokens if token.type == tokenize.COMMENT), "")
