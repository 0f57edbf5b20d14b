"""`jaxmuscle reproduce`: every row of the table on its numbers, the three readings, the figures,
the page."""

import functools
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import jax
import numpy as np
import pages
import pytest
import scipy.signal

import jaxmuscle as jm
from jaxmuscle.commands import reproduce as command
from jaxmuscle.paper import _readings
from jaxmuscle.paper._claims import CLAIMS, check
from jaxmuscle.paper._figures import FIGURES
from jaxmuscle.paper._levels import Levels, fitted
from jaxmuscle.paper._readings import conclusion, fast_share
from jaxmuscle.paper._reproduce import reproduce
from jaxmuscle.paper._verdicts import (
    AGREES,
    ARITHMETIC,
    DIFFERS,
    FITTED,
    GIVEN,
    GRID,
    KINDS,
    TESTED,
    UNCHECKED,
    Row,
    counted,
    outcome,
)

EXACT = 1e-9  # arithmetic, bins and what is put in
LINEAR = 2e-3  # closed forms; the presets hold four digits
RUNS = 0.15  # means over 16 to 32 fixed seeds; single precision draws may differ between machines
ONE = 0.3  # one run

# key: kind, verdict, then value and relative tolerance of each number
EXPECTED = {
    "levels": (GIVEN, AGREES, (0.05, EXACT), (0.95, EXACT)),
    "window": (GIVEN, AGREES, (5.0, EXACT), (15.0, EXACT), (10.0, EXACT)),
    "max-124": (FITTED, DIFFERS, (4 * 100 / 256, EXACT), (4 * 100 / 256, EXACT), (1.567, LINEAR)),
    "varies": (TESTED, DIFFERS, (0.2055, 0.02), (0.05, EXACT), (0.1117, 0.02)),
    "inverted-u": (
        TESTED,
        DIFFERS,
        (0.95, EXACT),
        (0.50, 0.05),
        (0.69, 0.05),
        (0.84, 0.05),
        (0, EXACT),
        (0.95, EXACT),
        (1.2753, LINEAR),
        (1.7776, LINEAR),
        (1.9686, LINEAR),
    ),
    "max-7": (FITTED, GRID, (18 * 100 / 256, EXACT), (7.015, LINEAR)),
    "max-7-only": (TESTED, DIFFERS, (18 * 100 / 256, EXACT), (7.015, LINEAR)),
    "largest": (GIVEN, AGREES, (0.95, EXACT), (0.017 * 2.757, LINEAR), (0.017 * 2.608, LINEAR)),
    "smallest": (GIVEN, GRID, (0.35, EXACT), (0.017 * 1.0126, LINEAR)),
    "comparison": (GIVEN, AGREES, (0.27, 0.1), (1.47, RUNS), (1.59, 0.05)),
    "entropy": (TESTED, UNCHECKED, (1.47, RUNS)),
    "low": (FITTED, AGREES, (100 / 256, EXACT)),
    "high": (FITTED, GRID, (11 * 100 / 256, EXACT), (4.249, LINEAR), (1, EXACT), (0.75, ONE)),
    "align": (ARITHMETIC, DIFFERS, ((1.24 - 0.391) * 2.56, EXACT), ((7 - 4.251) * 2.56, EXACT)),
    "concentric": (
        GIVEN,
        UNCHECKED,
        (5, EXACT),
        (84.25, LINEAR),
        (100 / 256, EXACT),
        (11 * 100 / 256, EXACT),
        (5e-6, 1.0),
    ),
    "energy": (TESTED, DIFFERS, (0.7387, LINEAR), (0.9893, LINEAR), (0.9703, LINEAR)),
    "series": (TESTED, DIFFERS, (1.9e-5, 0.1), (0.8815, LINEAR), (0.39, RUNS)),
    "displacement": (GIVEN, AGREES, (100 / 256, EXACT), (11 * 100 / 256, EXACT), (0.0095, 0.02)),
    "amplitudes": (
        GIVEN,
        AGREES,
        (0.0016, EXACT),
        (0.0016, EXACT),
        (0.0001, EXACT),
        (0.0001, EXACT),
    ),
    "variation": (
        TESTED,
        DIFFERS,
        (5.301e-4, LINEAR),
        (6.814e-4, LINEAR),
        (1.8e-3, RUNS),
        (7.1, RUNS),
        (24.5, LINEAR),
    ),
    "people": (GIVEN, AGREES, (0.017 * 1.0126, LINEAR), (0.017 * 2.757, LINEAR)),
    "smaller": (GIVEN, AGREES, (4.989e-4, EXACT), (7.459e-4, EXACT)),
    "smoother": (FITTED, AGREES, (0.0156, RUNS), (0.39, RUNS)),
    "changing": (GIVEN, AGREES, (9.1e-4, RUNS), (4.3e-4, RUNS)),
    "dominated": (FITTED, AGREES, (100 / 256, EXACT), (0.5853, 0.02)),
    "higher": (TESTED, UNCHECKED, (0.1945, 0.02), (0, EXACT)),
    "recordings": (GIVEN, AGREES, (3, EXACT), (60, EXACT), (120, EXACT)),
    "fft-grid": (GIVEN, AGREES, (1 / 60, EXACT)),
    "welch-grid": (ARITHMETIC, DIFFERS, (0.46875, EXACT), (120 / 307, EXACT), (100 / 256, EXACT)),
    "rho-welch": (GIVEN, AGREES, (0.998, 0.005), (0.998, 0.005), (0.998, 0.005)),
    "rho-fft": (GIVEN, AGREES, (0.89, 0.05), (0.89, 0.05), (0.89, 0.05)),
    "rho-tuned": (TESTED, DIFFERS, (0.89, 0.1), (0.92, 0.1), (0.23, 0.5), (0.27, 0.5)),
    "grid-1.24": (ARITHMETIC, GRID, (3 * 100 / 256, EXACT), (4 * 100 / 256, EXACT)),
    "grid-4.251": (ARITHMETIC, GRID, (10 * 100 / 256, EXACT), (11 * 100 / 256, EXACT)),
    "grid-7": (ARITHMETIC, GRID, (17 * 100 / 256, EXACT), (18 * 100 / 256, EXACT)),
    "taylor": (GIVEN, AGREES, (0.3, EXACT), (0.017, 0.02)),
    "readings": (TESTED, DIFFERS, (5, EXACT), (5, EXACT), (5, EXACT), (4, EXACT), (3, EXACT)),
}


