"""Figures: the right data with the right units, in the caller's axes, without a trace in
matplotlib's settings."""

from types import SimpleNamespace as Fake

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.special
from matplotlib.colors import to_rgb

from jaxmuscle import plot
from jaxmuscle._common.figures import pixels_of, write_figure
from jaxmuscle.checks._bootstrap import Bootstrap, Recovery
from jaxmuscle.data._measure import Measure
from jaxmuscle.data._target import Target, load_target
from jaxmuscle.model._rungs import on_rung
from jaxmuscle.model._tasks import Isometric, PrescribedForce, PrescribedLength, PrescribedMotion
from jaxmuscle.plot import _numbers as _plot_numbers
from jaxmuscle.plot import _steadiness as _plot_steadiness
from jaxmuscle.response._characteristics import static_characteristics
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._bin_law import welch_law
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum

SETTINGS = SpectrumSettings()
F = SETTINGS.frequency
PROPORTIONAL = ("Frequency (Hz)", "Proportional power (fraction per bin)")


@pytest.fixture(autouse=True)
def untouched():
    """No function changes rcParams or closes the caller's figures."""
    mine, before = plt.figure(), dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    assert plt.fignum_exists(mine.number)
    plt.close("all")


def spectra(seeds):
    power = (1e-3 / (1 + F**2)) * np.random.default_rng(0).chisquare(8, (*seeds, F.size))
    return Spectrum(F, power, SETTINGS, "N")


def trajectories(seeds, task=None):
    samples = 1500
    output = 2.0 + 0.01 * np.random.default_rng(1).normal(size=(*seeds, samples))
    task = Isometric() if task is None else task
    states = np.zeros((*seeds, samples, len(task.state_names)))
    return Trajectory(
        task,
        states,
        output,
        np.arange(seeds[0]) if seeds else np.array(0),
        100.0,
        1e-3,
        1,
        "instant",
    )


def band(ax):
    """Lower and upper edge of the only filled band of the axes, at its abscissae."""
    (filled,) = ax.collections
    points = filled.get_paths()[0].vertices
    x = np.unique(points[:, 0])
    return tuple(np.array([f(points[points[:, 0] == v, 1]) for v in x]) for f in (np.min, np.max))


def x_of(ax):
    return ax.lines[0].get_xdata()


def y_of(ax):
    return ax.lines[0].get_ydata()


def axes_of(ax):
    """The names of the abscissa and the ordinate."""
    return ax.get_xlabel(), ax.get_ylabel()


def labels_of(legend):
    return [text.get_text() for text in legend.get_texts()]


def texts(figure):
    return [text.get_text() for ax in figure.axes for text in ax.texts]


def named(container, label):
    (line,) = (line for line in container.lines if line.get_label() == label)
    return line


def test_spectrum_of_one_seed_is_its_proportional_power():
    one = spectra(())
    ax = plot.spectrum(one)
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xdata(), F)
    np.testing.assert_allclose(line.get_ydata(), one.power / one.power.sum(), rtol=1e-12)
    assert axes_of(ax) == PROPORTIONAL
    assert not ax.collections and ax.get_legend() is None


@pytest.mark.parametrize("seeds", [(40,), (4, 10)])
def test_spectrum_of_seeds_normalises_the_mean_power_and_shows_90_percent_of_them(seeds):
    several = spectra(seeds)
    ax = plot.spectrum(several)
    mean = several.power.reshape(40, -1).mean(0)
    np.testing.assert_allclose(y_of(ax), mean / mean.sum(), rtol=1e-12)
    each = (several.power / several.power.sum(-1, keepdims=True)).reshape(40, -1)
    np.testing.assert_allclose(band(ax), np.quantile(each, (0.05, 0.95), axis=0), rtol=1e-12)
    assert labels_of(ax.get_legend()) == [
        "5 to 95 % of seeds",
        "mean of 40 seeds",
    ]


def test_spectrum_in_absolute_units():
    one = spectra(())
    ax = plot.spectrum(one, proportional=False)
    np.testing.assert_array_equal(y_of(ax), one.power)
    assert ax.get_ylabel() == "Power (N²/Hz)"
    other = Spectrum(F, one.power, SETTINGS, "N m")
    assert plot.spectrum(other, proportional=False).get_ylabel() == "Power ((N m)²/Hz)"


def test_spectrum_on_logarithmic_axes_leaves_out_the_mean():
    settings = SpectrumSettings(first_bin=0)
    ax = plot.spectrum(Spectrum(settings.frequency, np.ones(31), settings), log=True)
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    np.testing.assert_array_equal(x_of(ax), F)
    np.testing.assert_allclose(y_of(ax), 1 / 31)


def test_seeds_that_are_not_finite_are_left_out_and_named():
    power = spectra((5,)).power.copy()
    power[2, 3] = np.nan
    ax = plot.spectrum(Spectrum(F, power, SETTINGS), proportional=False)
    np.testing.assert_allclose(y_of(ax), np.delete(power, 2, axis=0).mean(0))
    assert ax.lines[0].get_label() == "mean of 4 seeds, 1 not finite left out"
    assert plot.spectrum(Spectrum(F, power * np.inf, SETTINGS)).lines[0].get_label() == "not finite"


def test_drawing_into_given_axes_takes_the_next_colour_that_colour_blind_readers_can_tell():
    _, ax = plt.subplots()
    for i in range(len(plot.PALETTE)):
        assert plot.spectrum(spectra(()), ax) is ax
        assert ax.lines[i].get_color() == plot.PALETTE[i]
    assert len(set(plot.PALETTE)) == len(plot.PALETTE)


def test_what_is_drawn_later_is_not_cut_off():
    flat = Target("flat", np.ones(30))
    both = plot.spectrum(spectra(()), plot.target(flat))
    assert both.get_ylim()[0] == 0 and both.get_ylim()[1] > np.max(both.lines[1].get_ydata())
    assert both.get_xlim()[0] == 0 and both.get_xlim()[1] > F[-1]
    spectrum, _ = panels(plot.fit(result(target=flat)))
    assert spectrum.get_ylim()[1] > np.max(named(spectrum, "fit").get_ydata())
    assert spectrum.get_xlim()[0] < F[0] and spectrum.get_xlim()[1] > F[-1]


def test_target_with_segments_has_the_band_of_its_degrees_of_freedom():
    aim = load_target("vastus-lateralis-26mvc")
    ax = plot.target(aim)
    np.testing.assert_array_equal(y_of(ax), aim.proportional_power)
    # tests/spectra checks it by simulation
    half = welch_law(aim.settings, aim.bins, aim.segments).degrees / 2
    bias, sd = scipy.special.psi(half) - np.log(half), np.sqrt(scipy.special.polygamma(1, half))
    edges = [aim.proportional_power * np.exp(-bias + side * sd) for side in (-1, 1)]
    np.testing.assert_allclose(band(ax), edges, rtol=1e-12)
    assert axes_of(ax) == PROPORTIONAL
    assert ax.lines[0].get_label() == "vastus-lateralis-26mvc (measured)"


