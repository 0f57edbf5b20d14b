"""Which noise: the right one wins where colours differ, none where they do not, and every number
against another way."""

import contextlib
import csv
import dataclasses
import functools
import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.comparison import _compare, _evidence
from jaxmuscle.comparison._comparison import COLUMNS, Evidence, decide
from jaxmuscle.comparison._evidence import Candidate, Folds, effective_numbers, without_harmonic
from jaxmuscle.model._noises import with_noise
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._likelihood import log_density, log_likelihood, measured_bins
from jaxmuscle.objective._options import FitOptions

FREE = ("c_w", "noise_K_z", "harmonic_amplitude", "harmonic_frequency", "noise_correlation_time")
COLOURS = ("band-limited", "ornstein-uhlenbeck", "pink")
SEGMENTS = 45  # a minute of force
GROUPS = 3  # of bins that are left out together: a third of the fits that 10 take


def true_task(colour, **values):
    """A muscle whose own corner is far from that of the noise."""
    return with_noise(jm.Isometric(), colour).replace(noise_K_z=0.005, **values)


# as bundled targets have them, of which others make the programs
BOTH = jm.SpectrumSettings(filter_direction="both")


def target_of(task, seed=None, segments=SEGMENTS, quantity="force", settings=BOTH):
    """The expected spectrum, exact or scattering as Welch powers do, less where a line holds the
    share ρ: ν / (1 - ρ²)."""
    spectrum = jm.expected_spectrum(task, settings=settings)
    power = np.asarray(spectrum.power)
    if seed is not None:
        still = jm.expected_spectrum(task.replace(harmonic_amplitude=0.0), settings=settings)
        share = 1 - np.asarray(still.power) / power
        nu = spectrum.settings.degrees_of_freedom(segments) / (1 - share**2)
        power = power * np.random.default_rng(seed).chisquare(nu, power.size) / nu
    return jm.Target(
        "made", power, segments=segments, quantity=quantity, settings=spectrum.settings
    )


