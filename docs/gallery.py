"""Draws the gallery and writes its page: `python docs/gallery.py` (minutes), or only `python
docs/gallery.py FILE ...`."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
PAGE = HERE / "gallery.md"
DPI, COLOURS = 130, 256
PAPER = {
    "fig2": "Force, tuned to Slifkin & Newell (reference 30)",
    "fig3": "Spectrum of this force",
    "fig4a": "Its proportional power",
    "fig4b": "The same, logarithmic",
    "fig5": "Displacement at constant force",
    "fig6a": "Force, tuned to Hamilton et al. (reference 12)",
    "fig6b": "Spectrum of the displacement",
    "fig7": "Spectra of three people: by FFT (above) and by Welch's method",
    "fig8": "Bins of one person against those of another",
}


class Shown(NamedTuple):
    """A figure: its file, the expression that draws it (empty: the setup does), words, where to
    read more."""

    file: str
    code: str
    words: str
    link: str


class Section(NamedTuple):
    title: str
    setup: str
    figures: tuple[Shown, ...]


HEAD = """---
hide: [navigation]
---

# Gallery

Use this page to find a figure by its looks. It shows every figure that jaxmuscle draws. Below each figure stands the line of
code that draws it. Each section begins with a block of code. Run the blocks one after another: the lines below the figures
use what these blocks define. Click on a figure to see it whole.

The functions of [`jm.plot`](reference/figures.md) draw the figures. They can also draw into your own Matplotlib axes.
`docs/gallery.py` makes this page and its figures.
"""
TAIL = """
## A Hill-type muscle

You can use a [muscle of your own](own-muscle.md). As an example, `python docs/hill_muscle.py` draws a Hill-type
muscle, and its spectrum with two colours of noise.

[![Force-length, force-velocity and tendon curves; isometric force spectrum](hill.png){ .wide }](hill.png)
"""

FIT = """
import jax
import jaxmuscle as jm

key = jax.random.key(0)
target = jm.load_target("vastus-lateralis-26mvc")
result = jm.fit(target.task(), target)
"""
SIMULATED = """
runs = jm.ensemble(result.task, key, seeds=200)
summary = jm.ensemble(result.task, key, seeds=2000, reduce=True)
sweep = jm.ensembles.Sweep.grid(result.task, c_w=[50.0, 100.0, 200.0])
ax = None
for task, run in zip(sweep, jm.ensemble(sweep, key, seeds=100), strict=True):
    ax = run.spectrum().mean().plot(ax, label=f"c_w = {task['c_w']:g} N s³/m³")
"""
SURE = """
found = jm.posterior(result, target, key=jax.random.key(2))
corner = jm.profile(result, "corner_frequency")
refits = jm.checks.bootstrap(result)
"""
PEOPLE = """
import numpy as np

held = jm.simulate(result.task.settled(), key, duration=40.0, rate=1000.0).output
ramp = np.linspace(0.0, float(held[0]), 3000)
np.savetxt("trial.csv", np.concatenate([ramp, held, ramp[::-1]]), header="force", comments="")
recording = jm.load_recording("trial.csv", column="force", rate=1000, units="N")
seeds = jm.ensemble(result.task.settled(), key, seeds=5, duration=20.0)
trials = [
    jm.Recording(force, seeds.rate, name=f"trial {i}")
    for i, force in enumerate(np.asarray(seeds.output))
]

people = {}
for i, name in enumerate(["ann", "ben", "eve", "jim", "kim", "tom"]):
    one = (
        jm.Isometric()
        .replace(noise_K_w=0.12 + 0.04 * (i % 2))
        .at_level(0.2 + 0.1 * i, reference=0.26)
    )
    power = np.asarray(
        jm.ensemble(one, jax.random.key(i), seeds=6).spectrum().mean().proportional, float
    )
    people[name] = jm.Target(name, power, segments=[6] * 6, mvc_fraction=0.2 + 0.1 * i)
