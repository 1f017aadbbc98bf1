"""MkDocs hook that adds the pictures, tables and text files of benchmarks/results to the site.

These files lie outside docs/. Pages link to them by their path in the repository (`../benchmarks/results/...`), so the
links also work in the Markdown files. The hook copies the files into the site and shortens the links accordingly.
"""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

RESULTS = "benchmarks/results/"
SUFFIXES = (".md", ".png", ".txt", ".webp")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the result files to the site, under their paths in the repository."""
    root = Path(config.docs_dir).parent
    for path in sorted((root / RESULTS).rglob("*")):
        if path.suffix in SUFFIXES:
            files.append(File.generated(config, path.relative_to(root).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Change the links from a page to result files into links within the site."""
    up = "../" * page.file.src_uri.count("/")
    return markdown.replace(f"(../{up}{RESULTS}", f"({up}{RESULTS}")
