"""Several trials of one condition: one target, its law, its dispersion, its mean; and what a fit
takes as its data."""

import inspect

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from entropies import without_entropies
from recorded import save_columns
from refits import without_intervals

import jaxmuscle as jm
from jaxmuscle._common.errors import TargetError
from jaxmuscle.data import as_target
from jaxmuscle.objective._problem import target_variation
from jaxmuscle.spectra._bin_law import bin_statistics, mean_error

RATE, SECONDS, LEVEL = 200, 15.0, 40.5


@pytest.fixture(scope="module", autouse=True)
def _leave_out_entropies():
    with without_entropies():
        yield


def signal(rng, sd=0.8, corner=3.0, seconds=SECONDS):
    """A held force with coloured noise."""
    n = round(seconds * RATE)
    x = scipy.signal.lfilter(*scipy.signal.butter(1, corner, fs=RATE), rng.normal(size=n + 400))[
        400:
    ]
    return LEVEL + sd * x / np.std(x)


def trials(rng, count=5, spread=0.0, drift=0.0):
    """Of a person whose force varies more in one trial than in another (`spread`), or changes its
    spectrum (`drift`)."""
    made = [
        signal(rng, 0.8 * np.exp(spread * rng.normal()), 3.0 * np.exp(drift * rng.normal()))
        for _ in range(count)
    ]
    return jm.data.Trials([jm.Recording(x, RATE, name=f"anna_{i}") for i, x in enumerate(made)])


def test_absolute_spectra_are_averaged_with_their_segments():
    """Against Welch's method by scipy on each trial, weighted with the segments that one counts by
    hand."""
    rng = np.random.default_rng(0)
    both = jm.data.Trials(
        [
            jm.Recording(signal(rng, sd, seconds=s), RATE, name=f"t{s:g}")
            for sd, s in ((1.0, 10.0), (2.0, 20.0))
        ]
    )
    target = both.target()
    rows, low = [], scipy.signal.butter(9, 30, fs=100, output="sos")
    for recording in both:
        even = scipy.signal.sosfiltfilt(
            low, scipy.signal.resample_poly(recording.samples, 1, 2, padtype="line")
        )
        rows.append(scipy.signal.welch(even, 100, nperseg=256)[1][1:31])
    assert target.segments == (1 + (1000 - 256) // 128, 1 + (2000 - 256) // 128)
    mean = np.average(rows, axis=0, weights=target.segments)
    np.testing.assert_allclose(target.trial_power, rows, rtol=1e-10)
    np.testing.assert_allclose(target.proportional_power, mean / mean.sum(), rtol=1e-10)
    assert target.coefficient_of_variation == pytest.approx(
        [np.std(r.filtered()) / np.mean(r.filtered()) for r in both]
    )
    assert (
        target.mean == pytest.approx([np.mean(r.filtered()) for r in both]) and target.unit == "N"
    )


def test_what_several_trials_say_is_said_once():
    """The steady parts in one notice; else with the names of those that say it, unless all do."""
    rng, rise = np.random.default_rng(7), LEVEL * np.linspace(0, 1, RATE)
    rest = 0.05 * rng.normal(size=2 * RATE)
    held = [
        np.concatenate([rest, rise, signal(rng, seconds=s), rise[::-1]]) for s in (10.0, 12.0, 14.0)
    ]
    said = [("taken as N", "cut off"), ("taken as N",), ("taken as N", "cut off")]
    found = jm.data.Trials(
        jm.Recording(x, RATE, name=f"t{i}", notices=own)
        for i, (x, own) in enumerate(zip(held, said, strict=True))
    ).steady()
    windows = ", ".join(f"{a:.2f} s to {b:.2f} s in {r.name}" for r in found for a, b in [r.window])
    assert found.target().notices[:3] == (
        "taken as N",
        "t0, t2: cut off",
        f"steady part found automatically: {windows}",
    )
    alone = found[0].target().notices
    assert alone[-1].startswith("steady part found automatically: ") and alone[-1].endswith(" s")


def scatter(made):
    """How often the squared deviations of many averages' shapes are what the law says, of their log
    powers."""
    logs = np.log([target.proportional_power for target in made])
    z = logs - logs.mean(axis=0)
    z -= z.mean(axis=1, keepdims=True)
    law = bin_statistics(
        jm.Target(
            "x", made[0].proportional_power, segments=made[0].segments, settings=made[0].settings
        )
    )
    centre = np.eye(len(law.sd)) - 1 / len(law.sd)
    expected = np.trace(centre @ law.covariance @ centre / law.sd[:, None] / law.sd)
    return np.sum((z / law.sd) ** 2) / (len(made) - 1) / expected


@pytest.mark.parametrize(("spread", "drift"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5)])
def test_dispersion_is_how_much_more_the_averages_scatter(spread, drift):
    """Of 60 people with five trials: the dispersion that each states against the scatter of the 60
    averages.

    That ratio is a chi² over about 20 independent bins by 59, so good to √(2/1180) = 4 %, and half
    as much again since bins hold unequal power; the stated squares have a mean good to 3 % (30 %
    with unequal trials, over √60 and correlated).
    """
    rng = np.random.default_rng(1)
    made = [trials(rng, spread=spread, drift=drift).target() for _ in range(60)]
    stated = np.array([target.dispersion for target in made])
    assert np.mean(stated[:, 0] ** 2) == pytest.approx(
        scatter(made), rel=4 * np.hypot(0.06, 0.04 + 0.04 * (spread + drift > 0))
    )
    # And its standard error is that of the stated values, to the quarter that 60 of them and a law
    # by hand allow.
    assert np.mean(stated[:, 1]) == pytest.approx(np.std(stated[:, 0]), rel=0.5)


