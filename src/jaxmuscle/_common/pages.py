"""Pages of HTML for results: one file each, which asks the network for nothing and in which every
text is escaped."""

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NewType

from .figures import SETTINGS, UNDATED
from .files import write_text

Html = NewType("Html", str)  # escaped already

# What stands in a page is all that it may load.
ALONE = (
    "<meta http-equiv='Content-Security-Policy' content=\"default-src 'none'; img-src data:;"
    " style-src 'unsafe-inline'\">"
)
STYLE = """
:root{color-scheme:light dark;--page:#fff;--ink:#1a1a1a;--soft:#555;--line:#ddd;--strong:#555;--box:#f4f4f4;--link:#0058a3;
--yes:#00664a;--no:#a33c00}
@media screen and (prefers-color-scheme:dark){:root{--page:#161616;--ink:#e6e6e6;--soft:#b0b0b0;--line:#3a3a3a;
--strong:#999;--box:#242424;--link:#7cc0ff;--yes:#5fd0a5;--no:#ff9d6b}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:62rem;padding:1rem;font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--page)}
h1{font-size:1.5rem;line-height:1.25;overflow-wrap:anywhere}h2{font-size:1.2rem;margin-top:2.2rem}a{color:var(--link)}
figure{margin:1.2rem 0}figcaption{font-size:.9rem;color:var(--soft);margin-top:.5rem}
img{max-width:100%;height:auto;display:block;background:#fff;border:1px solid var(--line);border-radius:8px;padding:.6rem}
@media screen and (prefers-color-scheme:dark){img{filter:invert(.914) hue-rotate(180deg);border-color:#ccc}}
details{margin:1rem 0}summary{cursor:pointer;color:var(--link)}
table{border-collapse:collapse;width:100%;font-size:.9rem}th,td{text-align:left;vertical-align:top;padding:.4rem .6rem;
border-bottom:1px solid var(--line)}thead th{border-bottom:2px solid var(--strong)}
p,li{overflow-wrap:anywhere}.scroll{overflow-x:auto}
pre,code{font-family:ui-monospace,monospace;font-size:.85rem}
pre{white-space:pre-wrap;overflow-wrap:anywhere;background:var(--box);padding:.6rem .8rem;border-radius:4px}
.verdict{font-weight:600}.yes{color:var(--yes)}.grid{color:var(--link)}.no{color:var(--no)}.open{color:var(--soft)}
@media screen and (max-width:46rem){table.stack thead{position:absolute;left:-999rem}table.stack tr{display:block;
padding:.4rem 0;border-bottom:1px solid var(--line)}table.stack td{display:inline-block;border:0;padding:0 .9rem 0 0;
overflow-wrap:anywhere}
table.stack td:empty{display:none}table.stack td::before{content:attr(data-label) ": ";font-size:.8rem;
color:var(--soft)}table.stack td:first-child{display:block;font-weight:600}
table.stack td:first-child::before{display:none}}
@media print{details::details-content{content-visibility:visible;display:block}summary{display:none}body{max-width:none;padding:0;font-size:10pt}h2{break-after:avoid}tr,figure,pre{break-inside:avoid}
figure img{max-height:22cm;width:auto}a{color:inherit}@page{margin:16mm}}
""".strip()  # noqa: E501 (rules of one selector stand on one line)


def document(title: str, body: Iterable[str], *, style: str = "", head: str = "") -> str:
    """A whole page; `style`, rules of its own after those of all pages, `head`, what else stands in
    its head."""
    return (
        f"<!doctype html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n{head}"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        f"<title>{escape(title)}</title>\n<style>{STYLE}\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def write_page(path: Path, title: str, body: Iterable[Html]) -> None:
    """Write a page with its title as heading, whole or not at all."""
    text = document(title, [heading(title, 1), *body], head=f"{ALONE}\n")
    # half characters out of a file cannot be written
    write_text(path, text.encode("utf-8", "replace").decode())


def heading(text: str, level: int = 2) -> Html:
    return Html(f"<h{level}>{escape(text)}</h{level}>")


def paragraph(text: str, kind: str = "") -> Html:
    """A paragraph of a kind that the style knows."""
    return Html(
        f"<p class='{escape(kind)}'>{escape(text)}</p>" if kind else f"<p>{escape(text)}</p>"
    )


def folded(summary: str, *body: Html) -> Html:
    """What is read on demand, behind a line that says what it is; paper shows all of it."""
    return Html(f"<details><summary>{escape(summary)}</summary>{''.join(body)}</details>")


def items(texts: Iterable[str]) -> Html:
    """A list; what stands between backquotes is code."""
    return Html("<ul>" + "".join(f"<li>{_with_code(text)}</li>" for text in texts) + "</ul>")


def _with_code(text: str) -> str:
    parts = text.split("`")
    return "".join(
        f"<code>{escape(part)}</code>" if i % 2 else escape(part) for i, part in enumerate(parts)
    )


def code(text: str) -> Html:
    return Html(f"<pre>{escape(text)}</pre>")


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table, without columns that hold nothing; on a narrow screen each row becomes a block with
    the columns' names."""
    rows = list(rows)
    held = [i for i in range(len(columns)) if any(row[i] for row in rows)]
    columns, rows = [columns[i] for i in held], [[row[i] for i in held] for row in rows]
    head = "".join(f"<th scope='col'>{escape(column)}</th>" for column in columns)
    body = (
        "<tr>"
        + "".join(
            f"<td data-label='{escape(c)}'>{escape(cell)}</td>"
            for c, cell in zip(columns, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    whole = (
        f"<table class='stack'><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    )
    return Html(f"<div class='scroll'>{whole}</div>")


def settings_table(values: Mapping[str, Any]) -> Html:
    """Settings by name, nested ones in a line each."""
    return table(("setting", "value"), [(name, _in_words(value)) for name, value in values.items()])


def _in_words(value: Any) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case Mapping():
            return (
                "; ".join(f"{name} = {_in_words(each)}" for name, each in value.items()) or "none"
            )
        case list() | tuple():
            return "; ".join(map(_in_words, value)) or "none"
    return str(value)


def picture(figure: Any, words: str, *, pixels: bytes | None = None) -> Html:
    """A figure that stands in the page, with words below: as SVG, or its PNG where it has too many
    lines for that."""
    mime, made = ("image/svg+xml", _drawn(figure)) if pixels is None else ("image/png", pixels)
    data = base64.b64encode(made).decode()
    said = escape(words)
    # letters of 8 points are read as those of the text
    size = f"width='{round(96 * figure.get_figwidth() * 1.25)}'"
    return Html(
        f"<figure><img {size} alt='{said}'"
        f" src='data:{mime};base64,{data}'><figcaption>{said}</figcaption></figure>"
    )


def _drawn(figure: Any) -> bytes:
    import matplotlib

    made = io.BytesIO()
    with matplotlib.rc_context(SETTINGS):
        figure.savefig(made, format="svg", metadata=UNDATED["svg"])
    # it stays as it is now: to lay it out again for its own file takes as long as drawing
    figure.set_layout_engine("none")
    return made.getvalue()