@pytest.fixture(scope="module")
def done(tmp_path_factory, pytestconfig):
    """The whole command's work, once: what was found, and the folder.

    In chunks of eight seeds, so that ensembles of 1, 16 and 32 seeds share a program: a seed is the
    same in any chunk.
    """
    folder = tmp_path_factory.mktemp("reproduce")
    plugins = pytestconfig.pluginmanager.get_plugins()
    (conftest,) = [plugin for plugin in plugins if hasattr(plugin, "DRAWN_WHOLE")]
    with pytest.MonkeyPatch.context() as patch:
        chunked = functools.partial(_readings.ensemble, chunk=8)
        patch.setattr(_readings, "ensemble", chunked)
        patch.setattr(conftest, "DRAWN_WHOLE", 0)  # each is drawn as a PDF, too
        return reproduce(folder), folder


@pytest.fixture(scope="module")
def rows(done):
    with jax.enable_x64(True):
        return {row.key: row for row in check(done[0])}


def test_every_claim_has_a_row_here():
    keys = [claim.key for claim in CLAIMS]
    assert len(set(keys)) == len(keys)
    assert set(keys) == set(EXPECTED)


@pytest.mark.parametrize("key", EXPECTED)
def test_the_numbers_and_the_verdict_of_a_row(rows, key):
    kind, verdict, *numbers = EXPECTED[key]
    row = rows[key]
    assert (row.kind, row.verdict) == (kind, verdict)
    assert len(row.numbers) == len(numbers)
    for found, (value, tolerance) in zip(row.numbers, numbers, strict=True):
        assert found == pytest.approx(value, rel=tolerance, abs=1e-12)
    assert bool(row.why) == (verdict != AGREES), "whatever does not simply agree says why"