def test_steady_trials_have_dispersion_one_and_drifting_ones_more():
    rng = np.random.default_rng(2)
    value, error = trials(rng, 8).target().dispersion
    assert abs(value - 1) < 4 * error
    people = [trials(rng, 8, drift=1.0).target() for _ in range(3)]
    assert all(
        target.dispersion[0] > 1.25 and "all errors are widened" in target.notices[-1]
        for target in people
    )
    # The one law of the bins knows it, and with it every error.
    plain = jm.Target(
        "x", people[0].proportional_power, segments=people[0].segments, settings=people[0].settings
    )
    ratio = bin_statistics(people[0]).sd / bin_statistics(plain).sd
    np.testing.assert_allclose(ratio, people[0].dispersion[0], rtol=0.02)


def test_a_dispersion_below_one_narrows_nothing():
    p, segments = np.ones(30), [10, 10]
    plain, less = (
        bin_statistics(jm.Target("x", p, segments=segments, dispersion=d)).sd for d in (None, 0.8)
    )
    np.testing.assert_array_equal(plain, less)


def test_saved_and_read_back_equal(tmp_path):
    target = trials(np.random.default_rng(3)).target("anna", mvc=400.0)
    target.save(tmp_path / "anna.toml")
    again = jm.load_target(tmp_path / "anna.toml")
    assert again.to_table() == target.to_table() and again.dispersion == target.dispersion
    np.testing.assert_array_equal(again.trial_power, target.trial_power)
    assert again.mvc_fraction == pytest.approx(np.mean(target.mean) / 400)
    assert "5 trials" in str(again) or "10 + 10 + 10 + 10 + 10" in str(again)


def test_mean_force_and_its_error():
    """Against the scatter of the means of 200 trials of a first-order process, whose means scatter
    as `√(S(0) / 2T)`."""
    rng = np.random.default_rng(4)
    made = [trials(rng, 1).target() for _ in range(200)]
    means = np.array([target.mean_force[0] for target in made])
    stated = np.array([target.mean_force[1] for target in made])
    assert abs(means.mean() - LEVEL) < 4 * means.std() / np.sqrt(200)
    # The lowest bin, at 0.39 Hz, lies on the plateau of the spectrum; 0.2 % of the mean is the
    # least that is stated.
    assert np.all(stated >= 0.002 * means * 0.999)
    density = [
        t.coefficient_of_variation[0] ** 2 * t.proportional_power[0] / t.settings.resolution
        for t in made
    ]
    predicted = LEVEL * np.sqrt(np.mean(density) / (2 * SECONDS))
    # the sum over bins leaves out bin 0
    assert predicted == pytest.approx(means.std(), rel=4 / np.sqrt(2 * 200) + 0.1)
    several = trials(rng, 4).target()
    assert several.mean_force[1] >= np.std(several.mean, ddof=1) / 2 * 0.999


