"""The paper's figures, Figure 2 to Figure 8, as PNG and PDF."""

from collections.abc import Callable, Iterable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmuscle._common.files import replacing
from jaxmuscle.plot._style import BLUE, GREEN, GREY, PALETTE, VERMILLION, ink, log_axis, styled
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import WINDOW
from jaxmuscle.spectra._welch import Spectrum

from ._numbers import Experiment, Reproduction, Tuned
from ._readings import HIGH, LOW, Reading

SIZE = (4.2, 2.9)  # inches: letters of 8 points are 10 pixels high on a phone of 390
DPI = 200
PROPORTIONAL = "Proportional power"


def draw(found: Reproduction, out: Path) -> None:
    """Write all figures into a folder."""
    for name, make in FIGURES.items():
        save(make(found), out / name)


@styled
def save(figure: Figure, path: Path) -> None:
    """PNG and PDF, and close the figure."""
    for suffix in (".png", ".pdf"):
        with replacing(path.with_suffix(suffix)) as temporary:
            figure.savefig(
                temporary, dpi=DPI, metadata={"CreationDate": None} if suffix == ".pdf" else None
            )
    plt.close(figure)


def _panels(rows: int, columns: int = 1, height: float = SIZE[1]) -> tuple[Figure, np.ndarray]:
    figure, axes = plt.subplots(
        rows, columns, figsize=(SIZE[0], height), layout="constrained", squeeze=False
    )
    return figure, axes


def slow(
    samples: Float[np.ndarray, " times"], rate: float, cutoff: float
) -> Float[np.ndarray, " times"]:
    """What is slower than `cutoff` [Hz], without delay."""
    return scipy.signal.sosfiltfilt(scipy.signal.butter(4, cutoff, fs=rate, output="sos"), samples)


def _run(run: Trajectory, quantity: str, cutoff: float, words: str) -> Figure:
    """The whole run over the mean of its held part, and the held part close up."""
    figure, axes = _panels(2, height=3.9)
    x, held = np.atleast_2d(np.asarray(run.output))[0], np.atleast_2d(np.asarray(run.between()))[0]
    whole, near = axes[:, 0]
    whole.plot(run.time, x / held.mean(), color=BLUE, lw=1.0)
    whole.axvspan(*WINDOW, color="0.93", lw=0, zorder=0)
    whole.text(
        WINDOW[1] - 0.1,
        0.05,
        "analysed",
        ha="right",
        va="bottom",
        color=GREY,
        transform=whole.get_xaxis_transform(),
    )
    whole.set_xlim(0, WINDOW[1])
    whole.set_xlabel("Time (s)")
    whole.set_ylabel(f"{quantity} / mean")
    time = WINDOW[0] + np.arange(held.size) / run.rate
    percent = 100 * (held / held.mean() - 1)
    near.plot(time, percent, color=BLUE, lw=0.6, alpha=0.6, label="100 samples/s")
    near.plot(time, slow(percent, run.rate, cutoff), color=VERMILLION, lw=1.4, label=words)
    near.set_xlim(*WINDOW)
    near.set_ylim(top=near.get_ylim()[1] + 0.25 * np.ptp(percent))
    near.legend(loc="upper right", ncols=2)
    near.set_xlabel("Time (s)")
    near.set_ylabel("Deviation from mean (%)")
    return figure


def _seed_band(ax: Axes, tuned: Tuned, *, absolute: bool) -> None:
    power = np.asarray(tuned.force.spectrum().power)
    rows = power if absolute else power / power.sum(1, keepdims=True)
    low, high = np.quantile(rows, [0.05, 0.95], axis=0)
    ax.fill_between(
        tuned.spectrum.frequency,
        low,
        high,
        color=BLUE,
        alpha=0.18,
        lw=0,
        label="5 to 95 % of single runs",
    )


def _mark_peaks(
    ax: Axes, spectrum: Spectrum, values: Float[np.ndarray, " bins"], *, log: bool = False
) -> None:
    """Arrows at the maximum and the local maxima, with their bins."""
    found = peaks(spectrum)
    for peak in dict.fromkeys((found.maximum, *found.local_maxima)):
        at = int(np.argmin(np.abs(spectrum.frequency - peak.frequency)))
        shift = (18, 8) if not log else (12, 8)
        ax.annotate(
            f"{peak.frequency:.3f} Hz",
            (peak.frequency, values[at]),
            shift,
            textcoords="offset points",
            fontsize=7.5,
            arrowprops={"arrowstyle": "-", "lw": 0.6, "shrinkB": 3},
        )


