"""What a user of fits waits for: a fit, its search from many starts, the command in a cold
process."""

import time

import jax
import numpy as np
from measure import Row, seconds

import jaxmuscle as jm
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._starts import starting_points

TARGETS = ("vastus-lateralis-26mvc", "fdi-abduction-45mvc")
NOISES = ("band-limited", "ornstein-uhlenbeck")
STARTS, MAX_STEPS, SEEDS = 100, 40, 32
NEAR = 1e-3
CHI2, SEARCH, FOUND_AGAIN, COHORT = 1.2, 6.0, 10, 30.0
POSTERIOR = 120.0
PEOPLE, SEGMENTS = 50, 12


def fits() -> list[Row]:
    """Every measured target with two noises, the second of two equal calls timed; the first noise
    is the default."""
    found: list[Row] = []
    print(f"{'chi2 per bin (warm wall time)':<32}" + "".join(f"{noise:>24}" for noise in NOISES))
    for name in TARGETS:
        print(f"{name:<32}", end="", flush=True)
        target = jm.load_target(name)
        for noise in NOISES:
            task = target.task(noise=noise)
            jm.fit(task, target)
            start = time.perf_counter()
            result = jm.fit(task, target)
            wall = time.perf_counter() - start
            chi2 = np.nan if result.chi2_per_bin is None else result.chi2_per_bin
            group, asked = f"fit {name}, {noise}", CHI2 if noise == NOISES[0] else None
            found += [
                Row(
                    f"{group}: chi2 per bin",
                    float(chi2),
                    "1 (expected: about 0.7)",
                    target=asked,
                    at_most=True,
                )
            ]
            found += [Row(f"{group}: warm wall time", wall, "s")]
            cell = f"{chi2:.2f} ({wall:.0f} s)" + ("" if result.success else ", failed")
            print(f"{cell:>24}", end="", flush=True)
        print()
    return found


def starts(repetitions: int) -> list[Row]:
    """The search of a default fit: every start to its minimum in linear response, and how many end
    in the best one."""
    found: list[Row] = []
    for name in TARGETS:
        with jax.enable_x64(True):
            target = jm.load_target(name)
            problem = planned(target.task(), target, FitOptions()).problem
            points = starting_points(problem, STARTS)
            program = lambda s=problem, p=points: least_squares(s.linear(), p, MAX_STEPS)  # noqa: E731
            wall, busy = (
                float(np.median(t))
                for t in seconds({"search": program}, min(repetitions, 5))["search"]
            )
            cost = program().cost
        again = int(np.sum(cost <= (1 + NEAR) * np.nanmin(cost)))
        found += [
            Row(f"{STARTS} starts, {name}: warm wall time", wall, "s", target=SEARCH, at_most=True),
            Row(f"{STARTS} starts, {name}: processor time", busy, "s"),
            Row(
                f"{STARTS} starts, {name}: within {100 * NEAR:g} % of the best cost",
                again,
                "starts",
                target=FOUND_AGAIN,
            ),
        ]
    return found


def posterior() -> list[Row]:
    """Four chains for the first target, the second of two calls; the worst R-hat of what is
    determined."""
    target = jm.load_target("vastus-lateralis-26mvc")
    result = jm.fit(target.task(), target)
    for key in (1, 2):
        begun = time.perf_counter()
        found = jm.posterior(result, target, key=key)
        wall = time.perf_counter() - begun
    r_hat = max(found.diagnostics[name][0] for name in found.determined)
    return [
        Row("posterior, 4 chains: warm wall time", wall, "s", target=POSTERIOR, at_most=True),
        Row(
            "posterior, 4 chains: largest R-hat of what is determined",
            r_hat,
            "",
            target=1.01,
            at_most=True,
        ),
        Row("posterior, 4 chains: divergences", found.divergences, "draws", target=0, at_most=True),
    ]


def cohort() -> list[Row]:
    """Fifty targets drawn about the expected spectra of different people, fitted together; warm."""
    rng, targets = np.random.default_rng(0), []
    for number in range(PEOPLE):
        person = jm.Isometric().replace(
            c_w=60 * np.exp(0.2 * rng.normal()),
            harmonic_frequency=5 + 0.3 * rng.normal(),
            harmonic_amplitude=0.01,
        )
        spectrum = jm.expected_spectrum(person)
        nu = spectrum.settings.degrees_of_freedom(SEGMENTS)
        power = np.asarray(spectrum.power) * rng.chisquare(nu, len(spectrum.power)) / nu
        targets.append(jm.Target(f"person {number}", power, segments=SEGMENTS))
    jm.fit_cohort(targets)
    start = time.perf_counter()
    found = jm.fit_cohort(targets)
    wall = time.perf_counter() - start
    converged = sum(result.success for result in found.results.values())
    return [
        Row(f"cohort of {PEOPLE}: warm wall time", wall, "s", target=COHORT, at_most=True),
        Row(f"cohort of {PEOPLE}: converged", converged, "fits"),
    ]
