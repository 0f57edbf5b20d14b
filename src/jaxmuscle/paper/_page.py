"""The page of `jaxmuscle reproduce`: figures, the table of statements, the three readings. One
file, no network."""

from html import escape
from importlib.metadata import version
from pathlib import Path

from jaxmuscle._common.files import write_text
from jaxmuscle._common.pages import document

from ._claims import claims_json
from ._numbers import SINES, Experiment, Reproduction
from ._readings import FACTS, conclusion
from ._verdicts import AGREES, DIFFERS, GRID, KINDS, TESTED, Kind, Row, counted, outcome

CAPTIONS = {
    "fig2": (
        "<b>Figure 2.</b> Force P<sub>w</sub> in Task 1, tuned to [30] at 95 % MVC, over its mean:"
        " rise before 5 s, hold analysed to 15 s. The sine is the harmonic at 4.25 Hz; slower"
        " changes are relaxation."
    ),
    "fig3": (
        "<b>Figure 3.</b> Its power spectrum: 100 samples/s, 30 Hz low-pass, Welch with 256 points."
    ),
    "fig4a": "<b>Figure 4a.</b> Proportional power (bin power over the sum of bins 1 to 30).",
    "fig4b": "<b>Figure 4b.</b> The same with logarithmic axes.",
    "fig5": (
        "<b>Figure 5.</b> Displacement of the insertion at constant force (Task 2), same muscle,"
        " over its mean. P<sub>w</sub>(t) is what Task 1 needs, without noise, to hold the"
        " insertion at 1 mm against 10 N."
    ),
    "fig6a": (
        "<b>Figure 6a.</b> Force in Task 1 tuned to [12], over its mean. The 0.391 Hz harmonic"
        " fades from 5 s on."
    ),
    "fig6b": "<b>Figure 6b.</b> Its displacement in Task 2: one dominant frequency.",
    "fig7": "<b>Figure 7.</b> Three people: FFT of the whole recording above, Welch below.",
    "fig8": (
        "<b>Figure 8.</b> Power of one person against another, bin by bin, with the Spearman"
        " correlation."
    ),
}
CLASSES = {AGREES: "yes", GRID: "grid", DIFFERS: "no"}
STYLE = """
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,24rem),1fr));gap:1.5rem}
.figures figure{margin:0}img{width:100%}.source{color:var(--soft);font-size:.85rem}
.plain th,.plain .holds{overflow-wrap:normal;white-space:nowrap;padding:.45rem .3rem}
.plain th:not(:first-child),.holds{text-align:center}
""".strip()


def write_page(found: Reproduction, rows: tuple[Row, ...], out: Path) -> None:
    """Write index.html and claims.json."""
    write_text(out / "claims.json", claims_json(rows))
    write_text(out / "index.html", page(found, rows))


def page(found: Reproduction, rows: tuple[Row, ...]) -> str:
    """The whole page."""
    body = (
        "<h1>Enhancing rheological muscle models with stochastic processes: reproduced</h1>",
        (
            "<p>The figures of Zagrodny, Wojnicz, Ludwicki and Barański (<i>the paper</i>) and"
            f" what its text says, by jaxmuscle {version('jaxmuscle')}. [30] is Slifkin &amp;"
            " Newell 1999, [12] Hamilton, Jones &amp; Wolpert 2004. What is stated was taken from"
            " texts; the figures were not available as data.</p>"
        ),
        f"<p><b>{escape(counted(rows))}</b> As data: <a href='claims.json'>claims.json</a>.</p>",
        (
            "<p>No verdict stands here on whether the model describes data: the parameters were"
            " tuned to curves that texts describe, whose scatter nobody states. Fits of measured"
            " spectra have one (<code>jaxmuscle fit</code>).</p>"
        ),
        "<h2>Figures</h2>",
        "<div class='figures'>",
        *(_figure(name, _caption(name, found.experiment)) for name in CAPTIONS),
        "</div>",
        "<h2>Statements</h2>",
        *(_claims(kind, [row for row in rows if row.kind == kind]) for kind in KINDS),
        "<h2>Where do 0.391 and 4.251 Hz come from? Three readings</h2>",
        _readings(found),
        "<h2>Comparison signals</h2>",
        _regularity(found),
    )
    return document("jaxmuscle reproduce", body, style=STYLE)


