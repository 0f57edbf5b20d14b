"""Designed motions: their information against closed forms and repeats, the optimum against its
theorem, limits, files."""

import functools
import inspect
import json
import re

import jax
import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
import scipy.optimize
import scipy.stats
from test_identify import BASES, MOVED, SEGMENTS, STEP, TRUTH, fitted, in_a_line, same_information
from test_identify import slopes as by_differences

import jaxmuscle as jm
from jaxmuscle.commands.design import design
from jaxmuscle.data import FrequencyResponse
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.uncertainty import Lengthening
from jaxmuscle.uncertainty._design_information import (
    design_information,
    expansion_at,
    information_of,
    with_open_masses,
)
from jaxmuscle.uncertainty._identifiability import fitted_problem
from jaxmuscle.uncertainty._input_design import Experiment, _full_name, steps_of
from jaxmuscle.uncertainty._multisine import Motion

BASE = ("k_w", "k_z", "c_w", "c_z")
TANGENTS = ("K_w_tangent", "tangent_stiffness", "B0")
SECONDS, BAND = 60.0, (0.1, 5.0)
PULLED = TRUTH.as_task(jm.PrescribedLength, P_w=TRUTH.P_w)
FLAT = Lengthening.flat(1e-3, BAND, SECONDS)
REPEATS, DOUBTFUL = 300, 1e-4  # chance of a test to fail by scatter alone


# --- the two-mass muscle of design section 2 at x_z = 0, by hand


def point(p):
    """x_w of the static equilibrium."""

    def static(x):
        active, passive = p["k_w"] * (p["x_ref_w"] ** 2 + x**2), p["k_z"] * p["x_ref_z"] ** 2
        return (active + passive) * x - p["P_w"]

    return scipy.optimize.brentq(static, 0.0, 1.0, xtol=1e-15)


def parts(p, f):
    """(K_z + C_z s), the active tissue's impedance, their sum."""
    s = 2j * np.pi * f
    active = (
        p["m_w"] * s**2
        + p["c_w"] * p["v_ref_w"] ** 2 * s
        + p["k_w"] * (p["x_ref_w"] ** 2 + 3 * point(p) ** 2)
    )
    passive = p["k_z"] * p["x_ref_z"] ** 2 + p["c_z"] * p["v_ref_z"] ** 2 * s
    return passive, active, active + passive


def stiffness(p, f):
    passive, active, both = parts(p, f)
    return active * passive / both + p["m_z"] * (2j * np.pi * f) ** 2


def density(p, f):
    """One-sided, of noise on both stiffnesses, band-limited at 50 Hz by a second-order Butterworth
    filter."""
    passive, _, both = parts(p, f)
    gains = passive / both, 1 - passive / both
    scales = [p[f"noise_K_{j}"] * p[f"k_{j}"] * p[f"x_ref_{j}"] ** 2 * point(p) for j in "wz"]
    each = sum((scale * np.abs(gain)) ** 2 for scale, gain in zip(scales, gains, strict=True))
    return 2 * each / 100.0 / (1 + (f / 50.0) ** 4)


VALUES = {name: float(value) for name, value in TRUTH.parameters.items()}


def changed(log_change):
    return VALUES | {n: VALUES[n] * np.exp(d) for n, d in zip(BASE, log_change, strict=True)}


def slopes(f):
    """d H / d ln parameter by central differences."""
    columns = [
        (stiffness(changed(STEP * e), f) - stiffness(changed(-STEP * e), f)) / (2 * STEP)
        for e in np.eye(4)
    ]
    return np.stack(columns, axis=-1)


def information(lengthening):
    """`Σ_k |∂F_k|² / (variance of real or imaginary part)`, F_k = DFT / samples, from white noise
    of known density."""
    f, ordinate = lengthening.frequency, np.sqrt(2 * lengthening.power) / 2
    rows = slopes(f) * ordinate[:, None]
    variance = density(VALUES, f) / (4 * lengthening.seconds)
    return np.einsum("ki,kj,k->ij", rows.conj(), rows, 1 / variance).real


