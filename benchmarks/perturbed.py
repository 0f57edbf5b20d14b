"""Perturbation experiments, simulated with NumPy alone, and what is found in them; the tables of
docs/perturbed.md.

    python benchmarks/perturbed.py PART [--count N]

PART: classical, amplitude, reflex, ankle, cascade, inertia, active, reference, people, rhythm,
richer, linear, seconds, limb, coverage or time.

Takes a minute to a quarter of an hour each, ankle some 40 s for each recording.
"""

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import scipy.integrate
import scipy.interpolate
import scipy.optimize
from measure import seconds as timed
from perturbed_muscle import DT, MARGIN, Sines, force, recorded

import jaxmuscle as jm
from jaxmuscle.fits import _search
from jaxmuscle.model._parameters import REFLEX
from jaxmuscle.objective._derived import GAINS, LIMB, PHASES, TISSUES

TASK = jm.PrescribedLength()
# The bundled knee extension as fitted, with masses of 0.5 kg
KNEE = TASK.replace(
    k_w=4.6e5, k_z=7.8e5, c_w=114.0, c_z=1.8, P_w=5.0, noise_K_w=0.27, noise_K_z=0.002
)
TREMOR = {
    "activation_time": 0.05,
    "resonance_amplitude": 0.14,
    "resonance_frequency": 9.6,
    "resonance_width": 1.6,
}
# At 36 N, and not where a fit begins
STRONG = TASK.replace(
    **{"m_w": 0.3, "m_z": 1.0, "k_w": 1500 / 4e-4, "k_z": 3000 / 4e-4, "c_w": 150.0, "c_z": 20.0},
    P_w=60.0,
    noise_K_w=0.15,
    noise_K_z=0.003,
)
QUICK = {"rungs": 0, "seeds": 0, "check_seeds": 0, "starts": 16}


def stiffness(task: jm.PrescribedLength, f: float) -> complex:
    """The dynamic stiffness [N/m] at one frequency [Hz]."""
    return complex(np.asarray(jm.response.dynamic_stiffness(task, np.array([f])))[0])


def truth(task: jm.PrescribedLength = TASK) -> dict[str, float]:
    """Base stiffness and damping of both tissues."""
    return {
        f"{c.upper()}_{j}0": (
            float(task[f"{c}_{j}"]) * float(task[f"{'x' if c == 'k' else 'v'}_ref_{j}"]) ** 2
        )
        for c in "kc"
        for j in "wz"
    }


def tangents() -> dict[str, float]:
    """Stiffness of the active tissue, and of both in series, as they are in the hold."""
    x_w = float(jm.response.equilibrium(TASK)[0])
    return {
        "K_w_tangent": float(TASK["k_w"]) * (float(TASK["x_ref_w"]) ** 2 + 3 * x_w**2),
        "tangent_stiffness": stiffness(TASK, 1e-4).real,
    }


def spread(name: str, values: list[float], stated: list[float], true: float) -> None:
    """A row: what was found on the average, how far the repeats scatter, what error was stated."""
    found, sd = np.mean(values), np.std(values, ddof=1)
    errors = np.array(stated if len(stated) else np.nan)
    inside = 100 * np.mean(np.abs(np.array(values) - true) < 1.96 * errors)
    print(
        f"{name:34s} true {true:8.4g}  mean {found:8.4g} ({100 * (found / true - 1):+5.1f} %) "
        f" scatter {sd:7.2g}",
        end="",
    )
    print(f"  stated {np.nanmean(errors):7.2g}  within 1.96 errors {inside:3.0f} %", flush=True)


def classical(count: int) -> None:
    """Nonparametric, spring-damper-mass and muscle, of the same recordings of a minute."""
    runs = recorded(TASK, np.random.default_rng(1), count)
    responses = [run.frequency_response("slow") for run in runs]
    for f in (0.5, 1.0, 2.0, 4.0):
        k = int(np.argmin(np.abs(responses[0].frequency - f)))
        at = responses[0].frequency[k]
        for part, words in ((np.real, "Re"), (np.imag, "Im")):
            spread(
                f"nonparametric {words} H({at:.2f} Hz)",
                [float(part(r.value[k])) for r in responses],
                [float(r.stderr[k]) for r in responses],
                float(part(stiffness(TASK, at))),
            )
    second = [run.second_order("slow") for run in runs]
    tangent = stiffness(TASK, 1e-4).real
    damping = stiffness(TASK, 1e-4).imag / (2e-4 * np.pi)
    for name, true in (("K", tangent), ("B", damping), ("I", float(TASK["m_z"]))):
        spread(
            f"second order {name}",
            [s[name].value for s in second],
            [float(s[name].stderr or 0) for s in second],
            true,
        )
    fits = [jm.fit(TASK, run, **QUICK) for run in runs]
    muscles = [fit.task for fit in fits]
    spread("muscle H(0)", [stiffness(task, 1e-4).real for task in muscles], [], tangent)
    for f in (0.5, 1.0, 2.0, 4.0):
        for part, words in ((np.real, "Re"), (np.imag, "Im")):
            spread(
                f"muscle {words} H({f:.2f} Hz)",
                [float(part(stiffness(task, f))) for task in muscles],
                [],
                float(part(stiffness(TASK, f))),
            )
    spread(
        "muscle C(0)",
        [stiffness(task, 1e-4).imag / (2e-4 * np.pi) for task in muscles],
        [],
        damping,
    )
    spread(
        "muscle m_z",
        [fit["m_z"].value for fit in fits],
        [float(fit["m_z"].stderr or 0) for fit in fits],
        float(TASK["m_z"]),
    )
    told(fits)