def _caption(name: str, experiment: Experiment) -> str:
    if name not in ("fig7", "fig8"):
        return CAPTIONS[name]
    names = ", ".join(escape(r.name) for r in experiment.recordings)
    return (
        f"{CAPTIONS[name]} <b>Simulated, not measured</b>: displacement in Task 2 with"
        f" Ornstein-Uhlenbeck noise, parameters 10 % apart: {names}."
    )


def _figure(name: str, caption: str) -> str:
    return (
        f"<figure id='{name}'><a href='{name}.png'><img src='{name}.png' alt='{name}'"
        f" loading='lazy'></a><figcaption>{caption} <a"
        f" href='{name}.pdf'>PDF</a></figcaption></figure>"
    )


def _table(names: tuple[str, ...], body: list[str], kind: str = "stack") -> str:
    columns = "".join(f"<th scope='col'>{escape(name)}</th>" for name in names)
    head, rows = f"<thead><tr>{columns}</tr></thead>", f"<tbody>{''.join(body)}</tbody>"
    return f"<div class='scroll'><table class='{kind}'>{head}{rows}</table></div>"


def _claims(kind: Kind, rows: list[Row]) -> str:
    head = ("Stated", "We get", "How it was obtained", "Agrees, or why not")
    body = []
    for row in rows:
        says = f"{escape(row.says)} <span class='source'>({escape(row.source)})</span>"
        colour = (
            CLASSES.get(row.verdict, "open") if kind == TESTED or row.verdict == DIFFERS else "open"
        )
        verdict = f"<span class='verdict {colour}'>{row.verdict}</span>"
        cells = (
            says,
            escape(row.ours),
            escape(row.how),
            verdict + (f": {escape(row.why)}" if row.why else ""),
        )
        filled = "".join(
            f"<td data-label='{label}'>{cell}</td>" for label, cell in zip(head, cells, strict=True)
        )
        body.append(f"<tr id='{row.key}'>{filled}</tr>")
    title = (
        f"<h3>{kind[0].upper()}{kind[1:]}: {len(rows)}, of which"
        f" {outcome(rows)}</h3><p>{escape(KINDS[kind])}</p>"
    )
    return title + _table(head, body)


def _readings(found: Reproduction) -> str:
    keys = tuple(r.key for r in found.readings)
    listed = "".join(f"<li><b>{r.key}</b>: {escape(r.words)}</li>" for r in found.readings)
    body = []
    for key, words in FACTS.items():
        marks = "".join(
            f"<td class='holds'>{'yes' if r.facts[key] else '–'}</td>" for r in found.readings
        )
        body.append(f"<tr><td>{escape(words)}</td>{marks}</tr>")
    for words, value in (
        ("share of a sine in bin 1", "sine_share"),
        ("share of the variance above 10 Hz", "fast_share"),
    ):
        marks = "".join(f"<td class='holds'>{getattr(r, value):.0%}</td>" for r in found.readings)
        body.append(f"<tr><td>{words}</td>{marks}</tr>")
    picture = _figure(
        "readings", "Force in the window, one run, and proportional power of each reading."
    )
    table, ends = _table(("Stated", *keys), body, "plain"), escape(conclusion(found.readings))
    return f"<ul>{listed}</ul>{table}<p>{ends}</p>{picture}"


def _regularity(found: Reproduction) -> str:
    r = found.regularity
    values = [
        ("white Gaussian noise, as drawn", r.white_unfiltered),
        ("white Gaussian noise, low-passed", r.white),
        ("force of Figure 2, as sampled", r.force_unfiltered),
        ("force of Figure 2, low-passed", r.force),
    ]
    values += [(f"sine of {f:g} Hz", value) for f, value in zip(SINES, r.sines, strict=True)]
    body = [f"<tr><td>{name}</td><td>{value:.3f}</td></tr>" for name, value in values]
    words = (
        "<p>Approximate entropy (m = 2, r = 0.2 SD) of 10 s at 100 samples/s: low is regular. [30]"
        " reports it for force "
    )
    return (
        words
        + "beside white noise and sines; its values are not known here.</p>"
        + _table(("Signal", "ApEn"), body, "plain")
    )