def test_the_information_is_that_of_the_closed_form(x64):
    assert len(FLAT.frequency) == 295 and FLAT.rms == pytest.approx(1e-3, rel=1e-12)
    coordinates = Coordinates.of({n: VALUES[n] for n in BASE}, {}, dict.fromkeys(BASE, 1.0))
    found = FLAT.information(TRUTH, coordinates, np.zeros(4))
    same_information(found, information(FLAT), 1e-6)


def test_the_masses_are_open_as_in_the_fit_of_a_record(x64):
    """By hand: H also has m_z s², and slopes by m_w; of both ln masses the prior is known, and then
    they are left out."""
    problem, theta = fitted_problem(hold(), None)
    problem, theta = with_open_masses(problem), np.append(theta, [0.0, 0.0])
    lengthening = FLAT
    design = jm.uncertainty.Design("moved", PULLED, segments=0, lengthening=FLAT)
    found = design_information(problem, theta, design)
    f = lengthening.frequency
    up, down = (
        stiffness(VALUES | {"m_w": VALUES["m_w"] * np.exp(side * STEP)}, f) for side in (1, -1)
    )
    active, passive = (
        (up - down)[:, None] / (2 * STEP),
        VALUES["m_z"] * (2j * np.pi * f)[:, None] ** 2,
    )
    rows = np.concatenate([slopes(f), active, passive], axis=1)
    rows *= (np.sqrt(2 * lengthening.power) / 2)[:, None]
    variance = density(VALUES, f) / (4 * SECONDS)
    whole = np.einsum("ki,kj,k->ij", rows.conj(), rows, 1 / variance).real
    sd = np.array([jm.model.PARAMETERS[n].prior_sd for n in (*BASE, "m_w", "m_z")])
    whole *= np.outer(sd, sd)
    whole[[4, 5], [4, 5]] += 1.0
    expected = np.linalg.inv(np.linalg.inv(whole)[:4, :4])
    own = [problem.coordinates.names.index(n) for n in (*BASE, "m_w", "m_z")]
    found = found[np.ix_(own, own)] + np.diag(problem.prior[own] * [0, 0, 0, 0, 1, 1])
    found = np.linalg.inv(np.linalg.inv(found)[:4, :4])
    size = np.sqrt(np.diag(whole))[:4]
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), atol=1e-5
    )
    assert expected[1, 1] < 0.9 * whole[1, 1]  # known masses would tell more of K_z0


def test_what_follows_from_the_spectrum_depends_on_the_masses_too(x64):
    """Slopes of the coefficient of variation and the highest bins by differences; a record of the
    motion measures both."""
    # as bundled targets
    task = jm.Isometric(settings=jm.SpectrumSettings(filter_direction="both")).replace(**VALUES)
    made = Experiment.of(fitted(task), ("K_w0",), Lengthening.flat(1e-3, (0.5, 5.0), SECONDS), None)
    names = made.here.coordinates.names
    # how much of every bin lies between 8 and 12 Hz
    f, width = task.settings.frequency, task.settings.resolution
    highest = np.clip((12 - f) / width + 0.5, 0, 1) - np.clip((8 - f) / width + 0.5, 0, 1)
    for name, read in {
        "model_coefficient_of_variation": lambda m: np.sqrt(m.variance) / m.mean,
        "band_8_12": lambda m: highest @ m.proportional,
    }.items():
        expected = by_differences(task, read, free=("m_w", "m_z"))
        sd = [jm.model.PARAMETERS[n].prior_sd for n in ("m_w", "m_z")]
        found = made.here.gradients[name][[names.index("m_w"), names.index("m_z")]]
        np.testing.assert_allclose(
            found, expected * sd, rtol=1e-3, atol=1e-5 * np.linalg.norm(made.here.gradients[name])
        )
        assert abs(found[0]) > 0