def _stated(ax: Axes) -> None:
    for f in (LOW, HIGH):
        ax.axvline(
            f,
            color=GREY,
            lw=0.7,
            ls=":",
            label="stated: 0.391, 4.251 Hz" if f == LOW else None,
            zorder=0,
        )


def _spectrum(
    spectrum: Spectrum, colour: str, *, log: bool, tuned: Tuned | None = None, stated: bool = True
) -> Figure:
    """Proportional power, linear or with both axes logarithmic."""
    figure, axes = _panels(1)
    ax = axes[0, 0]
    p = np.asarray(spectrum.power) / np.sum(spectrum.power)
    if tuned is not None:
        _seed_band(ax, tuned, absolute=False)
    ax.plot(
        spectrum.frequency,
        p,
        color=colour,
        marker="o",
        ms=2.8,
        lw=1.2,
        label="expected (mean over runs)",
    )
    if stated:
        _stated(ax)
    _mark_peaks(ax, spectrum, p, log=log)
    _frequency(ax, log)
    ax.set_ylabel(f"{PROPORTIONAL} (per bin)")
    ax.legend(loc="lower left" if log else "upper right")
    return figure


def _frequency(ax: Axes, log: bool) -> None:
    ax.set_xlabel("Frequency (Hz)")
    if not log:
        ax.set_xlim(0, 12)
        ax.set_ylim(bottom=0)
        return
    ax.set_xscale("log")
    log_axis(ax, "y")
    ax.set_xticks([0.4, 1, 2, 4, 10], ["0.4", "1", "2", "4", "10"])
    ax.set_xticks([], minor=True)


@styled
def fig2(found: Reproduction) -> Figure:
    """Normalised force, tuned to [30]."""
    return _run(found.slifkin.force, r"Force $P_\mathrm{w}$", 6.0, "below 6 Hz")


@styled
def fig3(found: Reproduction) -> Figure:
    """Absolute force spectrum."""
    figure, axes = _panels(1)
    ax, spectrum = axes[0, 0], found.slifkin.spectrum
    _seed_band(ax, found.slifkin, absolute=True)
    power = np.asarray(spectrum.power)
    ax.plot(
        spectrum.frequency,
        power,
        color=BLUE,
        marker="o",
        ms=2.8,
        lw=1.2,
        label="expected (mean over runs)",
    )
    _stated(ax)
    _mark_peaks(ax, spectrum, power)
    _frequency(ax, log=False)
    ax.set_ylabel("Power of the force (N²/Hz)")
    ax.legend(loc="upper right")
    return figure


@styled
def fig4a(found: Reproduction) -> Figure:
    """Proportional force power."""
    return _spectrum(found.slifkin.spectrum, BLUE, log=False, tuned=found.slifkin)


@styled
def fig4b(found: Reproduction) -> Figure:
    """The same, logarithmic."""
    return _spectrum(found.slifkin.spectrum, BLUE, log=True, tuned=found.slifkin)


@styled
def fig5(found: Reproduction) -> Figure:
    """Normalised displacement at constant force."""
    return _run(found.slifkin.displacement, r"Displacement $x_\mathrm{z}$", 6.0, "below 6 Hz")


@styled
def fig6a(found: Reproduction) -> Figure:
    """Normalised force, tuned to [12]."""
    return _run(found.hamilton.force, r"Force $P_\mathrm{w}$", 2.0, "below 2 Hz")


@styled
def fig6b(found: Reproduction) -> Figure:
    """Displacement spectrum, tuned to [12]."""
    return _spectrum(found.hamilton.moved, GREEN, log=False)


def _source(experiment: Experiment) -> str:
    return "Simulated recordings" if experiment.simulated else "Your recordings"