def test_the_band_covers_the_true_spectrum_as_often_as_one_standard_deviation_does():
    aim = load_target("vastus-lateralis-26mvc")
    draws = 4000
    nu = welch_law(aim.settings, aim.bins, aim.segments).degrees[0]
    factor = np.random.default_rng(2).chisquare(nu, draws) / nu
    low, high = (edge[0] / aim.proportional_power[0] for edge in aim.sampling_band())
    covered = np.mean((factor * low < 1) & (factor * high > 1))
    # A normal law has 0.683 in this range, log χ² with 23 degrees of freedom within 0.01 of it.
    assert covered == pytest.approx(0.683, abs=0.01 + 4 * np.sqrt(0.22 / draws))
    above, below = np.mean(factor * low > 1), np.mean(factor * high < 1)
    assert above == pytest.approx(below, abs=0.03)


def test_target_with_sigma_has_its_band_and_says_that_it_is_assumed():
    aim = load_target("slifkin-newell-1999-95mvc")
    ax = plot.target(aim, log=True)
    sd = np.sqrt(np.log(1 + (aim.sigma / aim.proportional_power) ** 2))
    np.testing.assert_allclose(
        band(ax),
        [aim.proportional_power * np.exp(-sd), aim.proportional_power * np.exp(sd)],
        rtol=1e-12,
    )
    labels = labels_of(ax.get_legend())
    assert labels == ["± 1 SD (assumed)", "slifkin-newell-1999-95mvc (reconstructed)"]


def test_target_of_unknown_spread_has_no_band():
    aim = Target("a" * 60, np.ones(30))
    ax = plot.target(aim)
    assert aim.sampling_band() is None and not ax.collections
    assert len(ax.lines[0].get_label()) < 60


def test_a_name_is_no_mathematics_and_never_hidden():
    ax = plot.target(Target(r"_$\no math$", np.ones(30)))
    ax.figure.canvas.draw()
    assert labels_of(ax.get_legend()) == [r"\$\no math\$ (user)"]


def test_trajectory_of_one_seed():
    run = trajectories(())
    ax = plot.trajectory(run)
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xdata(), run.time)
    np.testing.assert_array_equal(line.get_ydata(), run.output)
    assert axes_of(ax) == ("Time (s)", r"Force $F_\mathrm{ext}$ (N)")


def test_trajectory_of_an_ensemble_in_a_window():
    runs = trajectories((20,))
    ax = plot.trajectory(runs, window=(5.0, 10.0), lines=2)
    inside = runs.output[:, 500:1000]
    np.testing.assert_allclose(y_of(ax), inside.mean(0), rtol=1e-12)
    np.testing.assert_array_equal(x_of(ax), runs.time[500:1000])
    np.testing.assert_array_equal([line.get_ydata() for line in ax.lines[1:]], inside[:2])
    np.testing.assert_allclose(band(ax), np.quantile(inside, (0.05, 0.95), axis=0), rtol=1e-12)
    with pytest.raises(ValueError, match="window"):
        plot.trajectory(runs, window=(5.0, 30.0))


def test_trajectory_of_a_displacement():
    ax = plot.trajectory(trajectories((), PrescribedForce()))
    assert ax.get_ylabel() == r"Displacement $x_\mathrm{z}$ (m)"
    ax = plot.trajectory(trajectories((), PrescribedForce(observe="acceleration")))
    assert ax.get_ylabel() == r"Acceleration $a_\mathrm{z}$ (m/s²)"


def test_simulation_shows_run_window_and_spectra():
    runs = trajectories((3,))
    figure = plot.simulation(runs)
    whole, window, linear, logarithmic = figure.axes
    assert whole.lines[0].get_xdata().size == 1500 and window.lines[0].get_xdata()[0] == 5.0
    mean = np.asarray(runs.spectrum().mean().proportional)
    for ax in (linear, logarithmic):
        np.testing.assert_allclose(y_of(ax), mean, rtol=1e-5)  # float32
    figure.canvas.draw()


def test_methods_draw_the_same(x64):
    del x64
    assert plot.spectrum(spectra(())).get_ylabel() == spectra(()).plot().get_ylabel()
    assert trajectories((2,)).plot().get_xlabel() == "Time (s)"
    assert load_target("hamilton-2004").plot().lines[0].get_ydata().size == 30


def test_arrays_of_jax_are_drawn():
    with jax.enable_x64(False):
        one = spectra((3,))
        ax = plot.spectrum(Spectrum(jnp.asarray(F), jnp.asarray(one.power), SETTINGS))
    assert y_of(ax).size == F.size


def estimate(value, unit, stderr=None, free=True, identifiable=None):
    known = stderr is not None if identifiable is None else identifiable
    return Fake(value=value, unit=unit, stderr=stderr, free=free, identifiable=known)


def result(**changes):
    """What a fit returns, as far as its figures read it."""
    aim = changes.pop("target", load_target("vastus-lateralis-26mvc"))
    f = aim.frequency
    share = np.where(np.abs(f - 3.9) < 0.5, 0.5, 0.0)
    fitted = 1 / (1 + f**2) / (1 - share)
    fields = {
        "task": Isometric().replace(harmonic_frequency=3.9),
        "target": aim,
        "frequency_hz": f,
        "fitted": fitted / fitted.sum(),
        "harmonic_share": share,
        "components": {
            "relaxation": 0.9 * (1 - share),
            "floor": 0.1 * (1 - share),
            "harmonic": share,
        },
        "residual": np.resize([0.5, -1.5, 2.5, -0.5], f.size),
        "deviation": np.full(f.size, 0.3),
        "stretch": (10 + np.arange(500) / 100, 5 + 0.01 * np.sin(np.arange(500))),
        "recorded": (np.arange(400) / 100, 20 + np.cos(np.arange(400))),
        "stiffness": None,
        "adequate": True,
        "parameters": {},
        "determined": [f"{name}_frequency" for name in ("harmonic", "resonance", "resonance_2")],
    }
    found = Fake(**(fields | changes))
    found.only = found
    found.parts = {found.target.name: found}
    return found


def failed():
    names = ("fitted", "harmonic_share", "residual")
    nothing = dict.fromkeys(names, np.full(30, np.nan))
    return result(stretch=(np.zeros(0), np.zeros(0)), deviation=None, **nothing)


def tremor(size=0.8):
    """The parts of a model with so large a share of tremor about 9 Hz."""
    f = load_target("vastus-lateralis-26mvc").frequency
    own = np.where(np.abs(f - 9) < 1, size, 0.0)
    return {"relaxation": 0.7 * (1 - own), "floor": 0.3 * (1 - own), "resonance": own}


def panels(figure):
    """Spectrum and residuals."""
    return figure.axes[:2]


def key(figure):
    """What the legend of a fit's figure says."""
    (legend,) = figure.legends
    return labels_of(legend)