def test_a_motion_for_the_stiffness_as_stretched_in_the_hold(x64):
    """It can be asked for although the fit of a hold does not state it; value and slopes by
    hand."""
    made = Experiment.of(hold(), ("K_w_tangent",), FLAT, None)

    def tangent(p):
        return p["k_w"] * (p["x_ref_w"] ** 2 + 3 * point(p) ** 2)

    assert made.here.values["K_w_tangent"][0] == pytest.approx(tangent(VALUES), rel=1e-6)
    names, sd = made.here.coordinates.names, jm.model.PARAMETERS
    for i, name in enumerate(BASE):
        up, down = (tangent(changed(side * STEP * np.eye(4)[i])) for side in (1, -1))
        expected = (up - down) / (2 * STEP) * sd[name].prior_sd
        assert made.here.gradients["K_w_tangent"][names.index(name)] == pytest.approx(
            expected, rel=1e-4, abs=1e-3
        )
    rest = made.here.values["tangent_stiffness"][0]
    assert rest == pytest.approx(stiffness(VALUES, np.array([1e-6]))[0].real, rel=1e-6)
    errors = made.errors(FLAT.power)
    relative = {n: errors[n] / made.here.values[n][0] for n in ("K_w_tangent", "K_w0")}
    assert relative["K_w_tangent"] < relative["K_w0"]  # K_w0 also needs the stretch


def test_a_mass_that_a_moved_record_was_fitted_with_is_known(x64):
    """The hold of a joint fit: m_w stays as it was fixed in both. The hold has m_z fixed for
    itself, so that is open."""
    moved = FLAT
    measured = FrequencyResponse(
        moved.frequency, stiffness(VALUES, moved.frequency), np.full(len(moved.frequency), 10.0)
    )
    problem, _ = fitted_problem(hold(), None)
    other, _ = fitted_problem(fitted(stiffness=measured, free=("k_w", "m_z")), None)
    both = FitProblem.shared(
        {"hold": problem, "pull": other},
        {"hold": {n: n for n in problem.coordinates.names}, "pull": {"k_w": "k_w", "m_z": "m_z"}},
    )
    assert (
        with_open_masses(both).coordinates.names == (*both.coordinates.names, "m_z@hold")
        and with_open_masses(other) is other
    )
    assert with_open_masses(problem).coordinates.names == (*problem.coordinates.names, "m_w", "m_z")


def estimates(displacement, rate, lines, seed):
    """ln of k_w, k_z, c_w, c_z by least squares of whitened ordinates, in repeats: white noise,
    coloured."""
    rng, n = np.random.default_rng(seed), len(displacement)
    places = np.rint(lines * SECONDS).astype(int)
    root, moved = np.sqrt(density(VALUES, lines)), (np.fft.rfft(displacement) / n)[places]
    reply = stiffness(VALUES, lines) * moved
    slope = slopes(lines) * (moved / root)[:, None]
    inverse = np.linalg.pinv(np.concatenate([slope.real, slope.imag]))
    found = np.zeros((REPEATS, 4))
    for x in found:
        white = rng.standard_normal(n) * np.sqrt(rate / 2)  # one-sided density 1
        force = reply + root * (np.fft.rfft(white) / n)[places]
        for _ in range(8):
            off = (stiffness(changed(x), lines) * moved - force) / root
            x -= inverse @ np.concatenate([off.real, off.imag])
    return found


@functools.cache
def hold():
    """The fit that most designs begin with."""
    return fitted()


@functools.cache
def designed(**given):
    return jm.uncertainty.design_input(
        hold(), **({"seconds": SECONDS, "band": BAND, "rate": 50.0} | given)
    )