@styled
def fig7(found: Reproduction) -> Figure:
    """FFT above Welch."""
    people = found.experiment
    figure, axes = _panels(2, height=4.6)
    for ax, spectra, title in zip(
        axes[:, 0], (people.fft, people.welch), ("FFT", "Welch"), strict=True
    ):
        for colour, spectrum, recording in zip(PALETTE, spectra, people.recordings, strict=False):
            p = np.asarray(spectrum.power) / np.sum(spectrum.power)
            ax.plot(
                spectrum.frequency,
                p,
                color=colour,
                lw=0.6 if title == "FFT" else 1.3,
                alpha=0.8,
                label=recording.name,
            )
        step = float(np.diff(spectra[0].frequency)[0])
        ax.set_title(f"{_source(people)}: {title}, {step:.4f} Hz")
        _frequency(ax, log=True)
        ax.set_ylabel(f"{PROPORTIONAL} (per bin)")
    axes[1, 0].legend(loc="lower left")
    return figure


@styled
def fig8(found: Reproduction) -> Figure:
    """One person's power against another's, and the Spearman correlation."""
    people = found.experiment
    figure, axes = _panels(3, 2, height=6.2)
    # tick labels stand beyond the ends of equal axes
    figure.set_layout_engine("constrained", w_pad=0.12)
    kinds = (("FFT", people.fft, people.rho_fft), ("Welch", people.welch, people.rho_welch))
    for column, (title, spectra, rho) in zip(axes.T, kinds, strict=True):
        for ax, (i, j), value in zip(column, people.pairs, rho, strict=True):
            x, y = (np.asarray(spectra[k].power) / np.sum(spectra[k].power) for k in (i, j))
            ax.loglog(
                x,
                y,
                ".",
                color=BLUE,
                ms=2.0 if title == "FFT" else 4.0,
                alpha=0.5 if title == "FFT" else 1.0,
            )
            ends = [min(x.min(), y.min()), max(x.max(), y.max())]
            ax.plot(ends, ends, color=ink(), lw=0.6)
            ax.set_title(f"{title}: ρ = {value:.3f}", fontweight="normal")
            ax.set_aspect("equal", adjustable="datalim")
            _decades(ax, ends)
            ax.set_xlabel(f"person {i + 1}")
            ax.set_ylabel(f"person {j + 1}")
    figure.suptitle(
        f"{_source(people)}: {PROPORTIONAL.lower()} of two people", x=0.01, ha="left", fontsize=8
    )
    return figure


def _decades(ax: Axes, ends: list[float]) -> None:
    """At most three ticks at powers of ten."""
    low, high = np.floor(np.log10(ends[0])), np.ceil(np.log10(ends[1]))
    ticks = 10.0 ** np.arange(low, high + 1, max(1, np.ceil((high - low) / 3)))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_ticks(ticks)
        axis.set_ticks([], minor=True)


@styled
def readings(found: Reproduction) -> Figure:
    """Force and proportional power of the three readings."""
    return _readings(found.readings)


def _readings(found: Iterable[Reading]) -> Figure:
    shown = tuple(found)
    figure, axes = _panels(len(shown), 2, height=1.45 * len(shown))
    for (left, right), reading in zip(axes, shown, strict=True):
        percent = 100 * (reading.force / reading.force.mean() - 1)
        left.plot(WINDOW[0] + np.arange(percent.size) / 100, percent, color=BLUE, lw=0.5)
        left.set_xlim(*WINDOW)
        left.set_ylabel("Force (%)")
        left.set_title(reading.key)
        right.set_title("proportional", fontweight="normal")
        p = np.asarray(reading.spectrum.power) / np.sum(reading.spectrum.power)
        right.plot(reading.spectrum.frequency, p, color=BLUE, marker="o", ms=2.2, lw=1.0)
        _stated(right)
        right.set_xlim(0, 12)
        right.set_ylim(bottom=0)
        right.set_ylabel("Power")
    axes[-1, 0].set_xlabel("Time (s)")
    axes[-1, 1].set_xlabel("Frequency (Hz)")
    return figure


FIGURES: dict[str, Callable[[Reproduction], Figure]] = {
    "fig2": fig2,
    "fig3": fig3,
    "fig4a": fig4a,
    "fig4b": fig4b,
    "fig5": fig5,
    "fig6a": fig6a,
    "fig6b": fig6b,
    "fig7": fig7,
    "fig8": fig8,
    "readings": readings,
}
