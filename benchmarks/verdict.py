"""How often the verdict of a fit, its intervals and the harmonic's p-value are right, on simulated
recordings.

    python benchmarks/verdict.py null|power|coverage|harmonic [--count N]

Takes ten minutes to an hour each; the outcome stands in docs/fitting.md.
"""

import argparse
import warnings
from collections.abc import Callable

import jax
import numpy as np
import scipy.signal
import scipy.stats

import jaxmuscle as jm
from jaxmuscle.fits._model_choice import harmonic_test
from jaxmuscle.fits._search import _together
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._starts import starting_points
from jaxmuscle.response._second_order import negative_coefficients, second_order
from jaxmuscle.spectra._measures import coefficient_of_variation

TASK = jm.Isometric()
SETTINGS = TASK.settings
LEAD = 10.0
STARTS = 32


def recordings(
    task: jm.Isometric, segments: int, count: int, key: int
) -> tuple[np.ndarray, tuple[float, float]]:
    """Forces of the settled nonlinear model at 100 Hz, and the window with so many segments."""
    window = (LEAD, LEAD + (SETTINGS.length + (segments - 1) * SETTINGS.step) / SETTINGS.rate)
    runs = jm.ensemble(
        task.settled(), jax.random.key(key), seeds=count, duration=window[1], control=False
    )
    return np.asarray(runs.output), window


def targets(
    force: np.ndarray, window: tuple[float, float], segments: int, trials: int = 1
) -> list[jm.Target]:
    """Their spectra, with the coefficient of variation; so many recordings in a row are the trials
    of one target."""
    low = scipy.signal.sosfilt(SETTINGS.sections, force)[
        :, round(window[0] * SETTINGS.rate) : round(window[1] * SETTINGS.rate)
    ]
    power = np.asarray(jm.spectra.spectrum_of(force, SETTINGS, window).power)
    power = power.reshape(-1, trials, power.shape[1]).mean(axis=1)
    variation = np.asarray(coefficient_of_variation(low)).reshape(-1, trials)
    return [
        jm.Target(
            f"recording {i}",
            p,
            segments=[segments] * trials,
            settings=SETTINGS,
            coefficient_of_variation=tuple(map(float, v)),
        )
        for i, (p, v) in enumerate(zip(power, variation, strict=True))
    ]


def null(count: int) -> None:
    """p-values of the verdict about fits of the model's own recordings: uniform."""
    for segments in (3, 12, 60):
        with jax.enable_x64(True):
            made = targets(*recordings(TASK, segments, count, segments), segments)
        found = jm.fit_cohort(made, starts=STARTS)
        p = np.array([result.adequacy_p for result in found.results.values()])
        test = scipy.stats.kstest(p, "uniform")
        shares = ", ".join(
            f"{np.mean(p < level):.3f} below {level}" for level in (0.01, 0.05, 0.5, 0.95)
        )
        print(
            f"{segments} segments, {count} fits: {shares}; Kolmogorov-Smirnov {test.statistic:.3f},"
            f" p {test.pvalue:.2g}",
            flush=True,
        )