def test_repeats_scatter_as_said_and_the_designed_motion_beats_the_flat_one():
    """By the law of the ordinates alone: no prior, no fluctuations, noise known."""
    made = designed(band=(0.1, 10.0))
    rng = np.random.default_rng(5)
    flat = np.zeros(made.displacement.size // 2 + 1, complex)
    places = np.rint(made.frequency * SECONDS).astype(int)
    flat[places] = np.exp(2j * np.pi * rng.random(len(places)))
    flat = np.fft.irfft(flat)
    flat *= made.rms / np.sqrt(np.mean(flat**2))
    spread = {}
    for name, motion, lengthening in (
        ("flat", flat, made.even),
        ("designed", made.displacement, made.lengthening),
    ):
        np.testing.assert_allclose(
            lengthening.of_motion(motion).power, lengthening.power, rtol=1e-9
        )
        found = estimates(motion, made.asked.rate, made.frequency, 7)
        expected = np.linalg.inv(information(lengthening))
        spread[name] = np.var(found[:, 0], ddof=1)
        low, high = scipy.stats.chi2.ppf([DOUBTFUL / 16, 1 - DOUBTFUL / 16], REPEATS - 1) / (
            REPEATS - 1
        )
        ratio = np.var(found, axis=0, ddof=1) / np.diag(expected)
        # ln k_w with a standard error of 0.1 is curved: its variance is up to 0.1 larger than to
        # first order.
        assert np.all((low < ratio) & (ratio < high + 0.1)), (name, ratio)
    assert spread["flat"] / spread["designed"] > 1.5
    assert made.gain > 1.5


# --- the optimum


def criterion(made, power):
    """Sum of relative variances with a motion of these lines, from the same start as the
    design's."""
    errors = experiment(made.quantity).errors(power)
    return sum((errors[n] / made.values[n]) ** 2 for n in made.quantity)


@functools.cache
def experiment(quantity):
    with jax.enable_x64(True):
        return Experiment.of(hold(), quantity, FLAT, None)


@pytest.mark.parametrize("quantity", [("K_w0",), ("C_z0",), BASES])
def test_the_optimum_obeys_the_equivalence_theorem(quantity):
    """No direction towards any step of the density lowers the variance, and those that are used
    leave it as it is."""
    made = designed(quantity=quantity, spread=0.0)
    power, step = experiment(quantity).best(np.array([1e-3, np.inf, np.inf]), 0.0), 1e-5
    here = criterion(made, power)
    np.testing.assert_allclose(power.sum(), 1e-6, rtol=1e-6)
    for one in steps_of(made.frequency):
        towards = (1 - step) * power + step * 1e-6 * one
        slope = (criterion(made, towards) - here) / step / here
        assert slope > -1e-3
        if power[one > 0].sum() > 1e-2 * power.sum():
            assert abs(slope) < 1e-3
    assert here < criterion(made, made.even.power)


def test_what_is_reported_is_of_the_motion():
    made = designed()
    spectrum = np.abs(np.fft.rfft(made.displacement)) / made.displacement.size
    places = np.rint(made.frequency * SECONDS).astype(int)
    np.testing.assert_allclose(2 * spectrum[places] ** 2, made.lengthening.power, rtol=1e-9)
    spectrum[places] = 0
    assert spectrum.max() < 1e-15
    assert made.rms == pytest.approx(1e-3) == pytest.approx(np.sqrt(np.mean(made.displacement**2)))
    assert np.sum(made.density) / SECONDS == pytest.approx(1e-6)
    errors = experiment(("K_w0",)).errors(made.lengthening.power)
    assert made.stderr == pytest.approx(errors)
    assert made.gain == pytest.approx((made.flat["K_w0"] / made.stderr["K_w0"]) ** 2)
    assert made.peak / made.rms < 2.0  # random phases: about 3.5


def test_limits_are_kept():
    made = designed(quantity="K_z0", peak=1.2e-3, speed=8e-3, rate=1000.0)
    velocity = np.gradient(np.append(made.displacement, made.displacement[0]), 1e-3)
    assert np.max(np.abs(made.displacement)) <= 1.2e-3 * (1 + 1e-9) and np.max(
        np.abs(velocity)
    ) <= 8e-3 * (1 + 1e-3)
    assert made.speed == pytest.approx(np.max(np.abs(velocity)), rel=1e-2)
    assert max(made.peak / 1.2e-3, made.speed / 8e-3) > 0.95  # and used
    limit = "peak" if made.peak / 1.2e-3 > made.speed / 8e-3 else "speed"
    words = in_a_line(made)
    assert (
        made.rms < 0.9e-3
        and f"limit that you gave with --{limit} ({limit}=) keeps it below 1 mm rms" in words
    )
    assert "keeps it below" not in str(designed(quantity="K_z0"))
    assert made.gain > 1.0 and made.even.rms < made.rms


def test_the_acceleration_of_a_motor_is_kept():
    free = designed(quantity="K_z0", rate=1000.0)
    most = 0.3 * free.acceleration
    made = designed(quantity="K_z0", acceleration=most, rate=1000.0)
    three = np.concatenate([made.displacement[-1:], made.displacement, made.displacement[:1]])
    acceleration = np.max(np.abs(np.diff(three, 2))) / 1e-6
    assert made.acceleration == pytest.approx(acceleration, rel=1e-2)
    assert 0.9 * most < made.acceleration <= most * (1 + 1e-9)  # kept, and used
    # Slower instead of only smaller: better than the free motion, made smaller until it keeps the
    # limit.
    smaller = experiment(("K_z0",)).errors(free.lengthening.power * (most / free.acceleration) ** 2)
    assert free.stderr["K_z0"] < made.stderr["K_z0"] < smaller["K_z0"]


def test_an_even_design_is_the_flat_one():
    made = designed(spread=1.0)
    assert made.gain == pytest.approx(1.0)
    assert not made.moves and "this motion is flat itself" in str(made)
    assert "so it is a good one to begin with" in in_a_line(made) and "too vague" not in str(made)


def test_a_flat_motion_is_drawn_and_called_once(tmp_path):
    for spread, names in ((1.0, {"flat motion"}), (0.0, {"flat motion", "designed motion"})):
        made = designed(spread=spread, error=0.05)
        density, _, errors = made.plot().axes
        assert set(density.get_legend_handles_labels()[1]) == names
        assert set(errors.get_legend_handles_labels()[1]) == names | {
            "now, without this record",
            "error asked for",
        }
        made.save(tmp_path / "motor.csv")
        head = (tmp_path / "motor.csv").read_text(encoding="utf-8").partition("time_s")[0]
        assert (
            ("designed by jaxmuscle for K_w0" in head)
            == ("designed motion" in names)
            != ("flat, made by" in head)
        )


def test_the_wanted_error_says_how_long_to_record():
    """At the length needed the errors are as wanted."""
    made = designed(error=0.04)
    assert made.needed is not None and made.needed[0] == 0.04
    errors = experiment(("K_w0",)).errors(made.lengthening.power, made.needed[1] / SECONDS)
    assert errors["K_w0"] / made.values["K_w0"] == pytest.approx(0.04, rel=1e-6)
    assert (
        f"to know K_w0 to 4 % (standard error), {made.needed[1]:.3g} s of record are enough"
        in in_a_line(made)
    )
    assert "no record that a person holds tells K_w0" in in_a_line(designed(error=1e-9))
    assert "no record that a person holds" in in_a_line(designed(rms=1e-4, error=0.04))
    assert (
        made.to_dict()["needed"]["seconds"] == made.needed[1]
        and designed(error=1e-9).to_dict()["needed"]["seconds"] is None
    )
    assert "what is known without this record is enough" in in_a_line(designed(error=0.999))
    with pytest.raises(ValueError, match="give at least 8 s"):
        designed(seconds=1.0)
    with pytest.raises(ValueError, match="error"):
        designed(error=-0.1)


def test_a_quantity_of_several_targets_has_its_plain_name():
    known = {"K_z0": 1.0, "K_w_tangent@held": 1.0, "K_w_tangent@moved": 1.0, "model_mean@held": 1.0}
    assert _full_name("K_w_tangent", known, [None, "moved", "held"]) == "K_w_tangent@moved"
    assert _full_name("K_w_tangent", known, ["held", "moved"]) == "K_w_tangent@held"
    assert [_full_name(n, known, [None, "moved", "held"]) for n in ("K_z0", "model_mean", "K")] == [
        "K_z0",
        "model_mean@held",
        "K",
    ]


def test_the_same_key_the_same_motion():
    again = jm.uncertainty.design_input(
        hold(), seconds=SECONDS, band=BAND, rate=50.0, key=jax.random.key(0)
    )
    np.testing.assert_array_equal(again.displacement, designed().displacement)
    assert not np.allclose(designed(key=1).displacement, designed().displacement)
    assert designed(key=1).stderr == pytest.approx(designed().stderr)


def test_a_task_instead_of_a_fit():
    """Its usual parameters are free, and there are no data: the start is the prior."""
    made = jm.uncertainty.design_input(TRUTH, band=BAND, rate=50.0)
    assert made.now["K_w0"] == pytest.approx(made.values["K_w0"])
    assert made.stderr["K_w0"] >= designed().stderr["K_w0"] * (1 - 1e-6)
    loose = jm.uncertainty.design_input(
        TRUTH.as_task(jm.PrescribedForce, P_w=TRUTH.P_w), band=BAND, rate=50.0
    )
    assert loose.stderr == pytest.approx(made.stderr)


# --- among the designs of a report


def test_the_standard_designs_know_what_a_flat_motion_tells():
    designs = [d for d in jm.uncertainty.standard_designs(hold()) if d.lengthening is not None]
    report = jm.identifiability(hold(), designs=designs)
    assert [d.name for d in report.designs] == MOVED
    usual = Motion().band
    bands = [(d.lengthening.frequency[0], d.lengthening.frequency[-1]) for d in designs]
    assert bands == [(0.5, 10.0), pytest.approx(usual)] and usual[0] == 0.5
    (small, large), made = report.designs, designed(band=usual)
    assert {"K_w0", "K_z0", "C_w0", "C_z0"} <= set(large.gained)
    for name in BASES:
        assert large.quantities[name].stderr == pytest.approx(made.flat[name], rel=1e-6)
        assert small.quantities[name].stderr > large.quantities[name].stderr
    assert all(design.masses_open for design in report.designs) and not report.present.masses_open


def test_a_measured_stiffness_with_these_errors_tells_the_same(x64):
    """The likelihood of a fit and the information of a design are one."""
    # As many points, settings and free parameters as in tests/fits/test_perturbed_fit.py: one
    # program.
    lengthening = Lengthening.flat(1e-3, (0.4, 5.0), 10.0)
    assert len(lengthening.frequency) == 47
    sd = np.sqrt(density(VALUES, lengthening.frequency) / (2 * 10.0 * lengthening.power))
    measured = FrequencyResponse(
        lengthening.frequency, stiffness(VALUES, lengthening.frequency), sd
    )
    recorded = jm.SpectrumSettings(filter_direction="both", sampling="filtered")
    task = jm.PrescribedLength(settings=recorded).replace(**VALUES)
    free, found = (*DEFAULT_FREE, "P_w", "m_w", "m_z"), {}
    for given in (None, measured):
        problem, theta = fitted_problem(fitted(task, free, stiffness=given), None)
        found[given is None] = information_of(problem, expansion_at(problem, theta))
    added = (found[False] - found[True])[:4, :4]
    expected = information(lengthening)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        added / np.outer(size, size), expected / np.outer(size, size), atol=1e-5
    )