def test_the_parts_of_a_model_add_up_to_the_fit():
    found = result(components=tremor(), task=on_rung(Isometric(), 2))
    figure = plot.fit(found)
    labels = [label for label in key(figure) if "%" in label]
    assert [label.partition(",")[0] for label in labels] == ["slow part", "floor", "resonance"]
    shares = [float(label.split(", ")[1].split()[0]) for label in labels]
    assert sum(shares) == pytest.approx(100, abs=1.5)  # two digits each
    spectrum, _ = panels(figure)
    total = np.sum([named(spectrum, label).get_ydata() for label in labels], axis=0)
    np.testing.assert_allclose(total, found.fitted, rtol=1e-12)


def of_two_resonances(tremor, **changes):
    """A fit with so large a share of tremor, and with a second resonance."""
    f = result().frequency_hz
    second = np.where(f < 4, 0.13, 0.0)
    rest = 1 - tremor - second
    parts = {
        "relaxation": 0.9 * rest,
        "floor": 0.1 * rest,
        "resonance": tremor + 0 * f,
        "resonance_2": second,
    }
    task = on_rung(Isometric(), 3).replace(
        **({"resonance_frequency": 9.22, "resonance_2_frequency": 3.7} | changes)
    )
    return result(components=parts, task=task)


def test_the_frequencies_of_resonances_are_marked_in_the_colours_of_their_parts():
    figure = plot.fit(of_two_resonances(0.2))
    spectrum, _ = panels(figure)
    for label, where, color in (
        ("resonance, 20 % (9.22 Hz)", 9.22, plot.GREEN),
        ("second resonance,", 3.7, plot.PURPLE),
    ):
        (words,) = (each for each in key(figure) if each.startswith(label))
        assert f"({where:g} Hz)" in words and named(spectrum, words).get_color() == color
        assert [
            line.get_color() for line in spectrum.lines if list(line.get_xdata()) == [where, where]
        ] == [color]
    assert not any(label.startswith("regular rhythm") for label in key(figure))


def test_a_fit_draws_no_number_that_it_does_not_state():
    """Of a rhythm whose frequency has no error neither this nor a share; where the model does not
    describe the data none at all."""
    some = of_two_resonances(0.2)
    some.determined = ["resonance_frequency"]
    assert "second resonance" in key(plot.fit(some))
    assert "resonance, 20 % (9.22 Hz)" in key(plot.fit(some))
    some.parameters = {"resonance_2_frequency": Fake(free=False)}
    assert any(label.endswith("(3.7 Hz)") for label in key(plot.fit(some)))
    some.adequate = False
    figure = plot.fit(some)
    assert not any(sign in label for label in key(figure) for sign in ("%", "Hz"))
    upright = [line for line in panels(figure)[0].lines if len({*line.get_xdata()}) == 1]
    assert not upright


def test_the_words_below_a_fit_of_two_resonances_find_room_in_its_width():
    figure = plot.fit(of_two_resonances(0.2))
    figure.canvas.draw()
    words = figure.legends[0].get_window_extent()
    assert words.x0 >= 0 and words.x1 <= figure.bbox.width


@pytest.mark.parametrize(
    ("frequency", "share", "words"),
    [(25.0, 0.2, ["resonance, 20 % (25 Hz)"]), (9.22, 1e-6, [])],
)
def test_a_tremor_outside_the_bins_or_without_power_is_not_marked_there(frequency, share, words):
    ax = panels(plot.fit(of_two_resonances(share, resonance_frequency=frequency)))[0]
    assert [
        str(x.get_label()) for x in ax.lines if str(x.get_label()).startswith("resonance, ")
    ] == words
    assert not [line for line in ax.lines if list(line.get_xdata()) == [frequency, frequency]]


def test_fit_draws_the_spectrum_over_logarithmic_axes_with_target_and_harmonic():
    found = result()
    ax, residuals = panels(plot.fit(found))
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    np.testing.assert_array_equal(
        named(ax, "measured").get_ydata(), found.target.proportional_power
    )
    np.testing.assert_array_equal(named(ax, "fit").get_ydata(), found.fitted)
    held = found.fitted * found.harmonic_share
    words = f"regular rhythm, {100 * held.sum():.2g} % (3.9 Hz)"
    np.testing.assert_array_equal(named(ax, words).get_ydata(), held)
    assert ax.get_ylabel() == "Power (fraction per bin)"
    # one frequency axis for both
    assert residuals.get_xlim() == ax.get_xlim() and residuals.get_xlabel() == "Frequency (Hz)"
    assert not ax.get_xlabel()


def test_a_fit_of_several_targets_has_a_spectrum_and_residuals_of_each_by_name():
    found = result()
    found.parts = {"low": found.only, "high": result(components=tremor()).only, "$c$": found.only}
    figure = plot.fit(found)
    figure.canvas.draw()
    assert [ax.get_title("left") for ax in figure.axes[::2]] == [*found.parts]
    assert len(figure.axes) == 6 and not any("%" in label for label in key(figure))


def test_fit_draws_residuals_in_standard_deviations_and_marks_the_large_ones():
    found = result()
    _, ax = panels(plot.fit(found))
    drawn = {}
    for line in ax.lines:
        if line.get_marker() == "o":
            drawn |= {x: (y, line.get_color()) for x, y in line.get_xydata()}
    assert [drawn[x][0] for x in found.frequency_hz] == list(found.residual)
    large = [line for line in ax.lines if line.get_marker() == "o"][1]
    assert large.get_markerfacecolor() != large.get_color()  # seen without colours, too
    colours = np.where(np.abs(found.residual) > 2, plot.VERMILLION, plot.BLUE)
    assert [drawn[x][1] for x in found.frequency_hz] == list(colours)
    spans = {(p.get_y(), p.get_y() + p.get_height()) for p in ax.patches}
    assert spans == {(-1.0, 1.0), (-2.0, 2.0)}
    assert ax.get_ylabel() == "Residual\n(SD)"


def test_fit_draws_what_was_recorded_beside_what_it_simulated():
    found = result()
    *_, measured, simulated = plot.fit(found).axes
    for ax, (time, output) in ((measured, found.recorded), (simulated, found.stretch)):
        np.testing.assert_allclose(x_of(ax), time - time[0])
        np.testing.assert_allclose(y_of(ax), 100 * output / np.mean(output))
    assert measured.get_ylim() == simulated.get_ylim()
    assert axes_of(measured) == ("Time (s)", "Force\n(% of mean)")
    moving = Target("moving", np.ones(30), quantity="displacement", segments=12)
    *_, measured, _ = plot.fit(result(target=moving)).axes
    assert measured.get_ylabel() == "Displacement\n(SD)" and np.std(
        y_of(measured)
    ) == pytest.approx(1)
    bare = np.zeros(0), np.zeros(0)
    assert len(plot.fit(result(recorded=bare)).axes) == 2  # nothing to compare