def tremor(force: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """A band at 9 Hz, 2 Hz wide, that holds a share of the variance."""
    band = scipy.signal.butter(2, (8.0, 10.0), "bandpass", fs=SETTINGS.rate, output="sos")
    added = scipy.signal.sosfilt(band, rng.standard_normal(force.shape))
    return (
        force + added * np.sqrt(share / (1 - share)) * force[:, 1000:].std() / added[:, 1000:].std()
    )


def drift(force: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """A slow wander, a random walk smoothed over 2 s, whose standard deviation is a multiple of the
    force's."""
    walk = np.cumsum(rng.standard_normal(force.shape), axis=1)
    walk = scipy.ndimage.uniform_filter1d(walk, 200, axis=1)
    return force + share * (walk - walk.mean(axis=1, keepdims=True)) * force[
        :, 1000:
    ].std() / walk.std(axis=1, keepdims=True)


def power(count: int) -> None:
    """How often recordings are called adequate: of the model, with a band of tremor, with drift."""
    rng = np.random.default_rng(0)
    kinds: dict[str, Callable[[np.ndarray], np.ndarray]] = {"the model's own": lambda force: force}
    kinds |= {
        f"tremor of {100 * s:g} % of the variance": lambda force, s=s: tremor(force, s, rng)
        for s in (0.01, 0.03, 0.1)
    }
    kinds |= {
        f"drift of {s:g} standard deviations": lambda force, s=s: drift(force, s, rng)
        for s in (1.0, 3.0)
    }
    for segments in (12, 45):
        with jax.enable_x64(True):
            force, window = recordings(TASK, segments, count, 100 + segments)
        for name, change in kinds.items():
            with jax.enable_x64(True):
                made = targets(change(force), window, segments)
            found = jm.fit_cohort(made, starts=STARTS)
            called = np.mean([bool(result.adequate) for result in found.results.values()])
            chi2 = np.median(
                [float(result.chi2_per_bin or np.nan) for result in found.results.values()]
            )
            print(
                f"{segments} segments, {name}: {100 * called:.1f} % called adequate, median chi2"
                f" per bin {chi2:.2f}",
                flush=True,
            )


def coverage(count: int) -> None:
    """How often stated intervals hold the truth, for muscles drawn from the prior."""
    for segments in (12, 45):
        rng = np.random.default_rng(segments)
        example = jm.Target(
            "x", np.ones(30), segments=[segments], settings=SETTINGS, coefficient_of_variation=0.01
        )
        problem = planned(TASK, example, FitOptions()).problem
        c, made, truth = problem.coordinates, [], []
        while len(made) < count:
            theta = rng.standard_normal(len(c.names))
            values = dict(zip(c.names, map(float, c.values_of(theta[None])[0]), strict=True))
            if not SETTINGS.frequency[0] < values["harmonic_frequency"] < SETTINGS.frequency[-1]:
                continue
            task = TASK.replace(**values)
            try:
                if second_order(task).notices or negative_coefficients(task):
                    continue
                with jax.enable_x64(True):
                    made += targets(
                        *recordings(task, segments, 1, 1000 * segments + len(made)), segments
                    )
            except (ValueError, RuntimeError):
                continue
            made[-1] = jm.Target(
                f"muscle {len(truth)}",
                made[-1].proportional_power,
                segments=[segments],
                settings=SETTINGS,
                coefficient_of_variation=made[-1].coefficient_of_variation,
            )
            truth.append(theta)
        with jax.enable_x64(True):
            known = dict(
                quantities(problem.linear(), expand(problem.linear(), np.array(truth)))[0][0]
            )
        known |= dict(zip(c.names, c.values_of(np.array(truth)).T, strict=True))
        inside: dict[str, list[bool]] = {}
        for i, result in enumerate(jm.fit_cohort(made, starts=STARTS).results.values()):
            for name, p in result.determined.items():
                low, high = p.interval or (None, None)
                inside.setdefault(name, []).append(
                    (low is None or known[name][i] >= low)
                    and (high is None or known[name][i] <= high)
                )
        for name, held in inside.items():
            print(
                f"{segments} segments, {name}: stated {len(held)} times, holds the truth"
                f" {np.mean(held):.3f} (three binomial errors"
                f" {3 * np.sqrt(0.0475 / len(held)):.3f})",
                flush=True,
            )


def harmonic(count: int) -> None:
    """How often a harmonic is called significant at 5 % in recordings that have none."""
    segments, still = 12, TASK.replace(harmonic_amplitude=0.0)
    with jax.enable_x64(True):
        made = targets(*recordings(still, segments, count, 7), segments)
        plans = [planned(TASK, target, FitOptions(starts=STARTS)) for target in made]
        problems = [plan.problem for plan in plans]
        starts = [starting_points(problem, 8) for problem in problems]
        ended = _together(
            [p.linear() for p in problems], starts, 40, "fits", lambda text, share: None, (0, 1)
        )
        found = [
            harmonic_test(problem, stage.minima)
            for problem, stage in zip(problems, ended, strict=True)
        ]
    p = np.array([test.p_value for test in found if test is not None and test.p_value is not None])
    print(
        f"{len(p)} recordings without harmonic: {100 * np.mean(p < 0.05):.1f} % significant at 5 %",
        flush=True,
    )


STUDIES = {"null": null, "power": power, "coverage": coverage, "harmonic": harmonic}


def run(studies: dict[str, Callable[[int], None]], description: str | None, count: int) -> None:
    """The study that the command line asks for."""
    asked = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    asked.add_argument("study", choices=studies)
    asked.add_argument("--count", type=int, default=count)
    given = asked.parse_args()
    warnings.simplefilter("ignore")
    studies[given.study](given.count)


if __name__ == "__main__":
    run(STUDIES, __doc__, 500)
