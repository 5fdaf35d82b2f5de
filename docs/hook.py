"""Gives mkdocs the repository's pages where they stand, so that a link works there and on the site.

Pages are the Markdown files and notebooks below; what they link to comes along: pictures, tables,
sources. A notebook is there both as a page and as a file.
"""

import json
import pathlib
import re
import shutil

from mkdocs.structure.files import File, Files

ROOT = pathlib.Path(__file__).parents[1]
PAGES = ("*.md", "docs/*.md", "docs/tutorials/*.md", "docs/tutorials/*.ipynb", "tasks/*.md",
         "models/*/*.md", "tests/benchmarks/results/**/*.md")  # fmt: skip
SOURCES = ROOT / "out" / "api"  # `paths` of mkdocs.yml
_LINK = re.compile(r"\]\((?![a-z]+:)([^)#\s]+)")


def on_startup(command, dirty):
  """Lays the package out as it is installed: its sources are read, not imported."""
  package = SOURCES / "palpate"
  shutil.rmtree(SOURCES, ignore_errors=True)
  package.mkdir(parents=True)
  for path in [*(ROOT / "plugin").iterdir(), ROOT / "models", ROOT / "tasks"]:
    (package / path.name).symlink_to(path)


def on_files(files: Files, config) -> Files:
  """Replaces the files of `docs/` by the pages of the repository and what they link to."""
  pages = [page for pattern in PAGES for page in sorted(ROOT.glob(pattern))]
  linked = {
    target
    for page in pages
    for link in _LINK.findall(page.read_text(encoding="utf-8"))
    if (target := (page.parent / link).resolve()).is_file() and ROOT in target.parents
  }
  notebooks = [path for path in pages if path.suffix == ".ipynb"]
  theme = [file for file in files if file.src_dir != config.docs_dir]
  mine = [
    File(path.relative_to(ROOT).as_posix(), str(ROOT), config.site_dir, config.use_directory_urls)
    for path in dict.fromkeys([*pages, *sorted(linked), ROOT / "docs" / "site.css"])
  ]
  made = [
    File.generated(
      config, path.relative_to(ROOT).with_suffix(".md").as_posix(), content=text_of(path)
    )
    for path in notebooks
  ]
  return Files([*theme, *mine, *made])


def on_page_markdown(markdown: str, **kwargs) -> str:
  """Lets links to a notebook lead to its page."""
  return markdown.replace(".ipynb)", ".md)")


def text_of(notebook: pathlib.Path) -> str:
  """Returns a notebook as Markdown, with a link to itself."""
  parts = []
  for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
    text = "".join(cell["source"])
    parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
  return "\n\n".join([*parts, f'[This page as a notebook]({notebook.name} "to download")'])