def test_the_error_of_one_mean_is_that_of_noise_with_its_lowest_bin():
    """The mean of n samples of white noise of variance σ² scatters as σ / √n. Its one-sided density
    is 2 σ² / rate."""
    one = jm.Target(
        "x", np.ones(30), segments=(6,), coefficient_of_variation=(0.3,), mean=(20.0,), unit="N"
    )
    # Six segments of 256, half overlapping, take 896 samples; with up to 127 more there is no
    # seventh. In the middle:
    rate, samples = one.settings.rate, 256 + 5 * 128 + 64
    # the variance, spread evenly over thirty bins
    density = (0.3 * 20.0) ** 2 / 30 / one.settings.resolution
    force, error = one.mean_force
    assert force == 20.0 and error == pytest.approx(
        np.sqrt(density * rate / 2 / samples), rel=1e-12
    )
    two = jm.Target(
        "x",
        np.ones(30),
        segments=(6, 6),
        coefficient_of_variation=(0.3, 0.3),
        mean=(20.0, 20.0),
        unit="N",
    )
    assert two.mean_force[1] == pytest.approx(error / np.sqrt(2), rel=1e-12)  # twice the time


@pytest.mark.parametrize("lacking", ["segments", "coefficient_of_variation"])
def test_the_error_of_a_mean_without_what_it_follows_from_is_two_per_cent(lacking):
    given = {"segments": (6,), "coefficient_of_variation": (0.1,)}
    (_, whole), (force, error) = (
        jm.Target("x", np.ones(30), mean=(20.0,), unit="N", **each).mean_force
        for each in (given, {name: value for name, value in given.items() if name != lacking})
    )
    assert (force, error) == (20.0, pytest.approx(0.4)) and whole != pytest.approx(0.4, rel=0.1)


@pytest.mark.parametrize("count", [3, 5, 10])
def test_the_error_by_the_scatter_of_trials_has_students_t(count):
    """± 1.96 of it hold the mean in 95 %. It counts where it is larger than what is expected."""
    draws = np.random.default_rng(count).standard_normal((4000, count))
    errors = np.array([mean_error(each, 0.0) for each in draws])
    held = np.sum(np.abs(draws.mean(axis=1)) < 1.96 * errors)
    assert scipy.stats.binomtest(int(held), 4000, 0.95).pvalue > 1e-3
    t = scipy.stats.t.ppf(0.975, count - 1) / 1.96
    sem = scipy.stats.sem(draws[0])
    assert (
        mean_error(draws[0], 0.99 * sem) == pytest.approx(t * sem, rel=1e-6)
        and mean_error(draws[0], 1.01 * sem) == 1.01 * sem
    )
    traced = jax.jit(lambda expected: mean_error(draws[0], expected))
    assert float(traced(0.0)) == pytest.approx(t * sem, rel=1e-5) and float(traced(9.0)) == 9.0


def test_one_trial_has_no_scatter_and_two_have_it_without_t():
    two = np.array([1.0, 2.0])
    assert mean_error(two[:1], 0.3) == 0.3 and mean_error(two, 0.3) == pytest.approx(0.5)


def test_trials_that_differ_widen_the_error_of_their_variation():
    alike, unlike = (
        0.02 * np.exp(spread * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])) for spread in (1e-3, 0.5)
    )
    made = [
        jm.Target("x", np.ones(30), segments=[10] * 5, coefficient_of_variation=v.tolist())
        for v in (alike, unlike)
    ]
    (_, expected), (_, wide) = map(target_variation, made)
    t = scipy.stats.t.ppf(0.975, 4) / 1.96
    assert scipy.stats.sem(np.log(alike)) < expected < scipy.stats.sem(np.log(unlike))
    assert wide == pytest.approx(t * scipy.stats.sem(np.log(unlike)), rel=1e-6)


# A kilogram-force is 9.80665 N, a pound-force 4.4482216152605 N, both exactly.
@pytest.mark.parametrize(
    ("unit", "newtons"),
    [
        ("kN", 1000),
        ("kgf", 9.80665),
        ("gf", 9.80665e-3),
        ("lbf", 4.4482216152605),
        ("% MVC", None),
        ("N m", None),
        ("mm", None),
    ],
)
def test_only_newtons_are_newtons(unit, newtons):
    x = 0.8 * signal(np.random.default_rng(5))
    target = jm.Recording(x, RATE, unit=unit).target()
    assert (target.mean_force is not None) == (newtons is not None) and target.unit == unit
    if newtons is not None:
        assert target.mean_force[0] == pytest.approx(newtons * np.mean(x), rel=1e-3)
    assert (target.mean is None) == (unit == "mm")


def test_different_units_are_refused():
    x = signal(np.random.default_rng(6))
    with pytest.raises(
        ValueError, match=r"units N and mN cannot be averaged; bring all trials to one unit"
    ):
        jm.data.Trials([jm.Recording(x, RATE), jm.Recording(x, RATE, unit="mN")])
    with pytest.raises(ValueError, match="give at least one"):
        jm.data.Trials([])