# --- files, words, figure, mistakes


def test_the_file_for_the_motor(tmp_path):
    made = designed()
    made.save(tmp_path / "out" / "motor.csv")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["motor.csv"]
    lines = (tmp_path / "out" / "motor.csv").read_text().splitlines()
    assert (
        lines[0].startswith("# one period of a lengthening of 60 s")
        and lines[2] == "time_s,displacement_mm"
    )
    table = np.loadtxt(tmp_path / "out" / "motor.csv", delimiter=",", skiprows=3)
    np.testing.assert_allclose(table[:, 0], made.time, atol=1e-12)
    np.testing.assert_allclose(table[:, 1], 1e3 * made.displacement, rtol=1e-6)
    made.save(tmp_path / "design.json")
    kept = json.loads((tmp_path / "design.json").read_text())
    assert kept["quantities"]["K_w0"]["stderr"] == made.stderr["K_w0"] and kept["gain"] == made.gain


def test_the_default_band_begins_where_the_page_advises():
    """In Python and in the shell."""
    advised = re.search(
        r"^\| band \| ([\d.]+) to", (pages.ROOT / "docs" / "perturbed.md").read_text(), re.MULTILINE
    )
    here, shell = Motion().band, inspect.signature(design).parameters["band"].default
    assert advised is not None and float(advised[1]) == here[0]
    assert shell == f"{here[0]:g}:{here[1]:g}"