def test_fit_has_no_verdict_and_no_name_of_a_file():
    figure = plot.fit(result(adequate=False, adequacy_p=1e-9))
    assert figure.get_suptitle() == "" and not texts(figure)
    assert not any(ax.get_title(place) for ax in panels(figure) for place in ("left", "right"))


def test_fit_of_a_reconstruction_says_so():
    aim = load_target("slifkin-newell-1999-35mvc")
    assert {"reconstructed", "± 1 SD (assumed)"} <= set(key(plot.fit(result(target=aim))))


def test_a_failed_fit_still_shows_the_target_and_the_reason():
    figure = plot.fit(failed())
    figure.canvas.draw()
    assert texts(figure) == ["no finite fit"]
    assert not any(line.get_label() == "fit" for line in panels(figure)[0].lines)


def test_a_fit_without_known_spread_draws_logarithms_without_bands():
    aim = Target("few bins", [0.5, 0.3, 0.2], bins=[2, 3, 4])
    figure = plot.fit(
        result(
            target=aim,
            deviation=None,
            fitted=aim.proportional_power,
            harmonic_share=np.zeros(3),
            components={},
            frequency_hz=aim.frequency,
            residual=np.zeros(3),
        )
    )
    figure.canvas.draw()
    ax = panels(figure)[1]
    assert ax.get_ylabel() == "Residual\n(ln)" and not ax.patches


def test_without_linear_response_the_harmonic_is_still_drawn():
    assert any(label.startswith("regular rhythm") for label in key(plot.fit(result(components={}))))


def test_letters_of_a_fit_are_legible_and_do_not_touch():
    figure = plot.fit(result(target=Target("a name " * 20, np.ones(30), segments=12)))
    assert small_words(figure) == ([], [], [])


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (estimate(4.2512, "Hz", 0.0473), ("4.251", "± 0.047", "Hz")),
        (estimate(423456.0, "N/m^3", 13000.0), ("4.23", "± 0.13", "10⁵ N/m³")),
        (estimate(0.0031, "1", 0.0004), ("3.10", "± 0.40", "10⁻³")),
        (estimate(0.12, "1", 3.0), ("0.1", "± 3.0", "1")),
        (estimate(0.0, "1/Hz", identifiable=True), ("0.00", "–", "1/Hz")),
        (estimate(5e5, "N/m^3"), ("5.00", "not determined", "10⁵ N/m³")),
        (estimate(168.0, "N/m", np.nan), ("168", "–", "N/m")),
        (estimate(np.nan, "N"), ("not finite", "", "N")),
        (estimate(9.996, "N", 0.5), ("10.00", "± 0.50", "N")),
    ],
)
def test_numbers_are_printed_to_two_digits_of_their_error(shown, expected):
    assert _plot_numbers.quantity(shown) == expected


def steady(count, unit="N", tremor=9.0):
    """A report of trials whose numbers are known."""
    names = (
        "relative_power_0_0.5",
        "relative_power_above_12",
        *_plot_steadiness.VARIATIONS.values(),
        *_plot_steadiness.REGULARITY.values(),
    )

    def measures(i):
        each = {
            name: Fake(value=0.1 * (k + 1) + 0.01 * i, interval=(0.05 * (k + 1), k + 1.0))
            for k, name in enumerate(names)
        }
        absolute = {name.removeprefix("relative_"): Fake(**vars(each[name])) for name in names[:2]}
        seen = Fake(value=tremor, interval=(tremor - 0.5, tremor + 0.4))
        return each | absolute | {"mean": Fake(value=4.0), "tremor_frequency": seen}

    trials = {f"trial {i}": measures(i) for i in range(count)}
    each = np.arange(1, 1 + count)[:, None] / F
    spectrum = F, each, each.mean(axis=0)
    about = {"unit": unit, "band": (6.0, 12.0), "spectrum": spectrum}
    return Fake(trials=trials, measures=measures(1), **about)


@pytest.mark.parametrize("count", [3, 1])
def test_steadiness_shows_every_trial_and_the_value_of_all(count):
    found = steady(count)
    figure = plot.steadiness(found)
    figure.canvas.draw()
    _, power, variation, *regularity = figure.axes
    assert power.get_ylabel() == "Power (1e-6 mean²)" and power.get_yscale() == "log"
    assert [tick.get_text() for tick in power.get_xticklabels()] == ["0", "0.5", "30"]
    words = f"{count} trials, in their order"
    dots = [line for ax in figure.axes for line in ax.lines if line.get_label() == words]
    assert [line.get_ydata().size for line in dots] == ([6, 9, 3, 3, 3] if count > 1 else [])
    np.testing.assert_allclose(power.containers[0].lines[0].get_ydata(), [1.1e5, 2.1e5])
    np.testing.assert_allclose(variation.containers[0].lines[0].get_ydata(), [31, 41, 51])
    values = [ax.containers[0].lines[0].get_ydata()[0] for ax in regularity]
    np.testing.assert_allclose(values, [0.61, 0.71, 0.81])
    # the ends of the 95 % intervals, in percent of the mean
    (bars,) = variation.containers[0].lines[2]
    ends = np.array([bar[:, 1] for bar in bars.get_segments()])
    np.testing.assert_allclose(ends, [[15, 300], [20, 400], [25, 500]])
    if count > 1:  # the mean hides no trial
        beside = dots[1].get_xdata()[:, None] - variation.containers[0].lines[0].get_xdata()
        assert np.min(np.abs(beside)) > 0.1


def test_steadiness_shows_the_spectrum_with_its_peak_or_says_that_there_is_none():
    found = steady(3)
    figure = plot.steadiness(found)
    spectrum = figure.axes[0]
    _, each, mean = found.spectrum
    drawn = [line.get_ydata() for line in spectrum.lines[:4]]
    # over a mean of 4, squared
    np.testing.assert_allclose(drawn, [*(1e6 / 16 * each), 1e6 / 16 * mean])
    assert spectrum.get_ylabel() == "Power (1e-6 mean²/Hz)"
    assert list(spectrum.lines[4].get_xdata()) == [9, 9]
    spans = {(p.get_x(), p.get_x() + p.get_width()) for p in spectrum.patches}
    assert spans == {(6, 12), (8.5, 9.4)}
    assert "tremor, 9.00 Hz (8.50 to 9.40)" in key(figure)
    figure = plot.steadiness(steady(3, tremor=np.nan))
    assert "tremor band, 6 to 12 Hz: none seen" in key(figure)
    assert len(figure.axes[0].lines) == 4


def test_steadiness_without_a_variation_is_in_the_unit_of_the_signal():
    report = steady(1, "deg/s")
    for measures in (report.measures, *report.trials.values()):
        for name in _plot_steadiness.VARIATIONS.values():
            measures[name].value, measures[name].interval = np.nan, None
    figure = plot.steadiness(report)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["Power ((deg/s)²/Hz)", "Power ((deg/s)²)", *_plot_steadiness.REGULARITY]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), report.spectrum[2])
    np.testing.assert_allclose(figure.axes[1].containers[0].lines[0].get_ydata(), [0.11, 0.21])