cohort = jm.fit_cohort(
    list(people.values()), groups={name: "ab"[i % 2] for i, name in enumerate(people)}
)
pair = {
    name: jm.Isometric().replace(P_w=5.0 * people[name].mvc_fraction / 0.26)
    for name in ("ann", "eve")
}
"""
MOVED = """
import numpy as np
import scipy.signal

held = np.asarray(jm.simulate(result.task.settled(), key, duration=60.0, rate=1000.0).output)
low = scipy.signal.butter(4, 5.0, fs=1000.0, output="sos")
moved = scipy.signal.sosfilt(low, np.random.default_rng(0).standard_normal(held.size))
moved *= 1e-3 / np.std(moved)
speed = np.gradient(moved, 1e-3)
# a spring, damper, mass beside it
force = held + 300.0 * moved + 6.0 * speed + 0.1 * np.gradient(speed, 1e-3)
perturbed = jm.data.PerturbedRecording.from_array(
    force, moved, 1000, name="anna", window=(2.0, 60.0)
)

# a muscle, moved by sines from 0.1 to 5 Hz, 1 mm rms
time, lines = np.arange(7200) / 100, np.arange(8, 361) / 72
phases = np.random.default_rng(1).uniform(0, 2 * np.pi, lines.size)
length = (
    1e-3 * np.sqrt(2 / lines.size) * np.cos(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
)
muscle = jm.PrescribedLength(x_z=jm.model.Sampled.through(time, -length)).replace(
    harmonic_amplitude=0.0
)
pulled = np.asarray(jm.simulate(muscle, key, duration=71.9, rate=100.0).output)
minute = jm.data.PerturbedRecording.from_array(
    pulled, length[: pulled.size], 100, name="a minute", window=(6.0, 66.0)
)
"""
STUDY = """
rows = []
shaking = jm.model.on_rung(jm.Isometric(), 2).at_level(0.3, reference=0.26)
for i, name in enumerate(people):
    for j, (condition, size) in enumerate({"rest": 0.08, "tired": 0.12}.items()):
        one = shaking.replace(
            noise_K_w=0.12 + 0.01 * i,
            noise_K_z=0.002,
            resonance_frequency=9.0 - 0.8 * (i % 2) - 0.3 * j + 0.2 * i,
            resonance_amplitude=size,
        )
        run = jm.ensemble(one.settled(), jax.random.key(i + 10 * j), seeds=3, duration=25.0)
        for k, force in enumerate(np.asarray(run.output)):
            file = f"{name}-{condition}-{k}.npy"
            np.save(file, force)
            about = {"person": name, "group": "ab"[i % 2], "condition": condition}
            rows.append(about | {"file": file, "trial": str(k)})
study = jm.run_study(rows, rate=100.0, units="N m", window=(5.0, 25.0), rung=2)
"""
SECTIONS = (
    Section(
        "A fit",
        FIT,
        (
            Shown(
                "fit.png",
                "result.plot()",
                "A fit: spectrum with its parts, residuals",
                "tutorial.md#4-read-it",
            ),
            Shown(
                "gallery/starts.png",
                "jm.plot.starts(result)",
                "Did all starts end at the same minimum?",
                "fitting.md",
            ),
            Shown(
                "gallery/target.png",
                "target.plot(log=True)",
                "A target with the sampling error of its bins",
                "digitise.md",
            ),
        ),
    ),
    Section(
        "Simulations",
        SIMULATED,
        (
            Shown(
                "gallery/simulation.png",
                "jm.plot.simulation(runs)",
                "Output, its analysed window, spectra",
                "model.md",
            ),
            Shown(
                "gallery/trajectory.png",
                "runs.plot(window=(10.0, 15.0))",
                "200 seeds: their mean, their 90 % band, and three of them",
                "model.md",
            ),
            Shown(
                "gallery/spectrum.png",
                "runs.spectrum().plot(log=True, proportional=False)",
                "The spectra of these 200 seeds",
                "model.md",
            ),
            Shown(
                "gallery/estimate.png",
                "runs.mean_spectrum().plot(log=True)",
                "Mean spectrum of these seeds, with and without control variate",
                "model.md",
            ),
            Shown(
                "gallery/moments.png",
                "summary.plot()",
                "Mean and band of 2000 seeds that are not stored",
                "ensembles.md",
            ),
            Shown(
                "gallery/sweep.png",
                "ax",
                "A sweep: three dampings with the same noise",
                "ensembles.md",
            ),
            Shown(
                "gallery/sensitivity.png",
                "jm.response.sensitivity(result.task).plot()",
                "How much each parameter changes each bin",
                "model.md",
            ),
            Shown(
                "gallery/static.png",
                "jm.response.static_characteristics(result.task).plot()",
                "Stiffness, damping and force against displacement and velocity",
                "scaling.md",
            ),
        ),
    ),
    Section(
        "How sure is it, and is it right?",
        SURE,
        (
            Shown(
                "gallery/profile.png",
                "corner.plot()",
                "A profile: how far one quantity can move",
                "uncertainty.md",
            ),
            Shown(
                "gallery/posterior.png",
                "found.plot()",
                "The posterior of what the data determine",
                "uncertainty.md",
            ),
            Shown(
                "gallery/chains.png",
                "found.plot_chains()",
                "The chains of the posterior",
                "uncertainty.md",
            ),
            Shown(
                "gallery/predictive.png",
                "found.plot_predictive()",
                "The spectra that the posterior predicts",
                "uncertainty.md",
            ),
            Shown(
                "identifiability.png",
                "jm.identifiability(result).plot()",
                "What further measurements would determine",
                "identifiability.md",
            ),
            Shown(
                "gallery/designed_input.png",
                "jm.uncertainty.design_input(result).plot()",
                "A motion made to measure stiffness",
                "perturbed-design.md",
            ),
            Shown(
                "gallery/goodness.png",
                "jm.checks.goodness(result).plot()",
                "Is the model right? Residuals against what is usual",
                "goodness.md",
            ),
            Shown(
                "gallery/bootstrap.png",
                "refits.plot()",
                "Are the stated errors right? Refits of simulated data",
                "goodness.md",
            ),
            Shown(
                "gallery/coverage.png",
                "refits.plot_coverage()",
                "Do intervals of every level hold the truth as often as they say?",
                "uncertainty.md#the-coverage-curve",
            ),
            Shown(
                "gallery/comparison.png",
                "jm.comparison.compare_noise(jm.Isometric(), target).plot()",
                "Which noise? Models compared",
                "noise-colour.md",
            ),
        ),
    ),
    Section(
        "Recordings, people, several measurements",
        PEOPLE,
        (
            Shown(
                "gallery/recording.png",
                "recording.steady().plot()",
                "A recording and its steady window",
                "recordings.md",
            ),
            Shown(
                "gallery/trials.png",
                "jm.data.Trials(trials).plot()",
                "Five trials and their mean spectrum",
                "recordings.md#several-trials-of-one-person",
            ),
            Shown(
                "gallery/steadiness.png",
                "jm.data.steadiness(trials).plot()",
                "How steady five trials are",
                "recordings.md#steadiness",
            ),
            Shown(
                "gallery/cohort.png",
                "cohort.plot()",
                "What six people's spectra determine",
                "fitting.md#many-targets",
            ),
            Shown(
                "gallery/groups.png",
                "jm.plot.groups(cohort)",
                "Spectra and numbers of these six people",
                "fitting.md#many-targets",
            ),
            Shown(
                "gallery/levels.png",
                'cohort.plot(by="level")',
                "The same six people by level of contraction",
                "fitting.md#many-targets",
            ),
            Shown(
                "gallery/joint.png",
                "jm.fit(pair, {name: people[name] for name in pair}).plot()",
                "Two measurements fitted together",
                "identifiability.md#a-joint-fit",
            ),
        ),
    ),
    Section(
        "A moved insertion",
        MOVED,
        (
            Shown(
                "gallery/perturbed.png",
                "perturbed.plot()",
                "Force and displacement, and the stiffness between them",
                "perturbed.md",
            ),
            Shown(
                "gallery/fitted_stiffness.png",
                "jm.fit(jm.PrescribedLength(), minute).plot()",
                "A muscle fitted to a minute with a moved insertion: its stiffness and its"
                " fluctuations",
                "perturbed.md#fit-it",
            ),
            Shown(
                "gallery/frequency_response.png",
                "perturbed.frequency_response().plot()",
                "The dynamic stiffness with its errors",
                "perturbed.md",
            ),
        ),
    ),
    Section(
        "A study",
        STUDY,
        (
            Shown(
                "gallery/study.png",
                "study.plot()",
                "A study: spectra of people and their means, tremors marked",
                "study.md",
            ),
            Shown(
                "gallery/quantities.png",
                'study.figures()["quantities"]',
                "Its quantities: people, joined, and the means with their intervals",
                "study.md",
            ),
            Shown(
                "gallery/study_trials.png",
                "jm.plot.study_trials(study)",
                "Its recordings, with what is analysed",
                "study.md",
            ),
        ),
    ),
    Section(
        "The paper's figures",
        '\nfrom jaxmuscle import paper\n\npaper.reproduce("paper")\n',
        tuple(
            Shown(f"gallery/paper-{name}.png", "", words, "reproduce.md")
            for name, words in PAPER.items()
        ),
    ),
)


def page() -> str:
    """The text of the page."""
    parts = [HEAD]
    for section in SECTIONS:
        parts.append(
            f'\n## {section.title}\n\n```python{section.setup}```\n\n<div class="gallery"'
            " markdown>\n"
        )
        for shown in section.figures:
            code = f"`{shown.code}`" if shown.code else f"`{drawn(shown)}`"
            parts.append(f"\n<figure markdown>\n[![{shown.words}]({shown.file})]({shown.file})\n")
            caption = f"{code}<br>[{shown.words}]({shown.link})"
            parts.append(f"<figcaption markdown>{caption}</figcaption>\n</figure>\n")
        parts.append("\n</div>\n")
    return "".join(parts) + TAIL


def drawn(shown: Shown) -> str:
    """The file that the setup of a section wrote."""
    return "paper/" + shown.file.removeprefix("gallery/paper-")


def draw(shown: Shown, names: dict[str, Any], out: Path) -> None:
    """Evaluates the expression of a figure and stores the picture, in few colours."""
    import matplotlib.pyplot as plt
    from PIL import Image

    path = out / shown.file
    path.parent.mkdir(parents=True, exist_ok=True)
    if shown.code:
        made = eval(shown.code, names)
        made = made[0] if isinstance(made, tuple) else made
        getattr(made, "figure", made).savefig(path, dpi=DPI)
        plt.close("all")
    few_colours(Image.open(path if shown.code else drawn(shown)).convert("RGB")).save(
        path, optimize=True
    )


def few_colours(picture: Any) -> Any:
    """The picture in its commonest colours: lines and areas keep theirs, the edges of letters get
    the nearest."""
    import numpy as np
    from PIL import Image

    pixels = np.asarray(picture)
    codes = pixels.reshape(-1, 3) @ np.array([1 << 16, 1 << 8, 1])
    codes, where, counts = np.unique(codes, return_inverse=True, return_counts=True)
    colours = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1)
    kept = colours[np.argsort(-counts, kind="stable")[:COLOURS]]
    nearest = np.array([np.argmin(np.sum((kept - colour) ** 2, axis=1)) for colour in colours])
    small = Image.fromarray(nearest[where].astype(np.uint8).reshape(pixels.shape[:2]))
    small.putpalette(kept.ravel().tolist())
    return small


def main(only: list[str]) -> None:
    PAGE.write_text(page(), encoding="utf-8")
    names: dict[str, Any] = {}
    os.chdir(tempfile.mkdtemp())
    for section in SECTIONS:
        wanted = [shown for shown in section.figures if not only or shown.file in only]
        if wanted or "result" not in names:
            exec(section.setup, names)
        for shown in wanted:
            draw(shown, names, HERE)
            print(shown.file, (HERE / shown.file).stat().st_size // 1024, "KiB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