def test_the_envelope_is_told_as_the_preset_has_it():
    (claim,) = (claim for claim in CLAIMS if claim.key == "changing")
    told = re.search(
        r"envelope falls from ([\d.]+) at ([\d.]+) s to ([\d.]+) at ([\d.]+) s", claim.how
    )
    assert told is not None
    first, begin, last, end = map(float, told.groups())
    envelope = jm.load_preset("zagrodny-hamilton").harmonic.envelope
    assert float(envelope(begin)) == first and round(float(envelope(end)), 2) == last


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.key)
def test_a_rule_can_say_no(claim):
    """Numbers that cannot be right are not called right."""
    count = len(EXPECTED[claim.key]) - 2
    wrong = (
        [1e6 * (i + 1) for i in range(count)],
        [-1e6 / (i + 1) for i in range(count)],
        [1e6 / (i + 1) for i in range(count)],
    )
    verdicts = {claim.rule(*numbers) for numbers in (*wrong, [1e6] * count)}
    assert verdicts & {DIFFERS, UNCHECKED} or claim.key == "max-7-only"  # says no to what it found


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.key)
def test_arithmetic_alone_needs_no_model(claim):
    if claim.kind == ARITHMETIC:
        assert all(np.isfinite(claim.numbers(None)))
        return
    with pytest.raises(AttributeError):
        claim.numbers(None)


def test_only_what_tests_the_model_is_counted_for_it():
    def row(kind, verdict):
        return Row("key", kind, "source", "says", "ours", (), "how", verdict, "")

    rows = [row(TESTED, v) for v in (AGREES, GRID, DIFFERS, DIFFERS, UNCHECKED)]
    rows += (
        [row(FITTED, v) for v in (AGREES, DIFFERS)]
        + [row(GIVEN, AGREES)] * 3
        + [row(ARITHMETIC, GRID)]
    )
    assert (
        counted(rows)
        == "Of 11 statements 5 test the model: 2 agree (1 within our resolution), 2 do not, 1"
        " cannot be checked. Not counted for it: 2 fitted (1 of them not met), 3 put in, 1"
        " arithmetic."
    )
    assert {row.kind for row in rows} == set(KINDS)
    assert (
        outcome([row(TESTED, GRID), row(TESTED, DIFFERS)])
        == "1 agrees (1 within our resolution), 1 does not, 0 cannot be checked"
    )


def test_the_document_counts_as_the_table_does(rows):
    assert counted(rows.values()) in (pages.ROOT / "docs" / "reproduce.md").read_text(
        encoding="utf-8"
    )


def test_the_document_lists_what_does_not_agree(rows):
    """And what does: of each kind, by the keys of claims.json."""
    text = (pages.ROOT / "docs" / "reproduce.md").read_text(encoding="utf-8")
    table = text.partition("| key | stated |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `([\w.-]+)`", table, re.MULTILINE)) == {
        k for k, r in rows.items() if r.verdict == DIFFERS
    }
    listed = {
        kind: set(re.findall(r"`([\w.-]+)`", text.partition(f"**{kind}**")[2].partition("\n")[0]))
        for kind in KINDS
    }
    assert listed == {
        kind: {key for key, row in rows.items() if row.kind == kind} for kind in KINDS
    }


def test_the_levels_are_those_of_the_expected_fits():
    written = (pages.ROOT / "src" / "jaxmuscle" / "paper" / "levels.toml").read_text(
        encoding="utf-8"
    )
    assert written == pages.module(pages.ROOT / "fitting" / "expected.py").levels(), (
        "run `python fitting/expected.py NAME`"
    )
    fits = pages.ROOT / "fitting" / "expected"
    for level in (35, 95):
        values = json.loads(
            (fits / f"slifkin-newell-1999-{level}mvc.json").read_text(encoding="utf-8")
        )["values"]
        task = fitted(level)
        moved = {name for name in task.parameter_names if task[name] != jm.Isometric()[name]}
        assert moved == set(jm.model._parameters.DEFAULT_FREE)
        assert all(task[name] == values[name]["value"] for name in moved)


def test_the_preset_of_figures_2_to_5_is_the_expected_fit_to_four_digits():
    written = (pages.ROOT / "fitting" / "expected" / "zagrodny-fig4a.json").read_text(
        encoding="utf-8"
    )
    values = {
        name: row["value"]
        for name, row in json.loads(written)["values"].items()
        if name in jm.model.PARAMETERS
    }
    preset = jm.load_preset("zagrodny-slifkin")
    assert {name: preset[name] for name in values} == {
        name: float(f"{value:.4g}") for name, value in values.items()
    }