def test_starts_are_drawn_in_the_order_of_where_they_ended():
    ended = [(9.0, True), (4.0, True), (None, False), (4.5, False), (4.0, True)]
    ax = plot.starts(Fake(starts=tuple(Fake(cost=c, success=s) for c, s in ended)))
    settled, other = ax.lines
    np.testing.assert_allclose(settled.get_xydata(), [[1, 0], [2, 0], [4, 10]])
    np.testing.assert_allclose(other.get_xydata(), [[3, 1]])
    assert labels_of(ax.get_legend()) == ["3 settled", "1 did not settle"]
    assert not plot.starts(Fake(starts=())).lines


def cohort_of(people=6, bins=30, name="p", groups="ab"):
    """A cohort of groups, as far as its figures read it; `bins` of the last person."""
    rng = np.random.default_rng(4)
    results, rows = {}, []
    for i in range(people):
        count = 30 if i < people - 1 else bins
        target, power = f"{name}{i}", np.exp(0.2 * rng.standard_normal(count))
        results[target] = Fake(target=Target(target, power, bins=range(1, count + 1), segments=[6]))
        about = {"target": target, "group": groups[i % len(groups)], "mvc_fraction": None}
        rows += [
            about | {"quantity": "corner_frequency", "value": 1.0 + i, "stderr": 0.1, "unit": "Hz"},
            about | {"quantity": "share_0.5_1", "value": 0.1 * i, "stderr": 0.01, "unit": "1"},
            about | {"quantity": "k_w", "value": 1.0, "stderr": None, "unit": "N/m^3"},
        ]
    named = {each: groups[i % len(groups)] for i, each in enumerate(results)}
    return Fake(results=results, groups=named, table=lambda: rows)


def test_groups_have_a_mean_spectrum_and_their_numbers():
    found = cohort_of()
    spectra, corner, share = plot.groups(found).axes
    power = np.stack([found.results[f"p{i}"].target.proportional_power for i in (1, 3, 5)])
    mean = named(spectra, "b (3 people)")
    np.testing.assert_allclose(mean.get_ydata(), np.exp(np.log(power).mean(axis=0)), rtol=1e-12)
    error = np.log(power).std(axis=0, ddof=1) / np.sqrt(3)
    last = spectra.collections[-1].get_paths()[0].vertices
    edges = [[f(last[np.isclose(last[:, 0], x), 1]) for x in F] for f in (np.min, np.max)]
    np.testing.assert_allclose(edges, mean.get_ydata() * np.exp([[-1], [1]] * error), rtol=1e-9)
    assert corner.get_ylabel() == "corner frequency\n(Hz)"
    words = "share of variance, 0.5 to 1\N{NO-BREAK SPACE}Hz (%)"
    assert share.get_ylabel().replace("\n", " ") == words
    people = [
        line.get_ydata() for line in corner.lines if line.get_alpha() and line.get_marker() == "o"
    ]
    np.testing.assert_array_equal(np.ravel(people), [1, 3, 5, 2, 4, 6])
    means = [container.lines[0].get_ydata()[0] for container in corner.containers]
    np.testing.assert_allclose(means, [3, 4])
    np.testing.assert_allclose([c.lines[0].get_ydata()[0] for c in share.containers], [20, 30])
    (bars,) = corner.containers[0].lines[2]
    ((low, high),) = [bar[:, 1] for bar in bars.get_segments()]
    # Student's t of two degrees of freedom, 4.303; the standard error of 1, 3, 5 is 2 / √3
    np.testing.assert_allclose(
        [low, high], 3 + 4.3027 * 2 / np.sqrt(3) * np.array([-1, 1]), rtol=1e-4
    )
    assert len(plot.groups(cohort_of(bins=20)).axes) == 2  # spectra of different bins have no mean
    with pytest.raises(ValueError, match="nothing to draw"):
        plot.groups(found, quantities=["k_w"])


def test_people_who_were_measured_in_several_conditions_are_joined():
    found = cohort_of(4)
    once = found.table()
    again = [
        row | {"person": row["target"], "condition": condition, "value": row["value"] + add}
        for condition, add in (("rest", 0.0), ("tired", 2.0))
        for row in once
    ]
    again = [row for row in again if (row["target"], row["condition"]) != ("p0", "tired")]
    found.table = lambda: again
    p = {("corner_frequency", "rest", "tired"): 0.012}
    corner, share = plot.cohort(found, "group", p=p).axes
    corner.figure.canvas.draw()
    assert [tick.get_text() for tick in corner.get_xticklabels()] == ["a", "b"]
    assert labels_of(corner.figure.legends[0]) == ["rest", "tired"]
    assert [text.get_text() for text in corner.texts] == ["all people: p = 0.012"]
    assert not share.texts
    low, high = corner.get_ylim()
    assert corner.get_yticks()[0] == low and corner.get_yticks()[-1] == high
    lines = [line for line in corner.lines if line.get_linestyle() == "-" and line.get_alpha()]
    joined = [line.get_ydata() for line in lines]
    np.testing.assert_array_equal(joined, [[1, np.nan], [3, 5], [2, 4], [4, 6]])
    places = [line.get_xdata() for line in lines]
    assert places[0][1] < places[2][0]  # groups do not overlap
    # of one person there is no interval; the others do not lie between the ends of lines
    assert len(corner.containers) == 3
    for i, at in zip(
        (0, 2, 2), (c.lines[0].get_xdata()[0] for c in corner.containers), strict=True
    ):
        assert not places[i][0] <= at <= places[i][1]


CELLS = [
    "young adults, rested",
    "older adults, rested",
    "young adults, fatigued",
    "older adults, fatigued",
]


def studied():
    """A study of three conditions, as far as its figure reads it; one person was not measured in
    the first."""
    conditions, people = (
        ["low force", "high force", "low force, with the eyes closed"],
        cohort_of(12, groups=CELLS[:2]),
    )
    cells = [
        Fake(target=result.target, group=people.groups[name], condition=condition, power=None)
        for name, result in people.results.items()
        for condition in conditions
    ][1:]
    return Fake(cells=cells, groups=CELLS[:2], conditions=conditions)


def test_a_study_has_one_key_that_lies_outside_all_spectra():
    figure = plot.study(studied())
    figure.canvas.draw()
    (key,) = figure.legends
    study = studied()
    assert labels_of(key) == [*study.conditions, "thick: geometric mean ± SE"]
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == ["young adults, rested (5…", "older adults, rested (6…"]
    assert not any(key.get_window_extent().overlaps(ax.get_window_extent()) for ax in figure.axes)
    assert all(ax.get_xlabel() for ax in figure.axes)
    one = Fake(cells=study.cells[::3], groups=study.groups, conditions=study.conditions[-1:])
    (panel,) = (figure := plot.study(one)).axes  # of one condition the groups are the colours
    assert labels_of(figure.legends[0])[:2] == [f"{group} (6 people)" for group in CELLS[:2]]
    assert panel.get_title(loc="left") == study.conditions[-1][:23] + "…"