def told(fits: list[jm.fits.FitResult], task: jm.PrescribedLength = TASK) -> None:
    """Rows of the four numbers of the muscle, and how often the verdict accepts."""
    for name, true in truth(task).items():
        known = [fit[name] for fit in fits if fit[name].stderr is not None]
        if len(known) > 1:
            spread(
                f"muscle {name} (known {len(known)}/{len(fits)})",
                [p.value for p in known],
                [float(p.stderr or 0) for p in known],
                true,
            )
    print(
        f"  described: {sum(bool(fit.adequate) for fit in fits)}/{len(fits)}; p "
        + " ".join(f"{fit.adequacy_p:.2g}" for fit in fits)
    )
    print(
        "  " + "; ".join(sorted({fit.verdict.partition("; ")[2] for fit in fits} - {""})),
        flush=True,
    )


def described(
    task: jm.PrescribedLength, rms: float, rng: np.random.Generator, band: float
) -> tuple[np.ndarray, float]:
    """Departure of the describing function (mean of 64 draws of phases) from H over |H|, by line,
    and of the mean force."""
    sines = Sines(rng, 20.0, 64, high=band)
    x, v, a = (sines(rms * (2j * np.pi * sines.f) ** n) for n in range(3))
    periods = [np.tile(part, (3, 1)) for part in (x, v, a)]
    none = np.zeros_like(periods[0])
    F = force(task, *periods, none, none, none)[-(len(x) // 2) :]
    moved = np.fft.rfft(-x[::2], axis=0)[np.rint(20 * sines.f).astype(int)]
    answer = np.fft.rfft(F, axis=0)[np.rint(20 * sines.f).astype(int)]
    found = np.mean(answer / moved, axis=1)
    linear = np.array([stiffness(task, f) for f in sines.f])
    resting = force(task, *(np.zeros((len(x), 1)) for _ in range(6)))[-1, 0]
    return (
        np.stack([np.abs(found - linear) / np.abs(linear), np.abs(found), np.abs(linear), sines.f]),
        F.mean() / resting - 1,
    )


def agreement(rms: float) -> str:
    """The integrator of these programs, and `jaxmuscle.simulate`, against
    `scipy.integrate.solve_ivp`."""
    sines = Sines(np.random.default_rng(6), 10.0, 1)
    s = 2j * np.pi * sines.f
    signals = [sines(rms * s**n) for n in range(3)]
    time = DT * np.arange(sines.samples)
    x, v, _ = (scipy.interpolate.CubicSpline(time, part[:, 0]) for part in signals)
    m_w, P_w, k_w, k_z, c_w, c_z = (
        float(TASK[n]) for n in ("m_w", "P_w", "k_w", "k_z", "c_w", "c_z")
    )

    def passive(t: float, y: np.ndarray) -> float:
        return k_z * (TASK["x_ref_z"] ** 2 + x(t) ** 2) * (x(t) - y[0]) + c_z * (1 + v(t) ** 2) * (
            v(t) - y[1]
        )

    def slope(t: float, y: np.ndarray) -> list[float]:
        own = k_w * (TASK["x_ref_w"] ** 2 + y[0] ** 2) * y[0] + c_w * (1 + y[1] ** 2) * y[1]
        return [y[1], (P_w - own + passive(t, y)) / m_w]

    at = time[time >= 3.0][:-8:8]
    path = scipy.integrate.solve_ivp(
        slope, (0, 10), [0.01, 0.0], "DOP853", at, rtol=1e-10, atol=1e-12
    )
    wanted = (
        np.array([-passive(t, y) for t, y in zip(at, path.y.T, strict=True)])
        - 0.5 * signals[2][time >= 3.0][:-8:8, 0]
    )
    none = np.zeros_like(signals[0])
    own = np.interp(at, time[::2], force(TASK, *signals, none, none, none)[:, 0])
    moved = TASK.replace(
        noise_K_w=0.0, noise_K_z=0.0, noise_C_w=0.0, noise_C_z=0.0, harmonic_amplitude=0.0
    )
    moved = moved.with_parts(x_z=jm.model.Sampled.through(time, signals[0][:, 0]))
    run = jm.simulate(moved, jax.random.key(0), duration=9.9, rate=100, sampling="instant")
    theirs = np.asarray(run.output)[np.rint(100 * at[at < 9.9]).astype(int)]
    return ", ".join(
        f"{name} {np.max(np.abs(f - wanted[: f.size])) / np.std(wanted):.1e}"
        for name, f in (("NumPy", own), ("simulate", theirs))
    )


def amplitude(count: int) -> None:
    """From which amplitude on the muscle's response is not the linear one."""
    for rms in (1e-3, 8e-3):
        print(
            f"rms {1e3 * rms:g} mm, largest difference from scipy over the rms of the force:"
            f" {agreement(rms)}",
            flush=True,
        )
    for words, task in (("default, 2.2 N", TASK), ("carried to 40 N", TASK.at_force(40.0))):
        for band in (2.0, 5.0):
            for rms in (0.1e-3, 0.3e-3, 1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 8e-3):
                (off, _, size, f), mean = described(task, rms, np.random.default_rng(2), band)
                total = np.sqrt(np.mean((off * size) ** 2) / np.mean(size**2))
                worst = f"largest {100 * off.max():6.2f} % at {f[off.argmax()]:.2f} Hz"
                print(
                    f"{words:18s} to {band:g} Hz, rms {1e3 * rms:4.1f} mm: {worst}, rms"
                    f" {100 * total:5.2f} %, mean force {100 * mean:+.2f} %",
                    flush=True,
                )


def reflex(count: int) -> None:
    """A drive that follows the lengthening, late, through the twitch: the reflex. To length and
    velocity, moved to 5 Hz and fitted without one; and to velocity, moved to 20 Hz."""
    for high, how, length in ((5.0, "none", 1.0), (20.0, "auto", 0.0)):
        for late in (0.03, 0.05):
            for strength in (0.0, 0.1, 0.3, 1.0):

                def pull(
                    s: np.ndarray,
                    late: float = late,
                    strength: float = strength,
                    length: float = length,
                ) -> np.ndarray:
                    return (
                        100
                        * strength
                        * (length + 0.1 * s)
                        * np.exp(-s * late)
                        / (1 + 0.04 * s) ** 2
                    )

                rng, motion = np.random.default_rng(3), (1e-3, high)
                runs = recorded(TASK, rng, count, motion=motion, reflex=pull)
                print(
                    f"reflex {strength:g} of the stiffness at rest, late by {1e3 * late:g} ms,"
                    f" moved to {high:g} Hz, fitted with reflex={how!r}"
                )
                fits = [jm.fit(TASK, run, reflex=how, **QUICK) for run in runs]
                told(fits)
                seen = sum("reflex_gain" in fit.parameters for fit in fits)
                print(f"  a reflex is fitted in {seen} of {count}")
                for name, true in tangents().items():
                    off = [100 * (fit[name].value / true - 1) for fit in fits]
                    ends = [fit[name].interval for fit in fits if fit[name].interval is not None]
                    print(
                        f"  {name}: off by {np.mean(off):+.0f} % (mean), scatter"
                        f" {np.std(off, ddof=1):.0f} %; interval {len(ends)} times, holds"
                        f" {sum(_holds(each, true) for each in ends)}",
                        flush=True,
                    )


def inertia(count: int) -> None:
    """A rig whose mass is not in m_z, and in it."""
    for mass in (0.02, 0.1):
        runs = recorded(TASK, np.random.default_rng(4), count, mass=mass)
        for fixed in (0.5, 0.5 + mass):
            print(
                f"rig {mass:g} kg, fitted with m_z = {fixed:g} kg; second order I: "
                f"{np.mean([run.second_order('slow')['I'].value for run in runs]):.3f}"
            )
            told([jm.fit(TASK, run, fix={"m_z": fixed}, **QUICK) for run in runs])


def active(count: int) -> None:
    """Muscles of another active mass m_w than the fit begins with: m_w free, as by default, and
    held at 0.5 kg."""
    free: dict[str, Any] = {}
    for mass in (0.2, 0.5, 1.25):
        runs = recorded(TASK.replace(m_w=mass), np.random.default_rng(11), count)
        for words, given in (("free", free), ("held at 0.5 kg", {"fix": {"m_w": 0.5}})):
            print(f"m_w {mass:g} kg, {words}")
            fits = [jm.fit(TASK, run, **given, **QUICK) for run in runs]
            told(fits)
            for name, true in truth().items():
                ends = [fit[name].interval for fit in fits if fit[name].stderr is not None]
                held = np.mean([low < true < high for low, high in ends])
                print(f"  {name}: 95 % intervals hold the truth: {100 * held:.0f} %", flush=True)


def reference(count: int) -> None:
    """Reference displacements in the fit that are not those of the muscle, which has 20 mm."""
    runs = recorded(TASK, np.random.default_rng(11), count)
    true = truth() | tangents()
    for length in (0.010, 0.015, 0.020, 0.030, 0.040):
        scale = (0.02 / length) ** 2
        task = TASK.replace(
            x_ref_w=length, x_ref_z=length, **{k: scale * float(TASK[k]) for k in ("k_w", "k_z")}
        )
        fits = [jm.fit(task, run, **QUICK) for run in runs]
        off = {
            name: 100 * (np.mean([fit[name].value for fit in fits]) / value - 1)
            for name, value in true.items()
        }
        print(
            f"x_ref {1e3 * length:g} mm: "
            + ", ".join(f"{name} {change:+.0f} %" for name, change in off.items())
        )
        print(
            f"  described: {sum(bool(fit.adequate) for fit in fits)}/{count}; p "
            + " ".join(f"{fit.adequacy_p:.2g}" for fit in fits),
            flush=True,
        )


def people(count: int) -> None:
    """Muscles softer and stiffer than the default one of the same force, with and without a
    tremor."""
    for factor in (0.1, 0.3, 3.0):  # more is too fast for the steps of `recorded`
        muscle = TASK.replace(
            **{name: factor * float(TASK[name]) for name in ("k_w", "k_z", "c_w", "c_z")}
        )
        shaking = jm.model.on_rung(muscle, 2).replace(**TREMOR)
        runs = {
            "noise alone": recorded(muscle, np.random.default_rng(14), count),
            "tremor": _simulated(shaking, count),
        }
        for words, moved in runs.items():
            print(f"stiffness and damping times {factor:g}, {words}")
            fits = [jm.fit(TASK, run, seeds=0, check_seeds=0) for run in moved]
            told(fits, muscle)
            print(
                "  richest model tried: " + ", ".join(str(len(fit.ladder) - 1) for fit in fits),
                flush=True,
            )
            _held(fits, truth(muscle))


def _holds(interval: tuple[float | None, float | None], true: float) -> bool:
    """Whether it holds the truth; an end that is None is open."""
    low, high = interval
    return (low or 0.0) < true < (np.inf if high is None else high)


def _held(fits: list[jm.fits.FitResult], true: dict[str, float]) -> None:
    """How many of the 95 % intervals hold the truth."""
    print("  95 % intervals that hold the truth:", end="")
    for name, value in true.items():
        known = [fit[name].interval for fit in fits if fit[name].interval is not None]
        print(
            f" {name} {sum(_holds(each, value) for each in known)} of {len(known)} known;",
            end="",
        )
    print(flush=True)


def _simulated(
    muscle: jm.PrescribedLength, count: int, lines: np.ndarray = np.r_[30:300]
) -> list[jm.data.PerturbedRecording]:
    """A minute of the muscle moved at these lines [1/60 Hz], 1 mm rms, by the package's own
    simulation."""
    rng, rate, runs = np.random.default_rng(13), 100, []
    time = np.arange(90 * rate + 1) / rate
    for seed in range(count):
        phase = rng.uniform(0, 2 * np.pi, lines.size)
        length = np.cos(2 * np.pi * np.outer(time, lines / 60) + phase).sum(axis=1)
        length *= 1e-3 / np.std(length)
        moved = muscle.settled().with_parts(x_z=jm.model.Sampled.through(time, -length))
        force = np.asarray(jm.simulate(moved, seed, duration=90.0, rate=float(rate)).output)
        runs.append(jm.data.PerturbedRecording.from_array(force, length, rate).steady((30.0, 90.0)))
    return runs


def rhythm(count: int) -> None:
    """A sine of 4.25 Hz in both stiffnesses, and none: fitted as by default, and by noise alone."""
    for line in (0.003, 0.0):
        runs = recorded(TASK, np.random.default_rng(12), count, line=line)
        for words, task in (
            ("by default", TASK),
            ("by noise alone", TASK.replace(harmonic_amplitude=0.0)),
        ):
            fits = [jm.fit(task, run, **QUICK) for run in runs]
            found = sum("harmonic_frequency" in fit.free for fit in fits)
            print(f"amplitude {line:g}, fitted {words}: a harmonic in {found}/{count}")
            told(fits)
            for name, true in truth().items():
                off = [
                    (fit[name].value - true) / fit[name].stderr
                    for fit in fits
                    if fit[name].stderr is not None
                ]
                print(
                    f"  {name}: over the stated error: mean {np.mean(off):+.2f}, scatter"
                    f" {np.std(off, ddof=1):.2f}",
                    flush=True,
                )


def richer(count: int) -> None:
    """A strong muscle with a tremor, moved in two bands or evenly: its response taken off by the
    base model's muscle, or by the one that is found."""
    true = {
        "k_w": 1.61e7,
        "k_z": 1.61e7,
        "c_w": 1360.0,
        "c_z": 168.0,
        "P_w": 141.0,
        "noise_K_w": 0.27,
        "noise_K_z": 0.0013,
    }
    muscle = jm.model.on_rung(TASK, 2).replace(**true, **TREMOR)
    bands = {"two bands": np.r_[28:36, 170:200], "even": np.r_[30:300]}
    for words, lines in bands.items():
        runs = _simulated(muscle, count, lines)
        for how, times in (("by the base model", 0), ("by the model found", _search.RENEWALS)):
            kept, _search.RENEWALS = _search.RENEWALS, times
            fits = [jm.fit(TASK, run, **(QUICK | {"rungs": 2})) for run in runs]
            _search.RENEWALS = kept
            print(f"{words}, subtracted {how}")
            told(fits, TASK.replace(**{name: true[name] for name in ("k_w", "k_z", "c_w", "c_z")}))
            _held(fits, truth(muscle))


def linear(count: int) -> None:
    """Linear specimens whose force fluctuates in its own way: one spring, damper and mass, and two
    parts in series."""
    rate, length = 500.0, 66_000 // 2
    f = np.fft.rfftfreq(length, 1 / rate)
    s = 2j * np.pi * f

    def shaped(rng: np.random.Generator, gain: np.ndarray) -> np.ndarray:
        drawn = np.fft.irfft(np.fft.rfft(rng.standard_normal(length)) * gain, length)
        return drawn / np.std(drawn)

    two = 2000 + 60 * s + 0.5 * s**2, 4000 + 15 * s  # as the model's active and passive tissue
    specimens = {
        "one spring of 400 N/m": (400 + 10 * s + 0.3 * s**2, 1.2, 0.0, 400.0),
        "one spring of 3000 N/m, tremor": (3000 + 20 * s + 0.3 * s**2, 1.0, 0.03, 3000.0),
        "two parts in series, tremor": (
            two[0] * two[1] / (two[0] + two[1]) + 0.5 * s**2,
            1.0,
            0.03,
            4000 / 3,
        ),
    }
    for words, (answer, corner, tremor, true) in specimens.items():
        fits, apart, rng = [], [], np.random.default_rng(21)
        for _ in range(count):
            x = 1e-3 * shaped(rng, ((f >= 0.5) & (f <= 10)).astype(float))
            own = 0.2 * shaped(rng, 1 / (1 + (f / corner) ** 2)) + 0.003 * rng.standard_normal(
                length
            )
            own += tremor * shaped(rng, 1 / np.hypot(f**2 - 8.5**2, 0.8 * f))
            force = 20.0 + own + np.fft.irfft(np.fft.rfft(x) * answer, length)
            record = jm.data.PerturbedRecording.from_array(
                force, x, rate, positive="lengthening"
            ).steady((3.0, 63.0))
            fits.append(jm.fit(TASK, record, seeds=0, check_seeds=0))
            seen = fits[-1].target
            right = (
                jm.Recording(20.0 + own, rate)
                .steady(record.force.window)
                .target(settings=seen.settings)
            )
            apart.append(np.log(seen.proportional_power / right.proportional_power))
        print(
            f"{words}; fluctuations off by {np.sqrt(np.mean(np.square(apart))):.3f} (rms of the"
            " log)"
        )
        alone = [jm.fit(TASK, fit.target.stiffness) for fit in fits]
        for which, some in (("", fits), (", response alone", alone)):
            known = [
                fit["tangent_stiffness"]
                for fit in some
                if fit["tangent_stiffness"].stderr is not None
            ]
            spread(
                f"tangent stiffness{which} ({len(known)}/{count})",
                [p.value for p in known],
                [float(p.stderr or 0) for p in known],
                true,
            )
        print(f"  described: {sum(bool(fit.adequate) for fit in fits)}/{count}", flush=True)


def seconds(count: int) -> None:
    """Errors over the length of the recording, and over the amplitude."""
    for length, rms in ((30.0, 1e-3), (60.0, 1e-3), (120.0, 1e-3), (60.0, 0.5e-3), (60.0, 2e-3)):
        print(f"{length:g} s, {1e3 * rms:g} mm rms")
        told(
            [
                jm.fit(TASK, run, **QUICK)
                for run in recorded(TASK, np.random.default_rng(5), count, length, (rms, 5.0))
            ]
        )


def series(task: jm.PrescribedLength) -> dict[str, float]:
    """What is stated of a moved limb, by the equations of two tissues in series."""
    m_w, m_z, P_w = (float(task[name]) for name in ("m_w", "m_z", "P_w"))
    own = truth(task)
    K_w, K_z, C_w, C_z = own.values()

    def force(x: float) -> float:
        return (K_w * (1 + (x / float(task["x_ref_w"])) ** 2) + K_z) * x - P_w

    x = scipy.optimize.brentq(force, 0.0, 0.5)
    T = K_w * (1 + 3 * (x / float(task["x_ref_w"])) ** 2)
    return own | {
        "K_w_tangent": T,
        "tangent_stiffness": T * K_z / (T + K_z),
        "B0": (C_z * T**2 + C_w * K_z**2) / (T + K_z) ** 2,
        "m_z": m_z,
        "m_w": m_w,
    }


def answer(task: jm.PrescribedLength, f: float) -> complex:
    """The dynamic stiffness of two tissues in series [N/m] at a frequency [Hz]."""
    at, s = series(task), 2j * np.pi * f
    active = at["m_w"] * s**2 + at["C_w0"] * s + at["K_w_tangent"]
    passive = at["C_z0"] * s + at["K_z0"]
    return active * passive / (active + passive) + at["m_z"] * s**2


def limb(count: int) -> None:
    """What is stated of a moved limb: bias over the stated error, and intervals that hold."""
    for words, task in (("default muscle, 2.2 N", TASK), ("strong muscle, 36 N", STRONG)):
        print(words)
        runs = recorded(task, np.random.default_rng(36), count)
        fits = [jm.fit(TASK, run, **QUICK) for run in runs]
        _stated(fits, series(task), lambda f, task=task: answer(task, f))


# Two tissues about the axis of a joint (N m/rad, N m s/rad, kg m²), and a reflex (s)
ANKLE = {"K_w": 200.0, "K_z": 400.0, "C_w": 6.0, "C_z": 1.0, "m_w": 0.01, "m_z": 0.02}
LATE, TWITCH = 0.04, 0.05


def ankle_parts(f: Any) -> tuple[Any, Any, Any]:
    """Dynamic stiffness of the ankle's tissues [N m/rad] at frequencies [Hz], what a reflex of 1 N
    m s/rad adds to it, and how much of a torque on its active tissue the sensor reads."""
    s = 2j * np.pi * f
    passive = ANKLE["K_z"] + ANKLE["C_z"] * s
    through = passive / (ANKLE["m_w"] * s**2 + ANKLE["C_w"] * s + ANKLE["K_w"] + passive)
    late = s * np.exp(-s * LATE) / (1 + s * TWITCH) ** 2
    return ANKLE["m_z"] * s**2 + passive - passive * through, through * late, through


def ankle_record(
    rng: np.random.Generator, gain: float, high: float = 30.0, *, one_way: bool = False
) -> jm.data.PerturbedRecording:
    """A minute of the ankle that is moved evenly from 0.5 Hz to `high`, 16 mrad rms, with a reflex
    to its velocity, or to lengthening alone. Its torque of 10 N m fluctuates by a noise through a
    twitch on the active tissue, and one on the passive."""
    rate, seconds = 500.0, 60.0
    n = round((seconds + 2 * MARGIN) * rate)
    f = np.fft.rfftfreq(n, 1 / rate)
    moved = np.fft.rfft(rng.standard_normal(n)) * ((f >= 0.5) & (f <= high))
    moved *= 0.016 / np.std(np.fft.irfft(moved, n))
    tissues, reflex, through = ankle_parts(f)
    white = np.fft.rfft(rng.standard_normal((2, n))) * np.sqrt(rate / 2) / (1 + (f / 50) ** 4)
    own = through * white[0] / (1 + 2j * np.pi * f * TWITCH) ** 2 + 0.05 * (1 - through) * white[1]
    felt = moved
    if one_way:
        speed = np.fft.irfft(2j * np.pi * f * moved, n)
        felt = np.fft.rfft(np.maximum(speed, 0.0)) / np.where(f > 0, 2j * np.pi * f, np.inf)
    return jm.data.PerturbedRecording.from_array(
        10.0 + np.fft.irfft(tissues * moved + gain * reflex * felt + own, n),
        np.fft.irfft(moved, n),
        rate,
        positive="lengthening",
        units="N m",
        displacement_units="rad",
        window=(MARGIN, MARGIN + seconds),
    )


CASES = ((0.0, 30.0), (2.0, 30.0), (6.0, 30.0), (20.0, 30.0), (6.0, 5.0))


def ankle(count: int) -> None:
    """Muscle and reflex of an ankle, by the gain of the reflex [N m s/rad]: found or not, and
    intervals that hold. The last one is moved to 5 Hz only."""
    for gain, high in CASES:
        print(f"reflex {gain:g} N m s/rad, motion to {high:g} Hz")
        _ankles([ankle_fit(gain, high, seed) for seed in range(count)], gain)


def ankle_seed(gain: float, high: float, seed: int) -> np.random.Generator:
    """Of one of the records."""
    return np.random.default_rng([seed, int(gain), int(high)])


def ankle_fit(gain: float, high: float, seed: int) -> jm.fits.FitResult:
    """The fit of one of the records."""
    record = ankle_record(ankle_seed(gain, high, seed), gain, high)
    return jm.fit(TASK, record, seeds=0, check_seeds=0)


def cascade(count: int) -> None:
    """The parallel-cascade method and the fit, on ankles whose reflex answers lengthening alone:
    stiffness of the tissues when pulled slowly [N m/rad], and gain of the reflex at the sensor [N m
    s/rad], which is two thirds of its own."""
    through = ANKLE["K_z"] / (ANKLE["K_w"] + ANKLE["K_z"])
    for gain in (0.0, 2.0, 6.0, 20.0):
        records = [
            ankle_record(ankle_seed(gain, 30.0, seed), gain, one_way=True) for seed in range(count)
        ]
        print(f"reflex {gain:g} N m s/rad to lengthening alone")
        stiff, felt = np.transpose([parallel_cascade(record) for record in records]).tolist()
        spread("  parallel cascade, stiffness", stiff, [], ANKLE["K_w"] * through)
        spread("  parallel cascade, reflex", felt, [], gain * through)
        fits = [jm.fit(TASK, record, seeds=0, check_seeds=0) for record in records]
        limb = [fit["tangent_stiffness"] for fit in fits]
        scale = fits[0].target.stiffness.lever_arm ** 2
        errors = [scale * (np.nan if p.stderr is None else p.stderr) for p in limb]
        found = [scale * p.value for p in limb]
        spread("  fit, stiffness", found, errors, ANKLE["K_w"] * through)
        # one of twice the gain that answers lengthening alone is the linear one and what is beside
        felt = [
            2 * scale * fit["reflex_gain"].value * _through(fit)
            for fit in fits
            if "reflex_gain" in fit.parameters
        ]
        print(f"  a reflex is fitted in {len(felt)} of {count}")
        if len(felt) > 1:
            spread("  fit, reflex", felt, [], gain * through)


def _through(fit: jm.fits.FitResult) -> float:
    K_w, K_z = fit["K_w_tangent"].value, fit["K_z0"].value
    return K_z / (K_w + K_z)


def parallel_cascade(record: jm.data.PerturbedRecording) -> tuple[float, float]:
    """The method of Kearney, Stein & Parameswaran 1997 at 100 Hz: in turn a linear filter of the
    angle at lags within the delay of the reflex, and one of the positive part of the velocity at
    longer ones, each of what the other leaves, until that explains hardly more."""
    angle, rate = record.displacement.whole, record.rate
    f = np.fft.rfftfreq(angle.size, 1 / rate)
    speed = np.fft.irfft(2j * np.pi * f * np.fft.rfft(angle), angle.size)
    moved, felt, torque = (
        scipy.signal.decimate(x, round(rate / 100), ftype="fir")
        for x in (angle, np.maximum(speed, 0.0), record.force.whole)
    )
    late, inside = round(LATE * 100), slice(round(MARGIN * 100), -round(MARGIN * 100))
    lags = np.arange(-late, late), np.arange(late, 50)
    paths = [
        np.stack([np.roll(x, k)[inside] for k in own], axis=1)
        for x, own in zip((moved, felt), lags, strict=True)
    ]
    paths = [path - path.mean(axis=0) for path in paths]
    left = torque[inside] - torque[inside].mean()
    filters, before = [np.zeros(len(own)) for own in lags], np.inf
    while np.var(left) < (1 - 1e-6) * before:
        before = np.var(left)
        for i, path in enumerate(paths):
            more, *_ = np.linalg.lstsq(path, left)
            filters[i] += more
            left = left - path @ more
    return float(filters[0].sum()), float(filters[1].sum())


def _ankles(fits: list[jm.fits.FitResult], gain: float) -> None:
    response = fits[0].target.stiffness
    assert response is not None and response.lever_arm is not None
    scale = response.lever_arm**-2
    T, K_z = ANKLE["K_w"], ANKLE["K_z"]
    true = {
        "tangent_stiffness": T * K_z / (T + K_z),
        "B0": (ANKLE["C_z"] * T**2 + ANKLE["C_w"] * K_z**2) / (T + K_z) ** 2,
        "m_z": ANKLE["m_z"],
        "K_w_tangent": T,
        "K_z0": K_z,
        "C_w0": ANKLE["C_w"],
        "C_z0": ANKLE["C_z"],
        "reflex_gain": gain,
    }
    true = {name: scale * value for name, value in true.items()}
    true |= {"reflex_delay": LATE, "reflex_time": TWITCH}
    seen = [fit for fit in fits if "reflex_gain" in fit.parameters]
    words = [note for fit in fits for note in fit.notices if "cannot be told apart" in note]
    print(
        f"  a reflex is fitted in {len(seen)} of {len(fits)}; cannot be told apart: {len(words)};"
        f" described: {sum(bool(fit.adequate) for fit in fits)}"
    )
    shares = [list(fit.only.explained.values())[2:] for fit in fits]
    print(
        f"  explained, medians: {np.median([one[0] for one in shares]):.3f} together, the other"
        f" half {np.median([one[-1] for one in shares]):.3f}"
    )

    def answered(f: float) -> complex:
        tissues, reflex, _ = ankle_parts(f)
        return scale * (tissues + gain * reflex)

    _stated(fits, true, answered)


def _stated(
    fits: list[jm.fits.FitResult], true: dict[str, float], answer: Callable[[float], complex]
) -> None:
    rows: dict[str, list[tuple[float, Any]]] = {}
    for fit in fits:
        for gain, phase, f in zip(GAINS, PHASES, fit.only.thirds, strict=True):
            H = answer(f)
            true = true | {gain: abs(H), phase: np.degrees(np.angle(H))}
        for name in (*LIMB, *TISSUES, *REFLEX):
            if name in fit.parameters or name in fit.derived:
                rows.setdefault(name, []).append((true[name], fit[name]))
    for name, found in rows.items():
        stated = [(p.value - t, p.stderr) for t, p in found if p.stderr is not None]
        off, error = np.mean(stated, axis=0) if stated else (np.nan, np.nan)
        ends = [(t, p.interval) for t, p in found if p.interval is not None]
        held = [_holds(each, t) for t, each in ends]
        every = [100 * (p.value / t - 1) for t, p in found]
        print(
            f"  {name:18s} true {found[0][0]:8.4g}  mean {np.mean(every):+5.1f} %, median"
            f" {np.median(every):+5.1f} %; error stated {len(stated)} times,"
            f" {100 * error / found[0][0]:.1f} %, bias over it {off / error:+.2f}; interval"
            f" {len(ends)} times, one-sided {sum(None in each for _, each in ends)}, holds"
            f" {100 * np.mean(held):.0f} %",
            flush=True,
        )
    moved = [sum(n.startswith("rests on the prior") for n in fit.notices) for fit in fits]
    print(f"  rests on the prior: {sum(moved)} of {len(fits)}", flush=True)


def coverage(count: int) -> None:
    """Are the errors right: those of 64 s of the knee extension, against how far the fits scatter
    about the truth."""
    rng, fits = np.random.default_rng(7), list[jm.fits.FitResult]()
    for first in range(0, count, 20):  # so many simulations at once
        runs = recorded(KNEE, rng, min(20, count - first), 64.0)
        fits += [jm.fit(TASK, run, **QUICK) for run in runs]
    others = {name: float(KNEE[name]) for name in ("m_z", "noise_K_w", "noise_K_z")}
    for name, true in (truth(KNEE) | others).items():
        known = [fit[name] for fit in fits if fit[name].stderr is not None]
        if len(known) < 2:
            print(f"{name:10s} true {true:8.4g}  known {len(known)}/{count}", flush=True)
            continue
        stated = np.array([p.stderr for p in known], float)
        z = (np.array([p.value for p in known]) - true) / stated
        held = np.mean([p.interval[0] < true < p.interval[1] for p in known])
        print(
            f"{name:10s} true {true:8.4g}  known {len(known)}/{count}  stated"
            f" {100 * np.median(stated) / true:5.2f} %  over stated: scatter"
            f" {np.std(z, ddof=1):.2f}, mean {np.mean(z):+.2f}  95 % intervals hold the truth:"
            f" {100 * held:.0f} %",
            flush=True,
        )
    p = np.array([fit.adequacy_p for fit in fits], float)
    print(
        f"described: {sum(bool(fit.adequate) for fit in fits)}/{count}; p below 0.05:"
        f" {np.sum(p < 0.05)}",
        flush=True,
    )


def time(count: int) -> None:
    """Processor time, when warm, of a whole fit of a minute moved, of a minute held and of the
    bundled spectrum."""
    (moved,) = recorded(KNEE, np.random.default_rng(8), 1)
    (held,) = recorded(KNEE, np.random.default_rng(9), 1, motion=(1e-9, 5.0))  # m, unseen
    spectrum = jm.load_target("vastus-lateralis-26mvc")
    given = {
        "moved": (TASK, moved),
        "held": (jm.Isometric(), held.force),
        "spectrum": (spectrum.task(), spectrum),
    }
    taken = timed({name: lambda pair=pair: jm.fit(*pair) for name, pair in given.items()}, count)
    for name, found in taken.items():
        ratio = np.median(taken["moved"].processor / found.processor)
        print(
            f"{name:10s} processor time {np.median(found.processor):6.2f} s (wall"
            f" {np.median(found.wall):6.2f} s), median of {count} turns; that of a minute moved"
            f" over it {ratio:.2f}",
            flush=True,
        )


PARTS: dict[str, Callable[[int], None]] = {
    part.__name__: part
    for part in (
        classical,
        amplitude,
        reflex,
        ankle,
        cascade,
        inertia,
        active,
        reference,
        people,
        rhythm,
        richer,
        linear,
        seconds,
        limb,
        coverage,
        time,
    )
}


def main() -> None:
    """Run one part."""
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("part", choices=PARTS)
    arguments.add_argument("--count", type=int, default=20, help="recordings")
    given = arguments.parse_args()
    warnings.simplefilter("ignore")
    PARTS[given.part](given.count)


if __name__ == "__main__":
    main()