def test_an_inverted_u_rises_above_both_ends():
    """Student's t of the smaller of the two rises; nothing where the largest stands at an end."""
    noise = np.random.default_rng(0).normal(size=(3, 16))

    def rise(*means):
        return Levels.entropy_rise.fget(
            SimpleNamespace(entropy=np.array(means)[:, None] + 0.1 * noise)
        )

    paired = scipy.stats.ttest_rel(2 + 0.1 * noise[1], 1.5 + 0.1 * noise[2]).statistic
    assert rise(1.0, 2.0, 1.5) == pytest.approx(paired, rel=1e-9)
    assert rise(1.0, 2.0, 3.0) == rise(3.0, 2.0, 1.0) == 0


def test_the_share_within_the_bins_against_a_simulation(done):
    """scipy's Welch of the 32 runs up to 50 Hz; few bins of slow noise hold much of the power, so
    the share errs by 2 %."""
    run = done[0].slifkin.force
    passed = run.filtered()
    power = scipy.signal.welch(passed, 100.0, nperseg=256, detrend="constant")[1].mean(0)
    assert power[1:31].sum() / power[1:].sum() == pytest.approx(done[0].slifkin.within, rel=0.06)


def test_the_three_readings(done):
    """A lacks the low sine, B (which has it) is not Task 1, B in Task 1 has no second maximum, C no
    local maximum."""
    found = {r.key: r for r in done[0].readings}
    missing = {
        key: {name for name, holds in r.facts.items() if not holds} for key, r in found.items()
    }
    assert missing == {
        "A": {"sine"},
        "B": {"task"},
        "B1": {"high"},
        "C1": {"high", "sine"},
        "C2": {"high", "sine", "fast"},
    }
    assert "No reading gives all" in conclusion(done[0].readings)
    p = np.asarray(found["C1"].spectrum.power)
    assert p[0] / p.sum() > 0.999  # the mean of the force has leaked into bin 1


def test_first_order_response_has_no_local_maximum():
    """(a + bw + cw²)/(w + p²), w = ω² > 0, a, c, p² > 0, has at most one turning point, a
    minimum."""
    rng = np.random.default_rng(0)
    w = np.geomspace(1e-4, 1e6, 20001)
    for _ in range(200):
        K, C, m, p, extra = 10.0 ** rng.uniform(-2, 3, 5)
        density = ((K - m * w) ** 2 + C**2 * w + extra * (w + p**2)) / (w + p**2)
        slope = np.diff(density)
        turns = np.flatnonzero(np.diff(np.sign(slope[np.abs(slope) > 1e-12 * density[1:]])) < 0)
        assert turns.size == 0


def test_fast_share_of_known_signals():
    t = np.arange(1000) / 100
    both = 3 * np.sin(2 * np.pi * 1.0 * t) + np.sin(2 * np.pi * 20.0 * t)
    assert fast_share(both, 100.0) == pytest.approx(0.1, rel=1e-9)


def test_task_2_is_held_by_constant_forces_at_1_mm(done):
    run = done[0].slifkin.displacement
    task = run.task
    with jax.enable_x64(True):
        force = [float(task.P_w(t)) for t in (5.0, 10.0, 15.0)]
    assert np.ptp(force) < 1e-4 * force[0]
    assert np.mean(np.asarray(run.between())) == pytest.approx(1e-3, rel=0.01)


def test_figures_and_page_are_written(done):
    folder = done[1]
    for name in FIGURES:
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert (folder / f"{name}.pdf").read_bytes()[:4] == b"%PDF"
    assert list(FIGURES) == command.FIGURES  # which the command promises not to overwrite
    assert [row["key"] for row in json.loads((folder / "claims.json").read_text())] == [
        claim.key for claim in CLAIMS
    ]
    assert not list(folder.glob(".*")), "no temporary file is left"


class _Page(HTMLParser):
    """Links, ids and the balance of tags."""

    def __init__(self):
        HTMLParser.__init__(self)
        self.links, self.ids, self.open, self.viewport = [], [], [], False

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.links += [found[key] for key in ("href", "src") if key in found]
        self.ids += [found["id"]] if "id" in found else []
        self.viewport |= (
            found.get("name") == "viewport" and "width=device-width" in found["content"]
        )
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_no_network(done):
    folder = done[1]
    text = (folder / "index.html").read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert page.open == [] and page.viewport
    assert all((folder / link).is_file() for link in page.links), page.links
    assert "http" not in text and "nan" not in re.sub(r"<[^>]*>", "", text).split()
    assert set(EXPECTED) <= set(page.ids) and set(FIGURES) <= set(page.ids)
    assert "Simulated, not measured" in text
