"""Parts of pages for people: one self-contained HTML file, without scripts or links."""

import base64
import html
from collections.abc import Iterable, Sequence
from typing import Any

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2330; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2rem 0 .6rem; }
.faint { color: #5d6472; } .small { font-size: .88rem; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #e4e7ec; }
th { font-weight: 600; color: #5d6472; } td.n, th.n { text-align: right; white-space: nowrap;
  font-variant-numeric: tabular-nums; }
tr.group td { background: #f4f6f9; font-weight: 600; }
.wide { overflow-x: auto; }
.strip { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .3rem; }
.strip img { width: 100%; }
.outcome { font-size: 1.25rem; font-weight: 600; margin: .3rem 0; }
.score { display: flex; gap: 1.5rem; align-items: baseline; flex-wrap: wrap; }
.score b { font-size: 2.2rem; line-height: 1.2; }
.good { color: #1c7a4d; } .bad { color: #b3213b; }
.beside { display: flex; gap: 1rem; flex-wrap: wrap; }
.beside figure { flex: 1 1 24rem; margin: 0; }
img, video { max-width: 100%; height: auto; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0; }
@media (max-width: 40rem) {
  body { margin: 1rem auto; padding: 0 .6rem; } table { font-size: .8rem; }
  th, td { padding: .25rem .3rem; } dl { grid-template-columns: 1fr; } dd { margin-bottom: .4rem; }
  .more { display: none; } .wide > img { max-width: none; width: 40rem; }
}
dt { color: #5d6472; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def document(title: str, body: Iterable[str]) -> str:
  """Returns a page of finished HTML parts; the title is plain text."""
  return (
    "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
    "<meta name='viewport' content='width=device-width, initial-scale=1'>"
    f"<title>{text(title)}</title><style>{STYLE}</style></head><body>\n"
    + "\n".join(body)
    + "\n</body></html>\n"
  )


def text(value: Any) -> str:
  """Returns plain text as HTML."""
  return html.escape(str(value), quote=True)


def row(
  cells: Iterable[str], numbers: Iterable[int] = (), tag: str = "td", more: Iterable[int] = ()
) -> str:
  """Returns a table row of finished HTML.

  Args:
    cells: the row's
    numbers: columns to align right
    tag: of a cell
    more: columns that a phone leaves out
  """
  kinds = [(set(numbers), "n"), (set(more), "more")]
  shown = [(" ".join(kind for columns, kind in kinds if k in columns), cell)
           for k, cell in enumerate(cells)]  # fmt: skip
  return f"<tr>{''.join(f'<{tag} class={kind!r}>{cell}</{tag}>' for kind, cell in shown)}</tr>"


def group(name: str, columns: int) -> str:
  """Returns a row that heads the rows below it."""
  return f"<tr class='group'><td colspan='{columns}'>{text(name)}</td></tr>"


def table(
  head: Iterable[str], rows: Iterable[str], numbers: Iterable[int] = (), more: Iterable[int] = ()
) -> str:
  """Returns a table of finished rows; see `row`."""
  first, rest = row(head, numbers, "th", more), "".join(rows)
  return f"<div class='wide'><table><thead>{first}</thead><tbody>{rest}</tbody></table></div>"


def image(data: bytes, alt: str, kind: str = "png") -> str:
  """Returns a picture, of a kind that browsers show."""
  return f"<img alt='{text(alt)}' src='data:image/{kind};base64,{_base64(data)}'>"


def film(mp4: bytes, about: str) -> str:
  """Returns a film."""
  source = f"data:video/mp4;base64,{_base64(mp4)}"
  return f"<video controls muted playsinline aria-label='{text(about)}' src='{source}'></video>"


def beside(parts: Sequence[tuple[str, str]]) -> str:
  """Returns finished parts side by side, each under its plain words."""
  figures = (f"<figure><figcaption>{text(k)}</figcaption>{v}</figure>" for k, v in parts)
  return f"<div class='beside'>{''.join(figures)}</div>"


def mark(words: str, kind: str = "") -> str:
  """Returns finished HTML in the colour of `good` or `bad`, or as it is."""
  return f"<span class='{kind}'>{words}</span>" if kind else words


def _base64(data: bytes) -> str:
  return base64.b64encode(data).decode("ascii")