def test_the_tremor_of_a_person_is_a_mark_above_all_spectra():
    study = studied()
    cell, f = study.cells[-1], study.cells[-1].target.frequency
    tremor = {"tremor_frequency": Measure(9.0, 0.2, "Hz", "trials", (8.5, 9.5))}
    cell.target = Target("shaking", 1 / f, segments=[6], measured=tremor)
    *_, panel = plot.study(study).axes
    (mark,) = (line for line in panel.lines if line.get_marker() == "v")
    assert list(mark.get_xdata()) == [9.0] and mark.get_color() == plot.GREEN
    panel.figure.canvas.draw()
    height = mark.get_transform().transform(mark.get_xydata())[0, 1]
    lines = [line for line in panel.lines if line.get_marker() != "v" and len(line.get_xdata())]
    near = [np.interp(9.0, line.get_xdata(), line.get_ydata()) for line in lines]
    assert height > panel.transData.transform([(9.0, max(near))])[0, 1]


def test_a_dollar_in_a_name_is_no_mathematics():
    groups = ["$x_1$ at rest", "b"]
    people = cohort_of(groups=groups, name="$p$")
    cells = [
        Fake(target=result.target, group=people.groups[name], condition="all", power=None)
        for name, result in people.results.items()
    ]
    study = Fake(cells=cells, groups=groups, conditions=["all"])
    short = cohort_of(groups=["$a$", "b"])
    for figure in (
        plot.cohort(people),
        plot.groups(people),
        plot.groups(short),
        plot.cohort(short, "group"),
        plot.study(study),
    ):
        figure.canvas.draw()
        named = [text for text in words_of(figure) if "$" in text.get_text()]
        assert named and not any(text.get_parse_math() for text in named)


def test_long_names_do_not_take_the_height_of_the_panels():
    short, long = (plot.cohort(cohort_of(12, name=name)) for name in ("p", "participant-"))
    for figure in (short, long):
        figure.canvas.draw()
    heights = [figure.axes[0].get_window_extent().height for figure in (short, long)]
    assert heights[1] > 0.8 * heights[0]


def words_of(figure):
    """Every text that is drawn: labels of ticks outside the axes are not."""
    yield from (text for each in (figure, *figure.subfigs) for text in each.texts)
    yield from (
        text for legend in figure.findobj(matplotlib.legend.Legend) for text in legend.get_texts()
    )
    for ax in figure.axes:
        yield from (
            ax.title,
            ax._left_title,
            ax._right_title,
            ax.xaxis.label,
            ax.yaxis.label,
            *ax.texts,
        )
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            yield from (
                tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high
            )


def small_words(figure, tall=0.8):
    """What is smaller than 6 points where the figure is 85 mm wide, leaves the figure, or overlaps
    something else."""
    figure.canvas.draw()
    width, height = figure.canvas.get_width_height()
    texts = [text for text in words_of(figure) if text.get_text().strip() and text.get_visible()]
    boxes = [(text.get_text(), text.get_window_extent().shrunk(0.98, tall)) for text in texts]
    small = [
        text.get_text()
        for text in texts
        if text.get_fontsize() * 85 / 25.4 / figure.get_figwidth() < 6.0
    ]
    out = [
        word
        for word, box in boxes
        if box.x0 < -1 or box.x1 > width + 1 or box.y0 < -1 or box.y1 > height + 1
    ]
    touch = [
        (a, b) for i, (a, one) in enumerate(boxes) for b, other in boxes[:i] if one.overlaps(other)
    ]
    return small, out, touch


def designed():
    """A motion with the errors of the usual quantities, as far as its figure reads it."""
    told, f, time = ["K_w0", "K_z0", "C_w0", "C_z0"], np.linspace(0.1, 5, 50), np.arange(3000) / 50
    lines = Fake(power=np.linspace(1e-7, 1e-10, 50), seconds=60.0)
    errors = [
        dict(zip(told, 100.0 * np.array([0.81, 0.36, 0.044, 0.0083]) / k, strict=True))
        for k in (1, 5, 9)
    ]
    return Fake(
        names=told,
        frequency=f,
        time=time,
        displacement=1e-3 * np.sin(time),
        even=lines,
        lengthening=lines,
        now=errors[0],
        flat=errors[1],
        stderr=errors[2],
        percent=lambda name, known: known[name],
        moves=((0.1, 1.0, 0.9),),
        needed=(0.05, 40.0),
    )


def identified():
    """A report of the bundled measurements; two directions now are far too small to be drawn."""
    told = [
        "harmonic_frequency",
        "K_w0",
        "half_power_frequency",
        "model_coefficient_of_variation",
        "band_8_12",
    ]
    names = [
        "the mean force, known to 2 %",
        "60 s with the insertion moved by 0.1 mm rms to 10 Hz",
        "a second force level",
    ]
    size = np.array([300.0, 20.0, 4.0, 1.5, 0.02, 1e-7, 1e-9])

    def outlook(name, factor):
        known = {
            t: Fake(left=0.1 * k, determined=k < 3, percent=f"{0.98 + k:.2f} %")
            for k, t in enumerate(told)
        }
        found = size * factor
        count = int(np.sum(found >= 3.0))
        return Fake(
            name=name, failed=None, singular_values=found, determined=count, quantities=known
        )

    designs = [outlook(name, 10.0**i) for i, name in enumerate(names)]
    return Fake(
        target="vastus-lateralis-26mvc",
        designs=designs,
        present=outlook("now", 1.0),
        names=told,
        open_in_fit=(),
        letter=lambda i: "ABC"[i],
        doubt="The fit does not describe its data",
    )


def judged(points=0):
    """A fit against replicates of it, also of a dynamic stiffness at so many points."""
    rng, aim = np.random.default_rng(5), load_target("vastus-lateralis-26mvc")
    reference = {
        "chi2_per_bin": rng.gamma(9, 0.09, 999),
        "runs": rng.integers(8, 20, 999),
        "largest": rng.gamma(20, 0.1, 999),
    }
    part = Fake(
        target=aim,
        residual=np.resize([0.5, -1.5, 2.5, -0.5], 30),
        residuals=rng.normal(size=(999, 30)),
        reference=reference,
        observed={"chi2_per_bin": 1.18, "runs": 14, "largest": 2.37},
        foretold=True,
        p_values={"chi2_per_bin": 0.0791, "runs": 0.66, "largest": 0.0251, "all": 0.0412},
        stiffness_residual=np.resize([0.5 + 1j, -2.5 + 1j], points),
        stiffness_residuals=np.zeros((999, points), complex),
    )
    if points:
        known = Fake(frequency=np.geomspace(0.1, 10, points))
        part.target = Fake(name=aim.name, frequency=aim.frequency, stiffness=Fake(known=known))
        part.stiffness_residuals = rng.normal(size=(999, points)) + 1j * rng.normal(
            size=(999, points)
        )
        part.observed |= {"chi2_per_point": 2.4, "largest_point": 2.7}
        reference |= {
            "chi2_per_point": rng.gamma(20, 0.05, 999),
            "largest_point": rng.gamma(30, 0.08, 999),
        }
        part.p_values |= {"chi2_per_point": 0.001, "largest_point": 0.2}
    return Fake(parts={"a": part})


