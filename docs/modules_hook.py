"""MkDocs hook that lists every module of the code in the architecture page, with the first line of its docstring."""

import ast
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

PLACE = "<!-- modules -->"
PACKAGES = ("sts_jax", "experiments", "benchmarks")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the place holder of a page by one table for each package."""
    if PLACE not in markdown:
        return markdown
    root = Path(config.docs_dir).parent
    packages = sorted(path for top in PACKAGES for path in (root / top).rglob("__init__.py"))
    packages.sort(key=lambda path: PACKAGES.index(path.relative_to(root).parts[0]))
    return markdown.replace(PLACE, "\n".join(_table(path.parent, root) for path in packages))


def _table(package: Path, root: Path) -> str:
    """The modules of a package as a Markdown table."""
    name = package.relative_to(root).as_posix()
    modules = sorted(path for path in package.glob("*.py") if path.name != "__init__.py")
    rows = "".join(f"| `{path.stem}` | {_first_line(path)} |\n" for path in modules)
    table = f"\n| module | content |\n|---|---|\n{rows}" if rows else ""
    return f"### `{name}/`\n\n{_first_line(package / '__init__.py')}\n{table}"


def _first_line(path: Path) -> str:
    """The first line of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return text.split("\n")[0].replace("|", "\\|")