@pytest.mark.slow
def test_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = pages.run("docs/perturbed-design.md", {"result": hold(), "jm": jm})["made"]
    plt.close("all")
    assert (
        made.gain == pytest.approx(designed(band=(0.5, 5.0)).gain)
        and (tmp_path / "motor.csv").exists()
    )


def test_in_words():
    text = str(designed())
    assert max(map(len, text.splitlines())) <= 80
    said = in_a_line(text)
    assert (
        f"would measure K_w0 to {100 * designed().stderr['K_w0'] / designed().values['K_w0']:.2g} %"
        in said
    )
    assert (
        f"The squared relative error of K_w0 is then {designed().gain:.2g} times as large" in said
    )
    assert "A reflex can change K_w0" in said and "no fatigue. Split a long" in said
    # both masses are those with which the fit of a record begins
    assert designed().held == () and "m_w" not in said
    assert designed().to_dict()["masses"]["m_w"] == {"value": 0.5, "fitted": True}
    ((low, high, share),) = designed().moves
    assert (
        "1 mm rms, at most" in said
        and f"most of the motion: {100 * share:.0f} % at {low:.2g} to {high:.2g} Hz" in said
    )


def test_the_figure():
    figure = designed().plot()
    try:
        density_axes, motion, errors = figure.axes
        assert [label.get_text() for label in errors.get_yticklabels()] == [*BASES, *TANGENTS]
        assert np.max(np.abs(motion.lines[0].get_ydata())) <= 1e3 * designed().peak
        assert density_axes.get_yscale() == "log"
    finally:
        plt.close(figure)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"quantity": "K_w"}, "quantity 'K_w' is unknown: did you mean 'k_w'"),
        ({"quantity": "x_ref_w"}, "quantity 'x_ref_w' is fixed: leave its parameter free"),
        ({"rms": 0.0}, "rms = 0.0: give a finite number above 0"),
        ({"peak": -1e-3}, "peak = -0.001: give a finite number above 0"),
        ({"speed": 0.0}, "speed = 0.0: give a finite number above 0"),
        ({"acceleration": -1.0}, "acceleration = -1.0: give a finite number above 0"),
        ({"band": (0.0, 5.0)}, r"band = \(0, 5\) Hz must lie above 0 Hz"),
        ({"band": (5.0, 1.0)}, r"band = \(5, 1\) Hz must lie above 0 Hz"),
        ({"band": (0.1, 26.0)}, r"band = \(0.1, 26.0\) Hz reaches beyond half of rate = 50.0 Hz"),
        ({"seconds": 59.99}, "seconds = 59.99: rate = 50.0 Hz makes no whole number of samples"),
        ({"spread": 2.0}, "spread = 2.0 must be a share"),
        ({"rms": 1e-9}, "no motion within these limits tells of K_w0"),
        ({"target": "other"}, "target: the fit has none called 'other'"),
    ],
)
def test_mistakes(given, message):
    with pytest.raises(ValueError, match=message):
        designed(**given)


def test_a_motor_needs_an_insertion_to_move():
    loose = TRUTH.as_task(jm.PrescribedForce, P_w=0.0)
    design = jm.uncertainty.Design("moved", loose, lengthening=Lengthening.flat(1e-3, BAND))
    with pytest.raises(
        ValueError, match="moved: lengthening: in PrescribedForce no motor moves the insertion"
    ):
        jm.identifiability(fitted(segments=SEGMENTS), designs=[design])


def test_an_unknown_option_is_refused():
    with pytest.raises(TypeError, match=r"design_input\(\) has no option 'lenght'.*seconds"):
        jm.uncertainty.design_input(TRUTH, lenght=1.0)
