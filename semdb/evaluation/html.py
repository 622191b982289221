"""Pieces of a page that needs nothing beside it: style, tables, images inside it."""

from __future__ import annotations

import base64
from collections.abc import Sequence

from semdb.evaluation.comparisons import Grid
from semdb.shown import for_html

STYLE = """
:root { --ink: #1b2430; --faint: #66727f; --line: #e3e7ec; --soft: #f5f7fa; --accent: #0072b2; }
* { box-sizing: border-box; }
body { font: 15px/1.55 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink); margin: 0 auto;
  max-width: 1360px; padding: 2rem 1.5rem 5rem; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; } h2 { font-size: 1.3rem; margin: 3rem 0 .6rem; padding-top: .9rem;
  border-top: 2px solid var(--ink); }
h3 { font-size: 1.05rem; margin: 1.9rem 0 .5rem; }
p { max-width: 62rem; margin: .5rem 0 .9rem; } p.note { color: var(--faint); font-size: .92rem; }
nav { margin: 1rem 0 1.5rem; display: flex; flex-wrap: wrap; gap: .35rem 1.2rem; }
nav a { color: var(--accent); text-decoration: none; } nav a:hover { text-decoration: underline; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .8rem; margin: 1.2rem 0; }
.card { border: 1px solid var(--line); border-radius: .5rem; padding: .8rem 1rem; }
.card b { display: block; font-size: 1.45rem; font-variant-numeric: tabular-nums; } .card span { color: var(--faint);
  font-size: .88rem; display: block; line-height: 1.4; }
div.wide { overflow-x: auto; margin: .4rem 0 1rem; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .55rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th { color: var(--faint); font-weight: 600; position: sticky; top: 0; background: white; }
th.text, td.text { text-align: left; } td.prose { white-space: normal; text-align: left; min-width: 20rem; }
tr:hover td { background: var(--soft); } tr.ours td { background: #eaf4fb; font-weight: 600; }
.localized { color: #1e8e4e; } .ambiguous { color: #b06a00; } .coarse { color: #7b4fa3; }
.failed, .false { color: #c0322b; font-weight: 600; }
.problem { border-left: 4px solid #c0322b; background: #fdf1f0; padding: .7rem 1rem; margin: 1rem 0; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
figure { margin: 1.2rem 0; } figcaption { color: var(--faint); font-size: .92rem; }
details { border: 1px solid var(--line); border-radius: .5rem; padding: .1rem 1rem; margin: .7rem 0; }
details[open] { padding-bottom: 1rem; } summary { cursor: pointer; padding: .6rem 0; font-weight: 600; }
summary small { color: var(--faint); font-weight: 400; margin-left: .6rem; }
dl { display: grid; grid-template-columns: max-content auto; gap: .2rem 1.2rem; } dt { color: var(--faint); }
dd { margin: 0; overflow-wrap: anywhere; }
@media print { details { break-inside: avoid; } nav { display: none; } }
"""


def page(title: str, lead: str, sections: Sequence[tuple[str, str, str]]) -> str:
    """A whole page. `sections` are (identifier, heading, HTML); headings are listed at the top."""
    links = "".join(f'<a href="#{name}">{for_html(heading)}</a>' for name, heading, _ in sections)
    body = "\n".join(f'<h2 id="{name}">{for_html(heading)}</h2>\n{content}' for name, heading, content in sections)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{for_html(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}</style>\n'
        f"</head>\n<body>\n<h1>{for_html(title)}</h1>\n{lead}\n<nav>{links}</nav>\n{body}\n</body>\n</html>\n"
    )


def note(text: str) -> str:
    """A paragraph of explanation."""
    return f'<p class="note">{for_html(text)}</p>' if text else ""


def grid_html(grid: Grid, *, heading: bool = True) -> str:
    """A table with its heading and note."""
    head = f"<h3>{for_html(grid.title)}</h3>\n" if heading and grid.title else ""
    return head + note(grid.note) + table(grid.headers, grid.rows, grid.text_columns, grid.ours)


def table(
    headers: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 2, ours: frozenset[int] = frozenset()
) -> str:
    """Cells as text; the first `text_columns` stand left. Rows in `ours` are set off."""

    def line(cells: Sequence[str], tag: str, mark: str = "") -> str:
        marked = (
            f'<{tag} class="text">{for_html(cell)}</{tag}>' if i < text_columns else f"<{tag}>{for_html(cell)}</{tag}>"
            for i, cell in enumerate(cells)
        )
        return f"<tr{mark}>" + "".join(marked) + "</tr>"

    body = "".join(line(row, "td", ' class="ours"' if i in ours else "") for i, row in enumerate(rows))
    return f'<div class="wide"><table>{line(headers, "th")}{body}</table></div>'


def image(data: bytes, alt: str, kind: str = "png") -> str:
    """An image inside the page."""
    text = base64.b64encode(data).decode()
    return f'<img alt="{for_html(alt)}" src="data:image/{kind};base64,{text}">'


def cards(entries: Sequence[tuple[str, str]]) -> str:
    """Figures that stand out: (figure, what it is)."""
    inner = "".join(
        f'<div class="card"><b>{for_html(value)}</b><span>{for_html(what)}</span></div>' for value, what in entries
    )
    return f'<div class="cards">{inner}</div>'


def definitions(entries: Sequence[tuple[str, str]]) -> str:
    """Names and values."""
    inner = "".join(f"<dt>{for_html(name)}</dt><dd>{for_html(value)}</dd>" for name, value in entries)
    return f"<dl>{inner}</dl>"


def folded(summary: str, small: str, content: str, *, is_open: bool = False) -> str:
    """A part that opens at a click; `small` stands behind its heading."""
    mark = " open" if is_open else ""
    return (
        f"<details{mark}><summary>{for_html(summary)}<small>{for_html(small)}</small></summary>\n{content}\n</details>"
    )