BAD = {
    "no segments": ({"segments": None}, "no segments are stated"),
    "one row": ({"trial_power": [[1.0] * 30]}, r"shape \(1, 30\); give .*segments names 2 trials"),
    "negative": ({"trial_power": [[1.0] * 30, [-1.0] * 30]}, "must be finite and larger than 0"),
    "other spectrum": (
        {"trial_power": [[1.0] * 30, [*[1.0] * 29, 2.0]]},
        "is not proportional_power",
    ),
    "mean of zero": ({"mean": 0.0}, "mean 0.0: give a finite number above 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_trials_are_refused(case):
    fields, message = BAD[case]
    with pytest.raises(TargetError, match=message):
        jm.Target(
            "x", np.ones(30), **({"segments": [6, 6], "trial_power": np.ones((2, 30))} | fields)
        )


def write(path, x, header="time,force"):
    return save_columns(path, header, np.arange(len(x)) / RATE, x, fmt="%.6g")


def test_files_of_trials(tmp_path):
    rng = np.random.default_rng(7)
    paths = [write(tmp_path / f"anna_{i}.csv", signal(rng)) for i in range(3)]
    read = jm.load_recordings(paths)
    assert (
        len(read) == 3 and read.name == "anna" and read[1].name == "anna_1" and len(read[:2]) == 2
    )
    samples = [recording.whole for recording in read]
    time = np.arange(len(samples[0])) / RATE
    path = save_columns(tmp_path / "all.csv", "time,one,two,three", time, *samples, fmt="%.6g")
    columns = jm.load_recordings(path)
    assert len(columns) == 3 and len(jm.load_recordings(path, columns=["one", "three"])) == 2
    np.testing.assert_allclose(
        columns.target().proportional_power, read.target().proportional_power, rtol=1e-4
    )
    with pytest.raises(ValueError, match="one file that holds all trials"):
        jm.load_recordings(paths, columns=["force"])


def test_whatever_is_data_becomes_a_target(tmp_path):
    rng = np.random.default_rng(8)
    paths = [write(tmp_path / f"t{i}.csv", signal(rng)) for i in range(2)]
    recordings = [jm.load_recording(path).steady() for path in paths]
    wanted = jm.data.Trials(recordings).target()
    for given in (
        wanted,
        jm.data.Trials(recordings),
        recordings,
        tuple(recordings),
        paths,
        [str(path) for path in paths],
    ):
        np.testing.assert_array_equal(
            as_target(given).proportional_power, wanted.proportional_power
        )
    one = as_target(recordings[0])
    np.testing.assert_array_equal(as_target(paths[0]).proportional_power, one.proportional_power)
    assert as_target("fdi-abduction-45mvc").name == "fdi-abduction-45mvc"


def test_a_recording_read_as_a_spectrum_says_so(tmp_path):
    path = write(tmp_path / "x.csv", signal(np.random.default_rng(9)))
    with pytest.raises(
        TargetError, match=r"columns are time, force; .* Is this a recording\? .*analyse"
    ):
        jm.load_target(path)


WRONG = {
    "array": (
        np.ones(100),
        r"shape \(100,\) .* give jaxmuscle.Recording\(samples, rate\)\. Powers",
    ),
    "number": (3, "this is of type int; give a Target"),
    "targets": (
        ["fdi-abduction-45mvc", "vastus-lateralis-26mvc"],
        "several people are fitted by fit_cohort",
    ),
    "none": ([], "give a Target"),
}


@pytest.mark.parametrize("case", WRONG)
def test_other_data_are_refused_with_the_remedy(case):
    given, message = WRONG[case]
    with pytest.raises(TargetError, match=message):
        jm.fit(jm.Isometric(), given)


def test_task_and_target_the_wrong_way_round():
    with pytest.raises(ValueError, match=r"give a task first, as jaxmuscle.Isometric\(\)"):
        # without the tests' type check
        inspect.unwrap(jm.fit)(jm.load_target("fdi-abduction-45mvc"), jm.Isometric())


def test_drawn_with_its_trials():
    ax = trials(np.random.default_rng(10), 3).target().plot()
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert "3 trials" in labels and len(ax.lines) == 4
    # the mean comes first: the figure of a fit calls that line the target
    assert ax.lines[0].get_marker() == "o"
    plt.close(ax.figure)


def people(task, seeds, key):
    """Trials of 15 s of the nonlinear model."""
    runs = jm.ensemble(
        task.settled(), jax.random.key(key), seeds=seeds, duration=20.0, dt=2.5e-3, control=False
    )
    return [
        jm.Recording(x, runs.rate, window=(5.0, 20.0), name=f"trial{i}")
        for i, x in enumerate(np.asarray(runs.output))
    ]


@pytest.fixture(scope="module")
def strong():
    task = jm.Isometric().at_force(40.5)
    found = people(task, 5, 11)
    with without_intervals():
        return found, jm.fit(jm.Isometric(), found, rungs=0, seeds=0, check_seeds=0, starts=8)


def test_a_fit_has_the_measured_mean(strong):
    """The mean of a fit is the recordings' within its error, P_w follows, and everything else is as
    without newtons."""
    found, result = strong
    measured = np.mean([np.mean(r.samples) for r in found])
    mean, error = result["model_mean"].value, result["model_mean"].stderr
    assert abs(mean - measured) < 2 * error < 0.05 * measured
    assert (
        "P_w" in result.free and result.settings["mean_force"] is not None and not result.per_newton
    )
    assert result.task["m_w"] > 5 * jm.Isometric()["m_w"]
    target = jm.data.Trials(found).target()
    assert result.settings["carried"] == pytest.approx(result.task["m_w"] / jm.Isometric()["m_w"])
    said = " ".join(result.details().split())
    assert "the muscle has the measured mean force" in said
    assert (
        f"The masses are the usual 0.5 kg times {result.settings['carried']:.3g}. They are no"
        " measurements" in said
    )
    with without_intervals():
        without = jm.fit(
            jm.Isometric(), target, rungs=0, seeds=0, check_seeds=0, starts=8, mean_force=False
        )
    assert without.per_newton and "P_w" not in without.free
    # Another scale of force is the same spectrum: P_w is one more freedom, which a mean takes away
    # again.
    assert result.chi2_per_bin == pytest.approx(without.chi2_per_bin, rel=0.05)
    for name in ("model_coefficient_of_variation", "half_power_frequency"):
        assert result.derived[name].value == pytest.approx(without.derived[name].value, rel=0.05)


def test_a_fit_of_recordings_keeps_what_was_measured(strong, tmp_path):
    found, result = strong
    wanted = {name: m.row() for name, m in jm.data.steadiness(found).measures.items()}
    result.save(tmp_path / "fit.json")
    for kept in (result, jm.load_result(tmp_path / "fit.json")):
        np.testing.assert_equal({name: m.row() for name, m in kept.measured.items()}, wanted)
        assert kept["mean"] == kept.measured["mean"] != kept["model_mean"]
        time, force = kept.recorded
        np.testing.assert_array_equal(force, found[0].filtered()[:500])
        np.testing.assert_allclose(time, np.arange(500) / 100)


def test_profile_and_reopening_keep_the_mean(strong):
    _, result = strong
    found, mean = jm.profile(result, "model_mean"), result["model_mean"]
    ((low, high),) = found.intervals
    assert low < mean.value < high
    assert (high - low) / 2 == pytest.approx(1.96 * mean.stderr, rel=0.2)


def test_a_joint_fit_at_two_forces():
    """One muscle at two drives: stiffness is shared, every P_w follows its own mean."""
    weak = jm.Isometric().at_force(20.0)
    found = {
        "weak": people(weak, 3, 12),
        "strong": people(weak.replace(P_w=1.5 * weak["P_w"]), 3, 13),
    }
    with without_intervals():
        result = jm.fit(None, found, starts=8, seeds=0)
    assert {"P_w@weak", "P_w@strong"} <= set(result.free) and "k_w" in result.free
    for name, recordings in found.items():
        measured = np.mean([np.mean(r.samples) for r in recordings])
        mean = result[f"model_mean@{name}"]
        assert abs(mean.value - measured) < 2 * mean.stderr < 0.05 * measured
    assert result["P_w@strong"].value > result["P_w@weak"].value


def test_what_does_not_say_how_data_are_read_is_refused():
    target = jm.load_target("fdi-abduction-45mvc")
    for given, option, what in (
        (target, {"segments": 3}, "a target"),
        ("fdi-abduction-45mvc", {"lever_arm": 0.1}, "a spectrum"),
    ):
        with pytest.raises(
            ValueError, match=f"{next(iter(option))} = .*does not belong to {what}; leave it out"
        ):
            as_target(given, **option)