def refitted(
    names=("corner_frequency", "band_8_12", "model_coefficient_of_variation", "band_0.5_1"),
):
    """Fifty refits that scatter as stated."""
    values = 1.0 + 0.1 * scipy.stats.norm.ppf((np.arange(50) + 0.5) / 50)
    each = {name: Recovery(name, "1", 1.0, 0.1, values, np.full(50, 0.1)) for name in names}
    return Fake(target="vastus-lateralis-26mvc", quantities=each, replicates=51, failed={3: "no"})


@pytest.mark.slow
@pytest.mark.parametrize(
    "draw",
    [
        lambda: plot.simulation(trajectories((3,))),
        lambda: plot.fit(result()),
        lambda: plot.groups(cohort_of()),
        lambda: plot.groups(cohort_of(12, groups=CELLS)),
        lambda: plot.groups(cohort_of(12, 20, groups=CELLS)),
        lambda: plot.cohort(cohort_of()),
        lambda: plot.cohort(cohort_of(12, groups=CELLS), "group"),
        lambda: plot.study(studied()),
        lambda: plot.steadiness(steady(5)),
        lambda: plot.designed_input(designed()),
        lambda: plot.identifiability(identified()),
        lambda: plot.goodness(judged()),
        lambda: plot.goodness(judged(points=40)),
        lambda: plot.bootstrap(refitted()),
        lambda: plot.static(static_characteristics(Isometric()))[0].figure,
        lambda: (
            plot.coverage(
                {"corner_frequency": np.arange(20), "k_w": np.arange(20)}, draws=19
            ).figure
        ),
    ],
    ids=[
        "simulation",
        "fit",
        "groups",
        "long groups",
        "unlike bins",
        "cohort",
        "cells",
        "study",
        "steadiness",
        "designed_input",
        "identifiability",
        "goodness",
        "goodness of a response",
        "bootstrap",
        "static",
        "coverage",
    ],
)
def test_words_are_legible_in_a_column_of_a_journal_and_do_not_touch(draw):
    assert small_words(draw()) == ([], [], [])


@pytest.mark.parametrize("power", [1.0, 1e-6], ids=["fractions", "small"])
@pytest.mark.parametrize("draw", [plot.spectrum, plot.target, plot.fit])
def test_no_number_of_a_logarithmic_axis_has_a_small_exponent(draw, power):
    """Mathematics and raised digits are drawn at 0.7 of the letters or less: 4.3 points in a column
    of 85 mm."""
    if draw is plot.spectrum:
        figure = draw(
            Spectrum(F, power * 1e-3 / (1 + F**2) ** 2, SETTINGS, "N"), log=True, proportional=False
        ).figure
    elif draw is plot.target:
        figure = draw(Target("t", power + 1 / (1 + F**2), segments=12), log=True).figure
    else:
        figure = draw(result())
    figure.canvas.draw()
    numbers = []
    for axis in (
        axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis) if axis.get_scale() == "log"
    ):
        low, high = sorted(axis.get_view_interval())
        ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        numbers.append([tick.label1.get_text() for tick in ticks if low <= tick.get_loc() <= high])
    assert len(numbers) > 1 and all(len([n for n in own if n]) > 1 for own in numbers)
    for number in filter(None, (n for own in numbers for n in own)):
        assert float(number.replace("\N{MINUS SIGN}", "-")) > 0


def test_numbers_of_axes():
    values = (20.0, 0.0005, 5e-5, 2e6)
    assert [_plot_numbers.number_in_print(v) for v in values] == [
        "20",
        "0.0005",
        "5e\N{MINUS SIGN}5",
        "2e6",
    ]


def test_measurements_are_named_below_the_table_which_has_their_combinations():
    figure = plot.identifiability(identified())
    (table,) = figure.axes
    assert [tick.get_text() for tick in table.get_xticklabels()] == ["now", "A", "B", "C"]
    assert [text.get_text() for text in table.texts][:4] == ["3", "3", "4", "4"]
    assert table.get_yticklabels()[0].get_text() == "combinations (of 7)"
    said = "\n".join(text.get_text() for part in figure.subfigs for text in part.texts)
    assert "A  the mean force, known to 2 %" in said and "C  a second force level" in said


def test_a_report_of_many_measurements_fits_on_a_page():
    report = identified()
    report.designs, report.letter = report.designs * 9, lambda i: f"{i}"
    report.names = [f"{name}@{target}" for target in range(9) for name in report.names]
    for outlook in (report.present, *report.designs[:3]):
        known = outlook.quantities["K_w0"]
        outlook.quantities = dict.fromkeys(report.names, known)
    width, height = plot.identifiability(report).get_size_inches()
    assert 25.4 * width <= 180 and 25.4 * height <= 220


@pytest.mark.parametrize("style", ["default", "dark_background"])
def test_points_of_a_target_stand_out_and_its_band_does_not_on_a_white_and_on_a_dark_page(style):
    with plt.style.context(style):
        ax = plot.target(load_target("vastus-lateralis-26mvc"))
        colours = ax.get_facecolor(), ax.lines[0].get_color(), ax.collections[0].get_facecolor()[0]
        page, points, area = (np.array(to_rgb(colour)) for colour in colours)
        legend = np.array(to_rgb(ax.get_legend().get_frame().get_facecolor()))
    assert np.all(np.abs(points - page) == 1) and np.array_equal(legend, page)
    assert np.all((np.abs(area - page) > 0.1) & (np.abs(area - page) < 0.4))


# --- coverage


def share(ax, name, level):
    """The drawn share of simulations whose interval of that credibility holds the truth."""
    line = named(ax, name)
    return float(
        line.get_ydata()[np.searchsorted(line.get_xdata(), level + 1e-9, side="right") - 1]
    )


@pytest.mark.parametrize(
    ("scale", "name"), [(1.0, "right"), (0.5, "too narrow"), (2.0, "too wide")]
)
def test_the_coverage_of_normal_posteriors_is_that_of_their_closed_form(scale, name):
    """Errors N(0, 1) under posteriors of standard deviation `scale`: C(α) = 2 Φ(scale Φ⁻¹((1 +
    α)/2)) - 1."""
    count = 2000
    off = scipy.stats.norm.ppf((np.arange(count) + 0.5) / count)
    ax = plot.coverage({name: scipy.stats.norm.cdf(off / scale)})
    for level in (0.25, 0.5, 0.9):
        expected = 2 * scipy.stats.norm.cdf(scale * scipy.stats.norm.ppf((1 + level) / 2)) - 1
        # a step of the curve is 2 / count
        assert share(ax, name, level) == pytest.approx(expected, abs=3 / count)
    assert ax.get_xlim() == ax.get_ylim() == (0, 1) and ax.get_xlabel() and ax.get_ylabel()


