"""`python -m devrf.pipelines.manual`: writes the pages again, into docs/ below the working folder."""

import sys
from pathlib import Path

from devrf.pipelines.manual import commands, configuration

PAGES = {"configuration.md": configuration.page, "commands.md": commands.page}

if __name__ == "__main__":
    docs = Path("docs")
    if not (docs / "index.md").is_file():
        sys.exit("docs/index.md: not here; call this in the top folder of the repository")
    for name, page in PAGES.items():
        (docs / name).write_text(page(), encoding="utf-8")
