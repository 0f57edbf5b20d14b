"""What `jaxmuscle demo` writes: simulated recordings of a study and of a moved limb, and what is
true of them."""

import csv
import io
import itertools
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import scipy.signal
from jaxtyping import Float

import jaxmuscle as jm
from jaxmuscle._common.files import write_text

TABLE, MOVED, README = "study.csv", "moved.csv", "README.txt"
RATE = 250.0  # Hz
REST, RAMP, HOLD, LEAD = 1.5, 1.5, 16.0, 4.0  # s; LEAD: until the noise of the muscle is stationary
MOTION = 66.0  # s of the hold in which a motor moves
EDGE = 7.0  # Hz, above which the motor is slower
TRIALS = 3
SENSOR = 0.02  # N, standard deviation of the sensor's own noise
STIFFNESS, DAMPING, MASS = 1200.0, 15.0, 0.4  # N/m, N s/m, kg of the limb that is moved
MARK = "# SIMULATED by `jaxmuscle demo`. Nobody was measured."


class Person(NamedTuple):
    """What differs between people: force [N], damping of the muscle (over the default), noise on
    its stiffness, contraction time [s], frequency [Hz] and size of the drive's tremor when tired,
    and by what factor the noise grows when tired."""

    name: str
    force: float
    damping: float
    noise: float
    twitch: float
    tremor_frequency: float
    tremor: float
    tires: float


class Condition(NamedTuple):
    """How far the noise has grown (0 to 1), which share of the tremor is there, and how much force
    is lost during a hold, over its mean."""

    name: str
    growth: float
    tremor: float
    loss: float


PEOPLE = (
    Person("sim01", 41.0, 1.00, 0.21, 0.060, 8.9, 0.28, 1.4),
    Person("sim02", 36.0, 0.85, 0.29, 0.055, 9.6, 0.22, 1.1),
    Person("sim03", 52.0, 1.20, 0.19, 0.070, 8.3, 0.29, 1.7),
    Person("sim04", 47.0, 0.95, 0.24, 0.055, 9.3, 0.30, 1.3),
    Person("sim05", 33.0, 1.10, 0.32, 0.065, 8.6, 0.14, 1.2),
    Person("sim06", 58.0, 0.90, 0.22, 0.060, 10.1, 0.26, 1.5),
)
CONDITIONS = (Condition("rest", 0.0, 0.4, 0.01), Condition("tired", 1.0, 1.0, 0.025))
WANDER = 0.004  # standard deviation of the slow wander of a trial, over the mean
LEVEL = 0.015  # standard deviation of the mean force from trial to trial, over the mean


def trials() -> list[str]:
    """The names of the files of all trials."""
    return [
        f"{person.name}_{condition.name}_{trial}.csv"
        for person, condition in itertools.product(PEOPLE, CONDITIONS)
        for trial in range(1, TRIALS + 1)
    ]


def write_demo(folder: Path, commands: str) -> list[str]:
    """Write the recordings, their table and README.txt, which names `commands` to try; the names of
    the files.

    They hold the same numbers each time.
    """
    rng = np.random.default_rng(3)
    names, rows, moved = iter(trials()), [], ""
    held = _held()
    for number, (person, condition) in enumerate(itertools.product(PEOPLE, CONDITIONS)):
        for trial in range(TRIALS):
            force = _with_wander(held[number, trial, : round(RATE * HOLD)], condition.loss, rng)
            name = next(names)
            write_text(folder / name, _recording(rng, {"force_N": _with_ramps(force)}))
            rows.append(f"{name},{person.name},{condition.name},{trial + 1}")
        if not number:
            force, displacement = _moved(_with_wander(held[number, TRIALS], 0.0, rng), rng)
            columns = {"force_N": force, "displacement_mm": 1e3 * displacement}
            moved = _recording(rng, columns)
    write_text(folder / MOVED, moved)
    write_text(folder / README, _readme(commands))
    write_text(folder / TABLE, "\n".join(["file,person,condition,trial", *rows]) + "\n")
    return [*trials(), MOVED, README, TABLE]


