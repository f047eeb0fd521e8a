"""What the site does to the pages: files of the repository that they link to are copied beside them."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

OUTSIDE = re.compile(r"\]\(\.\./([^)#\s]+)")  # a link out of docs/, as GitHub follows it
COPIES = "repository"  # folder of the site
INSIDE = re.compile(r"\]\(((?:\.\./)+)docs/")  # a link from a page elsewhere in the repository into docs/


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add what the pages link to outside of docs/; a link to nothing stays as it is, and is reported as broken."""
    docs = Path(config.docs_dir)
    linked = {path for page in files.documentation_pages() for path in OUTSIDE.findall(page.content_string)}
    for path in sorted(linked):
        if (docs.parent / path).is_file():
            name = f"{COPIES}/{path}"
            files.append(File.generated(config, name, abs_src_path=str(docs.parent / path)))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links out of docs/ to the copies, and those of copied pages back to the pages of docs/."""
    if page.file.src_uri.startswith(f"{COPIES}/"):
        return INSIDE.sub(r"](\1../", markdown)
    return OUTSIDE.sub(rf"]({COPIES}/\1", markdown)
