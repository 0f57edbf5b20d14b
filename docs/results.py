"""Draws what the README and the home page show first: `python docs/results.py` writes
docs/results.png, from the recordings of `jaxmuscle demo`."""

import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxmuscle as jm
from jaxmuscle.commands import simulated

PICTURE = Path(__file__).parent / "results.png"
PERSON = "sim01"
COLOURS = {"rest": jm.plot.BLUE, "tired": jm.plot.VERMILLION}
APART = 12.0  # % of the mean force, from trial to trial
GREY = "#767676"


@jm.plot.styled
def draw(folder: Path) -> Figure:
    """Trials of a person, spectra of the study, stiffness of the moved limb."""
    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.0), layout="constrained")
    show_trials(panels[0], folder)
    show_spectra(panels[1], jm.run_study(folder / simulated.TABLE, fit=False))
    show_stiffness(panels[2], folder / simulated.MOVED)
    figure.supxlabel("Simulated recordings", x=0.005, ha="left", size=8, color=GREY)
    return figure


def show_trials(ax: Axes, folder: Path) -> None:
    """The steady parts of one person's trials in both conditions, and the variation of each."""
    for row, (condition, colour) in enumerate(COLOURS.items()):
        names = [folder / f"{PERSON}_{condition}_{i + 1}.csv" for i in range(simulated.TRIALS)]
        trials = jm.load_recordings(names).steady()
        for i, trial in enumerate(trials):
            x = trial.filtered()
            level = -APART * (simulated.TRIALS * row + i + 0.6 * row)
            time = np.arange(x.size) * trial.duration / x.size
            ax.plot(time, 100 * (x / x.mean() - 1) + level, color=colour, lw=0.8)
        found = jm.data.steadiness(trials)["coefficient_of_variation"]
        low, high = (100 * edge for edge in found.interval)
        words = f"{condition}: CV {100 * found.value:.1f} % ({low:.1f} to {high:.1f})"
        top = -APART * (simulated.TRIALS + 0.6) * row + 0.8 * APART
        ax.text(0, top, words, color=colour, va="center", weight="bold")
    ax.plot([14.6, 14.6], [-2.5, 2.5], color="black", lw=1.5)
    ax.text(14.9, 0, "5 %", va="center")
    ax.set(title="Three trials of one person, twice", xlabel="Time in the hold (s)", yticks=[])
    ax.spines.left.set_visible(False)
    ax.margins(x=0.01)
    ax.set_ylim(top=1.4 * APART)


def show_spectra(ax: Axes, study: Any) -> None:
    """Power over the squared mean of every person (thin), geometric means (thick), peaks."""
    for condition, colour in COLOURS.items():
        rows = []
        for cell in study.cells:
            if cell.condition != condition:
                continue
            target = cell.target
            rows.append(1e6 * target.trial_power.mean(axis=0) / np.mean(target.mean) ** 2)
            ax.loglog(target.frequency, rows[-1], color=colour, lw=0.5, alpha=0.5)
            peak = target.measured["tremor_frequency"].value
            if np.isfinite(peak):
                height = np.interp(peak, target.frequency, rows[-1])
                ax.plot(peak, 1.25 * height, marker="v", ms=4, color=colour)
        f, mean = target.frequency, np.exp(np.log(rows).mean(axis=0))
        ax.plot(f, mean, color=colour, lw=2, label=f"{condition}, {len(rows)} people")
    ax.plot([], [], marker="v", ms=4, ls="", color=GREY, label="tremor found in a person")
    ax.set(title="Spectra of a study", xlabel="Frequency (Hz)")
    ax.set_ylabel("Power (1e-6 mean²/Hz)")
    ax.set_xticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
    ax.set_xticks([], minor=True)
    ax.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    ax.legend(loc="lower left")


def show_stiffness(ax: Axes, path: Path) -> None:
    """Real and imaginary part of force over displacement, and K, B, I with their errors."""
    recording = jm.load_recording(path, **jm.data.two_channels(path)).steady()
    response, found = recording.frequency_response(), recording.second_order()
    f = np.linspace(0, 12.0, 200)
    s = 2j * np.pi * f
    line = found["K"].value + found["B"].value * s + found["I"].value * s**2
    known = 2 * response.stderr < response.gain
    for part, colour, name in (
        (np.real, jm.plot.BLUE, "in phase: K - Iω²"),
        (np.imag, jm.plot.GREEN, "a quarter ahead: Bω"),
    ):
        ax.plot(f, part(line), color=colour, lw=1.2)
        ax.errorbar(
            response.frequency[known],
            part(response.value)[known],
            2 * response.stderr[known],
            fmt="o",
            ms=3,
            lw=0.8,
            color=colour,
            label=name,
        )
    words = "\n".join(
        f"{name} = {m.value:.{digits}f} ± {m.stderr:.{digits}f} {m.unit}"
        for (name, m), digits in zip(found.items(), (0, 1, 2), strict=True)
    )
    ax.text(0.04, 0.03, words, transform=ax.transAxes, va="bottom", ha="left")
    ax.set(title="A limb that a motor moves", xlabel="Frequency (Hz)", xlim=(0, 13))
    ax.set_ylabel("Force over displacement (N/m)")
    ax.set_ylim(-1700, 2300)
    ax.legend(loc="upper left", ncols=1)


def main() -> None:
    from gallery import DPI, few_colours
    from PIL import Image

    with tempfile.TemporaryDirectory() as name:
        simulated.write_demo(Path(name), "")
        draw(Path(name)).savefig(PICTURE, dpi=1.5 * DPI)
    few_colours(Image.open(PICTURE).convert("RGB")).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