def _held() -> Float[np.ndarray, "cells trials times"]:
    """Force [N] of every person in every condition, by the nonlinear model with activation and a
    tremor of the drive."""
    base = jm.model.on_rung(jm.Isometric().replace(harmonic_amplitude=0.0), 2)
    damping, force = float(base["c_w"]), []
    for number, (person, condition) in enumerate(itertools.product(PEOPLE, CONDITIONS)):
        task = base.replace(
            c_w=person.damping * damping,
            noise_K_w=person.noise * person.tires**condition.growth,
            activation_time=person.twitch,
            resonance_amplitude=person.tremor * condition.tremor,
            resonance_frequency=person.tremor_frequency,
        )
        runs = jm.ensemble(
            task.at_force(person.force).settled(),
            jax.random.key(number),
            seeds=TRIALS + 1,
            duration=LEAD + MOTION,
            control=False,
        )
        force.append(np.asarray(runs.output, float)[:, round(LEAD * runs.rate) :])
    return scipy.signal.resample_poly(force, round(RATE), 100, axis=-1, padtype="line")


def _with_wander(
    force: Float[np.ndarray, " times"], loss: float, rng: np.random.Generator
) -> Float[np.ndarray, " times"]:
    """The force with a straight loss, and a slow wander whose power falls as 1/f²."""
    n, mean = force.size, force.mean()
    f = np.fft.rfftfreq(2 * n, 1 / RATE)
    f[0] = np.inf
    wander = np.fft.irfft((rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)) / f)[:n]
    wander *= WANDER / wander.std()
    force = (1 + LEVEL * rng.standard_normal()) * force
    return force + mean * (wander - wander.mean() - loss * np.linspace(-0.5, 0.5, n))


def _with_ramps(force: Float[np.ndarray, " held"]) -> Float[np.ndarray, " times"]:
    """The trial: rest, a ramp, the hold, a ramp, rest."""
    rest, ramp = np.zeros(round(RATE * REST)), np.linspace(0, 1, round(RATE * RAMP))
    return np.concatenate([rest, ramp * force[0], force, ramp[::-1] * force[-1], rest])


def _moved(
    held: Float[np.ndarray, " times"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, " times"]]:
    """Force [N] and lengthening [m] of a limb that is a spring, a damper and a mass, moved by 1 mm
    rms from 0.3 Hz on, less above the `EDGE`."""
    f = np.fft.rfftfreq(held.size, 1 / RATE)
    size = np.where((f >= 0.3) & (f <= 20.0), 1 / np.sqrt(1 + (f / EDGE) ** 8), 0.0)
    lines = size * np.exp(2j * np.pi * rng.uniform(size=f.size))
    lines *= 1e-3 / np.fft.irfft(lines, held.size).std()
    s = 2j * np.pi * f
    answer = (STIFFNESS + DAMPING * s + MASS * s**2) * lines
    return held + np.fft.irfft(answer, held.size), np.fft.irfft(lines, held.size)


def _recording(rng: np.random.Generator, columns: dict[str, Float[np.ndarray, " times"]]) -> str:
    """A CSV of time and these columns, the force with the noise of its sensor."""
    force = columns["force_N"]
    columns = columns | {"force_N": force + SENSOR * rng.standard_normal(force.size)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time_s", *columns])
    times = np.arange(force.size) / RATE
    writer.writerows(
        [f"{value:.4f}" for value in row] for row in zip(times, *columns.values(), strict=True)
    )
    return f"{MARK}\n{text.getvalue()}"


def _readme(commands: str) -> str:
    """What is in the files, and what is true of these people."""
    (rest, tired), people = CONDITIONS, len(PEOPLE)
    rows = "\n".join(
        f"  {p.name}   {p.force:.0f} N   {p.tremor_frequency:4.1f} Hz   {p.tires:g} times as strong"
        for p in PEOPLE
    )
    return f"""SIMULATED RECORDINGS, written by `jaxmuscle demo`. Nobody was measured.

{TABLE}             the table of the study: file, person, condition, trial
sim01_rest_1.csv ...  {people} people hold a force for {HOLD:g} s, {TRIALS} times at rest and tired
{MOVED}             a motor moves the limb of sim01 during a hold (1 mm rms, 0.3 to {EDGE:g} Hz)

Time in s, force in N, displacement (lengthening) in mm, {RATE:g} samples per second.

What is true
  person  force  tremor    when tired the muscle's noise is
{rows}

The tremor is that of the nervous drive. Its peak in the force lies somewhat lower. At rest it
has {100 * rest.tremor:g} % of its size when tired. During a hold the force falls by
{100 * rest.loss:g} % at rest and by {100 * tired.loss:g} % when tired. Each trial also wanders
slowly, by {100 * WANDER:g} %.

The moved limb is a spring of {STIFFNESS:g} N/m, a damper of {DAMPING:g} N s/m and a mass of
{MASS:g} kg, beside the force that the person holds.

Commands to try, from the folder above this one
{commands}
"""