@contextlib.contextmanager
def few_starts():
    """Searches that begin at fewer points beside those at the target's own frequencies, and go on
    from fewer of them.

    The models here lie near the prior's centre. A search that ends too low would only make these
    tests fail.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name, few in {"SPREAD": 8, "RANDOM": 4, "PLAIN": 8, "KEPT": 6}.items():
            patch.setattr(_evidence, name, few)
        yield


def compare(task, target, **options):
    with few_starts():
        return jm.comparison.compare_noise(task, target, **options)


@functools.cache
def compared(colour, seed, harmonic, segments=SEGMENTS):
    task = true_task(colour, harmonic_amplitude=0.01 if harmonic else 0.0, harmonic_frequency=5.3)
    return compare(
        jm.Isometric(), target_of(task, seed, segments), noises=COLOURS, free=FREE, groups=GROUPS
    )


def row_of(found, noise, harmonic):
    return next(row for row in found.rows if (row.noise, row.harmonic) == (noise, harmonic))


# --- what it decides


@pytest.mark.slow
@pytest.mark.parametrize("colour", ["ornstein-uhlenbeck", "pink"])
def test_colours_that_differ_are_told_apart(colour):
    found = compared(colour, 1, True, segments=100 * SEGMENTS)
    assert found.success and found.best.noise == colour
    for other in COLOURS:
        if other != colour:
            assert found.between(colour, other).winner == colour
            assert found.between(other, colour).winner == colour
    assert found.harmonic.winner == "a harmonic"
    assert found.tasks[colour, True]["harmonic_frequency"] == pytest.approx(5.3, abs=0.1)
    assert any(
        f"the data prefer {colour} to band-limited" in sentence for sentence in found.verdict
    )


def test_a_noise_and_its_limit_are_not_told_apart():
    """Ornstein-Uhlenbeck noise of short correlation time is as flat in the band as band-limited
    noise."""
    found = compared("band-limited", 2, True, segments=100 * SEGMENTS)
    assert found.between("band-limited", "ornstein-uhlenbeck").winner is None
    assert found.between("band-limited", "pink").winner == "band-limited"
    assert found.tasks["ornstein-uhlenbeck", True]["noise_correlation_time"] < 0.02


@pytest.mark.slow
def test_a_tremor_is_told_from_a_line():
    """A broad tremor behind an activation; a harmonic is asked for only of the models that may have
    one."""
    task = jm.model.on_rung(jm.Isometric(), 2).replace(resonance_amplitude=0.1, noise_K_z=0.002)
    free = ("noise_K_z", "resonance_amplitude", "harmonic_amplitude", "harmonic_frequency")
    found = compare(
        jm.Isometric(),
        target_of(task, 1, 300, settings=None),
        noises=("band-limited", "resonance"),
        free=free,
        priors={"resonance_amplitude": 2.0, "harmonic_frequency": 0.3},
        groups=GROUPS,
    )
    assert [(row.noise, row.harmonic) for row in found.rows] == [
        ("band-limited", True),
        ("band-limited", False),
        ("resonance", False),
    ]
    assert found.between("resonance", "band-limited").winner == "resonance" == found.best.noise
    assert [row.adequate for row in found.rows] == [False, False, True]
    assert found.tasks["resonance", False]["resonance_amplitude"] == pytest.approx(0.1, rel=0.2)
    assert (
        "the data prefer resonance to band-limited" in found.verdict[0]
        and found.harmonic.b == "no harmonic"
    )


def test_no_harmonic_is_shown_where_there_is_none():
    assert compared("pink", 3, False).harmonic.winner is None


@pytest.mark.slow
def test_white_and_band_limited_noise_differ_only_above_the_band():
    task = with_noise(jm.PrescribedForce(), "white")
    target = target_of(task, seed=4, quantity="displacement", settings=None)
    options = {"noises": ("white", "band-limited"), "free": ("c_w", "noise_K_z"), "groups": GROUPS}
    found = compare(jm.PrescribedForce(), target, **options)
    assert found.left_out == {} and found.success
    decision = found.between("white", "band-limited")
    assert decision.winner is None and abs(decision.aic_gain) < 1
    assert any(
        "white and band-limited cannot be told apart" in s or "band-limited and white cannot" in s
        for s in found.verdict
    )


# --- its numbers


def test_likelihood_and_criterion_against_another_way(x64):
    """p by the numerical Hessian of the likelihood, which is the Fisher information where the model
    fits exactly."""
    target = target_of(true_task("band-limited", harmonic_amplitude=0.0), segments=4000)
    found = compare(
        jm.Isometric(), target, noises=("band-limited", "pink"), free=FREE, groups=GROUPS
    )
    row = row_of(found, "band-limited", False)
    fitted = found.tasks["band-limited", False]
    names, h = ("c_w", "noise_K_z"), 1e-3

    def at(*theta):
        moved = fitted.replace(
            **{n: float(fitted[n]) * np.exp(t) for n, t in zip(names, theta, strict=True)}
        )
        return float(log_likelihood(moved, target))

    assert row.log_likelihood == pytest.approx(at(0.0, 0.0), abs=1e-6)
    steps = h * np.eye(2)
    corners = [(a, b) for a in (1, -1) for b in (1, -1)]
    hessian = -np.array(
        [[sum(a * b * at(*(a * x + b * y)) for a, b in corners) for y in steps] for x in steps]
    ) / (4 * h**2)
    direct = np.trace(hessian @ np.linalg.inv(hessian + np.eye(2)))
    # The information takes the bins' covariance for that of normal logarithms: off by the order
    # 1/ν, here a thousandth.
    assert row.parameters == pytest.approx(direct, rel=5e-3)
    assert 1.0 < direct < 2.0
    assert row.aic == -2 * row.log_likelihood + 2 * row.parameters
    np.testing.assert_allclose(
        found.fitted["band-limited", False],
        jm.expected_spectrum(fitted, settings=BOTH).proportional[:30],
        rtol=1e-6,
    )


def test_effective_parameters_of_a_ridge_regression():
    """tr of the hat matrix of `y = X θ + constant` with prior precision Λ, the constant free."""
    rng = np.random.default_rng(0)
    X, prior = rng.normal(size=(2, 30, 4)), np.diag([1.0, 4.0, 0.0, 0.5])
    prior[0, 1] = prior[1, 0] = 0.7
    X[:, :, 3] *= 0.01
    wide = np.concatenate([X, np.ones((2, 30, 1))], axis=2)
    curvature = np.swapaxes(wide, 1, 2) @ wide
    curvature[:, :4, :4] += prior
    moving = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 0.0, 1.0, 0.0]])
    expected = []
    for x, moves in zip(X, moving, strict=True):
        centred, own = (x - x.mean(axis=0))[:, moves > 0], prior[np.ix_(moves > 0, moves > 0)]
        hat = centred @ np.linalg.inv(centred.T @ centred + own) @ centred.T
        expected.append(np.trace(hat))
    np.testing.assert_allclose(effective_numbers(curvature, prior, moving), expected, rtol=1e-10)
    without_offset = curvature.copy()
    without_offset[:, -1] = without_offset[:, :, -1] = 0.0
    hat = X[0] @ np.linalg.inv(X[0].T @ X[0] + prior) @ X[0].T
    np.testing.assert_allclose(
        effective_numbers(without_offset, prior, np.ones((2, 4)))[0], np.trace(hat), rtol=1e-10
    )


def test_a_bin_that_was_left_out_against_a_fit_by_scipy(x64):
    """Refitted without its group by Nelder and Mead on the likelihood that was integrated over the
    offset by quadrature."""
    found = compared("pink", 3, False)
    target, (k, names) = found.target, (0, ("c_w", "noise_K_z"))
    start = found.tasks["pink", False]
    kept = (np.arange(30) % GROUPS != k % GROUPS).astype(float)
    # 30 bins of 45 segments tell the offset to 0.03, seven steps.
    offsets, line = jnp.linspace(-0.7, 0.7, 351), jnp.zeros(30)
    density = jax.jit(
        lambda bins, power: jax.lax.map(
            lambda u: log_density(bins, power, line, u), offsets, batch_size=64
        )
    )

    def moments(task):
        return np.asarray(jm.expected_spectrum(task, settings=BOTH).power)

    def marginal(bins, power):
        heights = np.asarray(density(bins, power))
        top = np.argmax(heights)
        assert 100 < top < 250  # all of the density is within the offsets
        return (
            np.log(scipy.integrate.simpson(np.exp(heights - heights[top]), offsets)) + heights[top]
        )

    prior = with_noise(jm.Isometric(), "pink")

    def task_at(theta):
        return start.replace(
            **{n: float(prior[n]) * np.exp(t) for n, t in zip(names, theta, strict=True)}
        )

    bins = jax.tree.map(jnp.asarray, measured_bins(target, kept))

    def cost(theta):
        return -marginal(bins, moments(task_at(theta))) + 0.5 * np.sum(np.square(theta))

    begin = [np.log(float(start[n]) / float(prior[n])) for n in names]
    best = scipy.optimize.minimize(
        cost, begin, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4}
    )
    more = jax.tree.map(jnp.asarray, measured_bins(target, kept + np.eye(30)[k]))
    power = moments(task_at(best.x))
    score = row_of(found, "pink", False).scores[k]
    # Both stop within 1e-3 of the maximum: θ within √0.002 of a standard deviation, and so the
    # score within 0.05. The fit to all bins foretells this one better by 1.5.
    assert score == pytest.approx(marginal(more, power) - marginal(bins, power), abs=0.05)


def test_every_bin_is_left_out_once_and_put_back_alone():
    target = target_of(true_task("pink"))
    folds = Folds.of([target, target], GROUPS)
    assert folds.kept.mask.shape == (2, GROUPS, 30) and folds.more.mask.shape == (2, 30, 30)
    np.testing.assert_array_equal((1 - folds.kept.mask[0]).sum(axis=0), 1)
    added = folds.more.mask[1] - folds.kept.mask[1][folds.group]
    np.testing.assert_array_equal(added, np.eye(30))


def test_without_harmonic_its_power_is_zero(x64):
    target = target_of(true_task("band-limited"))
    problem = planned(
        true_task("band-limited"),
        target,
        FitOptions(free=("c_w", "harmonic_amplitude", "harmonic_frequency")),
    ).problem
    c = without_harmonic(problem).coordinates
    assert c.values(np.array([0.3, 2.0, -1.0]))["harmonic_amplitude"] == 0.0
    assert c.values(np.zeros(3))["c_w"] == 60.0
    fixed = planned(true_task("band-limited"), target, FitOptions(free=("c_w",))).problem
    assert float(without_harmonic(fixed).parts[0].task["harmonic_amplitude"]) == 0.0
    starts = Candidate.of(problem, harmonic=False).starts
    assert np.all(starts[:, 1:] == 0) and np.ptp(starts[:, 0]) > 0
    assert len(Candidate.of(problem, harmonic=True).starts) >= 32


def test_a_richer_model_is_also_sought_from_where_the_best_poorer_one_ended(x64):
    """From the prior's centre alone a muscle that rings at the tremor's frequency was missed by 100
    in AIC."""
    task, on = jm.Isometric(), functools.partial(jm.model.on_rung, jm.Isometric())
    ended = {
        ("band-limited", True): {"aic": 30.0, "task": task},
        # another noise than the tremor's
        ("pink", False): {"aic": -50.0, "task": with_noise(task, "pink")},
        ("activation", True): {"aic": 3.0, "task": on(1).replace(c_w=3.0, activation_time=0.2)},
        ("activation", False): {"aic": 4.0, "task": on(1)},
        ("two resonances", False): {"aic": 0.0, "task": on(3)},  # richer
    }
    known = _compare._poorer("resonance", task, ended)
    assert (
        known["c_w"] == 3.0
        and known["activation_time"] == 0.2
        and "resonance_frequency" not in known
    )
    assert (
        _compare._poorer("activation", task, ended)
        is None
        is _compare._poorer("resonance", task, {})
    )
    free = ("c_w", "activation_time", "resonance_amplitude", "resonance_frequency")
    problem = planned(on(2), target_of(on(2)), FitOptions(free=free)).problem
    plain = Candidate.of(problem, harmonic=False).starts
    starts = Candidate.of(problem, harmonic=False, known=known).starts
    np.testing.assert_array_equal(starts[: len(plain)], plain)
    values = problem.coordinates.values_of(starts[len(plain) :])
    from_there = np.isclose(values[:, 0], 3.0) & np.isclose(values[:, 1], 0.2)
    assert from_there.sum() >= len(plain) // 2 and not from_there.all()
    frequencies = values[from_there, 3]
    assert 6 < frequencies.min() < 8 and 10 < frequencies.max() < 14  # over the band of a tremor


# --- its words


SCORES = np.linspace(-1.0, 1.0, 30)


def made(*, disagree=False, sigma=False, success=True, p=0.2):
    """Three noises: pink better than band-limited by 8, than Ornstein-Uhlenbeck by 3."""
    target = target_of(true_task("pink"))
    found = {}
    for i, (noise, harmonic) in enumerate(itertools.product(COLOURS, (True, False))):
        aic = {"band-limited": 8.0, "ornstein-uhlenbeck": 3.0, "pink": 0.0}[noise] + 1.5 * (
            not harmonic
        )
        lift = (aic if disagree else -aic) / 30
        found[noise, harmonic] = {
            "log_likelihood": 100.0 - aic / 2,
            "parameters": 4.0,
            "aic": aic - 192.0,
            "scores": None if sigma else lift + 0.1 * np.roll(SCORES, i),
            "chi2_per_bin": 0.7,
            "adequacy_p": p if noise == "pink" or p is None else min(p, 0.005),
            "success": success,
        }
    rows = _compare._rows(found)
    tasks = {(row.noise, row.harmonic): true_task(row.noise) for row in rows}
    fitted = {model: target.proportional_power for model in tasks}
    return jm.comparison.Comparison(
        target, rows, {"white": "WhiteNoise on K_z cannot"}, tasks, fitted, 12.8, GROUPS, 0
    )


def test_differences_and_weights():
    found = made()
    flat, best = row_of(found, "band-limited", False), row_of(found, "pink", True)
    assert (
        found.best.noise == "pink"
        and found.best.harmonic
        and found.noises == ("pink", "ornstein-uhlenbeck", "band-limited")
    )
    delta = np.array([row.delta_aic for row in found.rows])
    np.testing.assert_allclose(delta, [8.0, 9.5, 3.0, 4.5, 0.0, 1.5])
    np.testing.assert_allclose(
        [row.weight for row in found.rows], np.exp(-delta / 2) / np.exp(-delta / 2).sum()
    )
    difference = flat.scores - best.scores
    assert flat.score_difference == pytest.approx(difference.sum())
    # The standard error of a sum of 30 is 30 times that of their mean.
    assert flat.score_stderr == pytest.approx(30 * scipy.stats.sem(difference))
    assert best.score_difference == 0.0 == best.score_stderr


@pytest.mark.parametrize("sigma", [False, True])
def test_the_table_as_a_frame(sigma):
    table = made(sigma=sigma).to_dataframe()
    assert list(table.columns) == list(COLUMNS) and list(table["noise"]) == [
        row.noise for row in made().rows
    ]
    assert table["score"].dtype == float and bool(table["score"].isna().all()) == sigma


UP, DOWN = np.full(5, 0.1), np.zeros(5)


@pytest.mark.parametrize(
    ("a", "b", "needed", "winner"),
    [
        ((0.0, UP), (6.0, DOWN), 6.0, "a"),
        ((6.0, DOWN), (0.0, UP), 6.0, "b"),
        ((0.0, UP), (5.99, DOWN), 6.0, None),
        ((0.0, DOWN), (6.0, UP), 6.0, None),
        ((0.0, UP), (6.0, DOWN), 12.8, None),
        ((0.0, None), (6.0, None), 6.0, "a"),
        ((np.nan, UP), (6.0, DOWN), 6.0, None),
        ((0.0, UP), (60.0, DOWN, False), 6.0, None),
    ],
)
def test_six_and_the_same_sign_are_needed(a, b, needed, winner):
    found = decide(("a", "b"), Evidence(*a), Evidence(*b), needed)
    assert found.winner == winner
    unsettled = "a and b are not compared: the search of b did not converge"
    assert (str(found) == unsettled) == (len(b) == 3)


def test_verdict_in_words():
    found = made()
    said = found.verdict
    assert said[0].startswith(
        "pink and ornstein-uhlenbeck cannot be told apart (for pink: AIC lower by 3.0, held-out"
        " score higher by 3.0"
    )
    assert said[1].startswith(
        "the data prefer pink to band-limited: AIC lower by 8.0, held-out score higher by 8.0"
    )
    assert said[2].startswith("a harmonic and no harmonic cannot be told apart") and said[
        2
    ].endswith(
        "the AIC must differ by 12.8 or more, since chance alone would find some frequency that"
        " fits a little better"
    )
    tremor = dataclasses.replace(found.best, noise="resonance", aic=-1e3, harmonic=False)
    richer = dataclasses.replace(found, rows=(*found.rows, tremor)).verdict
    assert richer[-1] == f"among the models without resonance, {said[2]}"
    split = (
        "AIC and held-out score disagree (for pink: AIC lower by 8.0, held-out score lower by 8.0"
    )
    assert split in made(disagree=True).verdict[1]
    alone = made(sigma=True)
    assert (
        alone.verdict[-1]
        == "the target states no segments: nothing was held out, the AIC decides alone"
    )
    assert alone.between("pink", "band-limited").winner == "pink"
    with pytest.raises(ValueError, match="noise = 'white': not compared"):
        alone.between("pink", "white")


def test_that_one_model_is_better_does_not_say_that_it_is_good():
    assert made().adequate == "these describe the data (p >= 0.01): pink; pink, no harmonic"
    assert made(p=0.001).adequate.startswith("none of the models describes the data")
    assert made(p=None).adequate.startswith("whether any model describes the data cannot be judged")
    assert made(p=0.001).adequate.split(":")[0] in " ".join(str(made(p=0.001)).split())
    assert [row["adequate"] for row in made().table()] == [False] * 4 + [True] * 2


@pytest.mark.parametrize("sigma", [False, True])
def test_tables_files_and_figure(sigma, tmp_path):
    found = made(sigma=sigma)
    assert all(
        len(line) <= 80 for line in str(found).splitlines()
    ) and "left out: white: WhiteNoise on K_z" in str(found)
    rows = found.table()
    assert list(rows[0]) == list(COLUMNS)
    found.save(tmp_path / "compare.json")
    table = json.loads((tmp_path / "compare.json").read_text())
    assert [row["aic"] for row in table["rows"]] == [row["aic"] for row in rows]
    assert table["verdict"] == list(found.verdict) and len(table["models"][0]["fitted"]) == 30
    assert [p.name for p in tmp_path.iterdir()] == ["compare.json"]
    figure = found.plot()
    try:
        # the verdict is what it prints
        assert [text.get_text() for text in figure.texts] == [found.target.name]
        assert "pink and ornstein-uhlenbeck cannot" in str(found) and "left out: white" in str(
            found
        )
        shown = [label.get_text() for label in figure.axes[1].get_yticklabels()]
        assert shown == [noise for noise in found.noises for _ in range(2)]
        dots = [line.get_xdata()[0] for line in figure.axes[1].lines if len(line.get_xdata()) == 1]
        np.testing.assert_allclose(dots, [0.0, 1.5, 3.0, 4.5, 8.0, 9.5])
    finally:
        plt.close(figure)


# --- what it refuses


def test_what_a_task_cannot_carry_is_left_out_with_its_own_reason():
    carried, left_out = _compare._carry(jm.Isometric(), ("white", *COLOURS), {})
    assert tuple(carried) == COLOURS
    with pytest.raises(ValueError) as own:
        with_noise(jm.Isometric(), "white")
    assert (
        left_out == {"white": str(own.value)}
        and "where white noise has no value" in left_out["white"]
    )
    carried, left_out = _compare._carry(
        jm.Isometric(), ("white", *COLOURS), {"noise_K_z": 0.0, "noise_C_z": 0.0}
    )
    assert tuple(carried) == ("white", *COLOURS) and left_out == {}
    carried, left_out = _compare._carry(
        jm.model.on_rung(jm.Isometric(), 1), ("band-limited", "pink", "resonance"), {}
    )
    assert (
        tuple(carried) == ("band-limited", "pink")
        and "has an activation or a resonance already" in left_out["resonance"]
    )
    mine = jm.Isometric(noise=jm.BandLimitedNoise(cutoff=20.0))
    assert float(_compare._carry(mine, COLOURS, {})[0]["band-limited"]["noise_cutoff"]) == 20.0


FORCE = "fdi-abduction-45mvc"
BAD = {
    "one": (
        jm.Isometric,
        {"noises": ("pink",)},
        "noises: at least two are needed for a comparison, 1 can be used",
    ),
    "left out": (
        jm.Isometric,
        {"noises": ("white", "pink")},
        r"1 can be used; white: WhiteNoise on K_z cannot be used",
    ),
    "rough": (
        jm.PrescribedMotion,
        {"noises": ("band-limited", "pink")},
        "pink: PinkNoise on K_z cannot be used in PrescribedMotion",
    ),
    "unknown": (jm.Isometric, {"noises": ("brown", "pink")}, "noises: 'brown'"),
    "free": (jm.Isometric, {"free": ("c_w", "k_x")}, "free: unknown parameter 'k_x'"),
    "fix": (jm.Isometric, {"fix": {"k_x": 1.0}}, "fix: unknown parameter 'k_x'"),
    "priors": (jm.Isometric, {"priors": {"k_x": 1.0}}, "priors: unknown parameter 'k_x'"),
    "groups": (
        jm.Isometric,
        {"groups": 31},
        "groups = 31: give a number from 2 to that of the target's bins, 30",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_arguments(case):
    task, options, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jm.comparison.compare_noise(task(), jm.load_target(FORCE), **options)


def test_a_target_has_to_say_how_much_it_scatters():
    target = jm.Target("mine", 1 / np.arange(1, 31))
    with pytest.raises(ValueError, match="mine: states neither segments nor sigma"):
        jm.comparison.compare_noise(jm.Isometric(), target)


def test_with_a_sigma_alone_nothing_is_held_out():
    exact = target_of(true_task("ornstein-uhlenbeck", harmonic_amplitude=0.0))
    target = jm.Target(
        "mine", exact.proportional_power, sigma=0.1 * exact.proportional_power, settings=BOTH
    )
    found = compare(jm.Isometric(), target, noises=("ornstein-uhlenbeck", "pink"), free=FREE)
    assert all(row.score is None for row in found.rows) and found.verdict[-1].endswith(
        "the AIC decides alone"
    )
    assert found.between("ornstein-uhlenbeck", "pink").winner == "ornstein-uhlenbeck"
    plt.close(found.plot())


# --- the command


def command(*arguments):
    result = CliRunner().invoke(app, ["compare", *map(str, arguments)], env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    return result


@pytest.mark.parametrize("success", [True, False])
def test_the_command_writes_its_files(success, tmp_path, monkeypatch):
    asked = {}

    def compare_noise(task, target, **options):
        asked.update(options, task=task, target=target)
        return made(success=success)

    monkeypatch.setattr(jm.comparison, "compare_noise", compare_noise)
    asking = [
        "--free",
        "c_w, noise_K_z",
        "--fix",
        "k_w=4e5",
        "--seed",
        3,
        "--segments",
        9,
        "--out",
        tmp_path,
    ]
    result = command(FORCE, *asking)
    assert result.exit_code == (0 if success else 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "compare.csv",
        "compare.json",
        "compare.png",
    ]
    rows = list(csv.DictReader((tmp_path / "compare.csv").read_text().splitlines()))
    assert list(rows[0]) == list(COLUMNS) and [float(row["aic"]) for row in rows] == [
        row["aic"] for row in made().table()
    ]
    said = "cannot be told apart" if success else "are not compared: the search of"
    assert (
        f"pink and ornstein-uhlenbeck {said}" in result.stdout
        and "left out: white" in result.stdout
    )
    assert isinstance(asked["task"], jm.Isometric) and asked["target"].segments == (9,)
    assert (asked["free"], asked["fix"], asked["key"]) == (["c_w", "noise_K_z"], {"k_w": 4e5}, 3)
    as_json = command(FORCE, *asking, "--json", "--force")
    assert as_json.exit_code == result.exit_code
    assert json.loads(as_json.stdout) == json.loads((tmp_path / "compare.json").read_text())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nobody"], "nobody"),
        ([FORCE, "--fix", "k_w"], "--fix 'k_w': write NAME=VALUE"),
        ([FORCE, "--free", "k_x"], "free: unknown parameter 'k_x'"),
    ],
)
def test_a_users_mistake_is_one_line(arguments, message, tmp_path):
    result = command(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2 and message in result.stderr and "Traceback" not in result.output


# --- how often it is wrong


@pytest.mark.slow
def test_a_recording_of_each_colour_in_the_calibration(monkeypatch):
    """The program of benchmarks/colours.py, whose 900 recordings docs/noise-colour.md counts, on
    three of 60 s."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import colours

    monkeypatch.setattr(colours, "GROUPS", GROUPS)
    monkeypatch.setattr(
        colours, "with_noise", lambda task, colour: with_noise(type(task)(settings=BOTH), colour)
    )
    found = {}
    with jax.enable_x64(True), few_starts():
        batch = [colours.recorded(colour, 0, 60.0, harmonic=True) for colour in COLOURS]
        by_colour = {c: colours.examined(batch, c, muscle_free=False) for c in COLOURS}
    for i, colour in enumerate(COLOURS):
        found[f"{colour}|0|True|muscle fixed"] = {c: by_colour[c][i] for c in COLOURS}
    rows = [
        row
        for row in colours.verdicts({"found": found})
        if sum(row[k] for k in ("right", "wrong", "open"))
    ]
    assert sum(row["right"] + row["wrong"] + row["open"] for row in rows) == 6
    # 5 % of the verdicts may be wrong: of six, three or more have a chance of 0.2 %.
    assert sum(row["wrong"] for row in rows) <= 2
    assert all(
        one["settled"] for each in by_colour.values() for model in each for one in model.values()
    )
