"""Pages of HTML: nothing in them is markup but their own, and they load nothing."""

import base64
import re
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import pytest

from jaxmuscle._common import pages
from jaxmuscle._common.figures import pixels_of

HOSTILE = "<script>alert(1)</script>'\"><img src=x onerror=alert(2)>&amp;"


class Seen(HTMLParser):
    """The elements of a page with their attributes, and its words."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.words = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)


def test_texts_are_no_markup(tmp_path):
    figure, ax = plt.subplots(figsize=(2, 1))
    ax.set_title(HOSTILE, parse_math=False)
    body = [
        pages.heading(HOSTILE),
        pages.paragraph(HOSTILE, "verdict"),
        pages.items([HOSTILE, f"`{HOSTILE}`"]),
        pages.code(HOSTILE),
        pages.table(["a", HOSTILE], [(HOSTILE, "2")]),
        pages.settings_table({HOSTILE: {HOSTILE: [HOSTILE, 1.0, None, True]}}),
        pages.picture(figure, HOSTILE),
        pages.folded(HOSTILE, pages.code(HOSTILE)),
    ]
    plt.close(figure)
    pages.write_page(tmp_path / "page.html", HOSTILE, body)
    seen = Seen((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert {tag for tag, _ in seen.elements} == {
        *(
            "html",
            "head",
            "meta",
            "title",
            "style",
            "body",
            "h1",
            "h2",
            "p",
            "ul",
            "li",
            "code",
            "pre",
            "div",
        ),
        *("table", "thead", "tbody", "tr", "th", "td", "figure", "img", "figcaption"),
        *("details", "summary"),
    }
    assert {name for _, given in seen.elements for name in given} <= {
        "lang",
        "charset",
        "http-equiv",
        "content",
        "name",
        "class",
        "scope",
        "data-label",
        "width",
        "alt",
        "src",
    }
    assert seen.words.count(HOSTILE) == 13
    assert [given["src"][:26] for tag, given in seen.elements if tag == "img"] == [
        "data:image/svg+xml;base64,"
    ]


def test_a_page_may_load_nothing_and_is_read_in_light_dark_and_print(tmp_path):
    pages.write_page(tmp_path / "page.html", "half \ud800 a letter", [])
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in text
    assert not re.search(r"https?://|url\(|@import|<script|<link", text)
    assert all(
        f"@media {kind}" in text
        for kind in ("screen and (prefers-color-scheme:dark)", "screen and (max-width", "print")
    )
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"] and "half ? a letter" in text


def test_a_table_leaves_out_what_is_empty():
    seen = Seen(pages.table(("name", "value", "unit"), [("a", "1", ""), ("b", "2", "")]))
    assert seen.words == ["name", "value", "a", "1", "b", "2"]
    assert [given["data-label"] for tag, given in seen.elements if tag == "td"] == [
        "name",
        "value",
    ] * 2


@pytest.mark.parametrize(("pixels", "start"), [(False, b"<?xml"), (True, b"\x89PNG")])
def test_a_picture_stands_in_the_page_the_same_each_time(pixels, start):
    figure, _ = plt.subplots(figsize=(2, 1))
    once, again = (
        pages.picture(figure, "words", pixels=pixels_of(figure) if pixels else None)
        for _ in range(2)
    )
    plt.close(figure)
    (data,) = re.findall(r"base64,([^']+)'", once)
    assert base64.b64decode(data).startswith(start) and once == again