def test_uniform_ranks_lie_on_the_diagonal_in_the_binomial_band():
    draws, times = 99, 2
    ax = plot.coverage({"k_w": np.repeat(np.arange(draws + 1), times)}, draws=draws)
    low, high = band_at(ax, 0.5)
    count = times * (draws + 1)
    assert (low, high) == tuple(scipy.stats.binom.ppf((0.025, 0.975), count, 0.5) / count)
    for level in np.linspace(0.1, 0.9, 9):
        assert share(ax, "k w", level) == pytest.approx(level, abs=1 / (draws + 1) + 1e-9)


def band_at(ax, level):
    points = ax.collections[0].get_paths()[0].vertices
    here = points[np.isclose(points[:, 0], level), 1]
    return here.min(), here.max()


def test_the_band_holds_calibrated_shares_as_often_as_it_says():
    rng = np.random.default_rng(6)
    ax = plot.coverage({"k_w": rng.uniform(size=100)}, level=0.9)
    low, high = band_at(ax, 0.3)
    inside = np.mean(
        [low <= np.mean(np.abs(2 * u - 1) <= 0.3) <= high for u in rng.uniform(size=(4000, 100))]
    )
    # Whole counts: at least 90 %, and at most the two counts at its ends more; 4 standard errors
    # of 4000.
    assert 0.9 - 4 * 0.005 < inside < 0.9 + 0.07


@pytest.mark.parametrize(
    ("ranks", "draws", "message"),
    [
        ({}, None, "ranks: is empty"),
        ({"k_w": [0, 11]}, 10, r"ranks\['k_w'\]: must lie between 0 and 10 \(of 10 draws"),
        ({"k_w": [3]}, None, "without draws= they are shares"),
        ({"k_w": [[0]]}, 1, r"has shape \(1, 1\)"),
    ],
)
def test_ranks_that_are_none_are_refused(ranks, draws, message):
    with pytest.raises(ValueError, match=message):
        plot.coverage(ranks, draws)
    with pytest.raises(ValueError, match=r"level = 95\.0"):
        plot.coverage({"k_w": [0.5]}, level=95.0)


def test_a_bootstrap_draws_the_coverage_of_its_own_intervals():
    quantities = refitted().quantities
    found = Bootstrap("mine", {}, dict(quantities), 50, {}, "simulated", 0)
    ax = found.plot_coverage()
    assert [line.get_label() for line in ax.lines[1:]] == [
        n.replace("_", " ") for n in quantities if "band" not in n
    ]
    near, known = quantities["corner_frequency"].inside
    assert share(ax, "corner frequency", 0.95) == near / known


# --- figures as files


@pytest.mark.usefixtures("as_fine_as_shipped")
def test_a_figure_is_written_in_the_formats_asked_for_the_same_each_time(tmp_path):
    def write(*formats):
        figure, ax = plt.subplots(figsize=(2, 1))
        ax.set_title("title")
        return write_figure(figure, tmp_path, "figure", *formats)

    assert write() == ["figure.png"] and matplotlib.image.imread(tmp_path / "figure.png").shape[
        :2
    ] == (300, 600)
    assert write(["pdf", "svg", "pdf"]) == ["figure.pdf", "figure.svg"]
    # that of before is gone
    assert {file.name for file in tmp_path.iterdir()} == {"figure.pdf", "figure.svg"}
    once = [(tmp_path / name).read_bytes() for name in ("figure.pdf", "figure.svg")]
    assert once[0].startswith(b"%PDF") and b"<svg" in once[1]
    with pytest.raises(ValueError, match=r"'jpg' is no format of a figure.*Known: png, pdf, svg"):
        write(["jpg"])
    write(["svg", "pdf"])
    assert [(tmp_path / name).read_bytes() for name in ("figure.pdf", "figure.svg")] == once


def test_pixels_that_are_drawn_already_are_not_drawn_again(tmp_path):
    figure, _ = plt.subplots(figsize=(2, 1))
    drawn = pixels_of(figure)
    write_figure(figure, tmp_path, "plain")
    assert (tmp_path / "plain.png").read_bytes() == drawn  # the same figure, whoever draws it
    assert write_figure(figure, tmp_path, "given", ["png", "svg"], pixels=b"given") == [
        "given.png",
        "given.svg",
    ]
    assert (tmp_path / "given.png").read_bytes() == b"given" and b"<svg" in (
        tmp_path / "given.svg"
    ).read_bytes()


# --- the drawing of the model


def written(ax):
    """The words in the axes by colour."""
    found = {}
    for text in ax.texts:
        found.setdefault(text.get_color(), []).append(text.get_text())
    return found


@pytest.mark.parametrize(
    ("task", "given", "output"),
    [
        (Isometric(), {"P_w", "x_z"}, "F_ext"),
        (PrescribedLength(), {"P_w", "x_z"}, "F_ext"),
        (PrescribedForce(), {"P_w", "F_ext"}, "x_z"),
        (PrescribedForce(observe="acceleration"), {"P_w", "F_ext"}, "x_z"),
        (PrescribedMotion(), {"x_z", "F_ext"}, "P_w"),
    ],
    ids=lambda x: "" if isinstance(x, set) else x if isinstance(x, str) else type(x).__name__,
)
def test_the_drawing_tells_what_a_task_prescribes_and_what_comes_out(task, given, output):
    symbols = {"P_w": r"$P_\mathrm{w}$", "F_ext": r"$F_\mathrm{ext}$", "x_z": r"$x_\mathrm{z}$"}
    words = written(plot.schematic(task))
    assert {name for name, symbol in symbols.items() if symbol in words[plot.BLUE]} == given
    assert [name for name, symbol in symbols.items() if symbol in words[plot.VERMILLION]] == [
        output
    ]
    held = isinstance(task, Isometric)
    # a motor, where the insertion moves
    assert ("M" in words[plot.BLUE]) == ("x_z" in given and not held)


def test_arrows_are_upon_what_fluctuates():
    def arrows(task):
        ax = plot.schematic(task)
        return sum(
            text.arrow_patch is not None
            and text.arrow_patch.get_edgecolor()[:3] == to_rgb(plot.ORANGE)
            for text in ax.texts
        )

    assert arrows(Isometric()) == 4 and arrows(Isometric().replace(noise_C_w=0.0)) == 3


def test_words_of_the_drawing_lie_in_a_column_of_a_journal_and_do_not_touch():
    figure = plot.schematic(Isometric()).figure
    assert figure.get_figwidth() * 25.4 == pytest.approx(85)
    # a symbol stands closer to its number than lines of a text
    assert small_words(figure, 0.6) == ([], [], [])
