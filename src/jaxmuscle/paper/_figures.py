"""The paper's figures, Figure 2 to Figure 8, as PNG and PDF."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxmuscle._common.files import replacing
from jaxmuscle.plot._style import (
    BLUE,
    GREEN,
    GREY,
    PALETTE,
    VERMILLION,
    Style,
    ink,
    log_axis,
    styled,
)
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import WINDOW
from jaxmuscle.spectra._welch import Spectrum

from ._numbers import Experiment, Reproduction, Tuned
from ._readings import HIGH, LOW, Reading

SIZE = (4.2, 2.9)  # inches: letters of 8 points are 10 pixels high on a phone of 390
DPI = 200
PROPORTIONAL = "Proportional power"
PER_BIN = f"{PROPORTIONAL} (per bin)"
SIMULATED = "Simulated recordings"
FORCE = r"Force $P_\mathrm{w}$"
Times = Float[np.ndarray, " times"]


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
    size = SIZE[0], height
    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)


def slow(samples: Times, rate: float, cutoff: float) -> Times:
    """What is slower than `cutoff` [Hz], without delay."""
    return scipy.signal.sosfiltfilt(scipy.signal.butter(4, cutoff, fs=rate, output="sos"), samples)


def _run(run: Trajectory, quantity: str, cutoff: float) -> Figure:
    """The whole run over the mean of its held part, and the held part close up."""
    figure, axes = _panels(2, height=3.9)
    x, held = (np.atleast_2d(np.asarray(rows))[0] for rows in (run.output, run.between()))
    whole, near = axes[:, 0]
    whole.plot(run.time, x / held.mean(), color=BLUE, lw=1.0)
    whole.axvspan(*WINDOW, color="0.93", lw=0, zorder=0)
    style: Style = {"color": GREY, "transform": whole.get_xaxis_transform()}
    whole.text(WINDOW[1] - 0.1, 0.05, "analysed", ha="right", va="bottom", **style)
    time, percent = WINDOW[0] + np.arange(held.size) / run.rate, 100 * (held / held.mean() - 1)
    near.plot(time, percent, color=BLUE, lw=0.6, alpha=0.6, label="100 samples/s")
    below, label = slow(percent, run.rate, cutoff), f"below {cutoff:g} Hz"
    near.plot(time, below, color=VERMILLION, lw=1.4, label=label)
    near.set_ylim(top=near.get_ylim()[1] + 0.25 * np.ptp(percent))
    near.legend(loc="upper right", ncols=2)
    whole.set(xlim=(0, WINDOW[1]), xlabel="Time (s)", ylabel=f"{quantity} / mean")
    near.set(xlim=WINDOW, xlabel="Time (s)", ylabel="Deviation from mean (%)")
    return figure


def _mark_peaks(
    ax: Axes, spectrum: Spectrum, values: Float[np.ndarray, " bins"], *, log: bool = False
) -> None:
    """Arrows at the maximum and the local maxima, with their bins."""
    found = peaks(spectrum)
    for peak in dict.fromkeys((found.maximum, *found.local_maxima)):
        f = peak.frequency
        ax.annotate(
            f"{f:.3f} Hz",
            (f, values[np.argmin(np.abs(spectrum.frequency - f))]),
            (12 if log else 18, 8),
            textcoords="offset points",
            fontsize=7.5,
            arrowprops={"arrowstyle": "-", "lw": 0.6, "shrinkB": 3},
        )


def _stated(ax: Axes) -> None:
    for f, label in ((LOW, "stated: 0.391, 4.251 Hz"), (HIGH, None)):
        ax.axvline(f, color=GREY, lw=0.7, ls=":", label=label, zorder=0)


def _spectrum(
    spectrum: Spectrum,
    colour: str,
    *,
    log: bool = False,
    tuned: Tuned | None = None,
    ordinate: str = PER_BIN,
) -> Figure:
    """Proportional power (or what the ordinate says), linear or with both axes logarithmic; with
    the band of single runs of a preset."""
    figure, ((ax,),) = _panels(1)
    absolute = ordinate != PER_BIN
    values = np.asarray(spectrum.power if absolute else spectrum.proportional)
    if tuned is not None:
        each = tuned.force.spectrum()
        rows = np.asarray(each.power if absolute else each.proportional)
        band = np.quantile(rows, [0.05, 0.95], axis=0)
        label = "5 to 95 % of single runs"
        ax.fill_between(spectrum.frequency, *band, color=BLUE, alpha=0.18, lw=0, label=label)
    style: Style = {"color": colour, "marker": "o", "ms": 2.8, "lw": 1.2}
    ax.plot(spectrum.frequency, values, label="expected (mean over runs)", **style)
    _stated(ax)
    _mark_peaks(ax, spectrum, values, log=log)
    _frequency(ax, log)
    ax.set_ylabel(ordinate)
    ax.legend(loc="lower left" if log else "upper right")
    return figure


def _frequency(ax: Axes, log: bool) -> None:
    ax.set_xlabel("Frequency (Hz)")
    if not log:
        ax.set(xlim=(0, 12), ylim=(0, None))
        return
    ax.set_xscale("log")
    log_axis(ax, "y")
    ax.set_xticks([0.4, 1, 2, 4, 10], ["0.4", "1", "2", "4", "10"])
    ax.set_xticks([], minor=True)


def _fft_and_welch(people: Experiment) -> Figure:
    """FFT above Welch."""
    figure, axes = _panels(2, height=4.6)
    for ax, spectra, title, width in (
        (axes[0, 0], people.fft, "FFT", 0.6),
        (axes[1, 0], people.welch, "Welch", 1.3),
    ):
        for colour, spectrum, recording in zip(PALETTE, spectra, people.recordings, strict=False):
            style: Style = {"color": colour, "lw": width, "alpha": 0.8, "label": recording.name}
            ax.plot(spectrum.frequency, spectrum.proportional, **style)
        step = float(np.diff(spectra[0].frequency)[0])
        ax.set_title(f"{SIMULATED}: {title}, {step:.4f} Hz")
        _frequency(ax, log=True)
        ax.set_ylabel(PER_BIN)
    axes[1, 0].legend(loc="lower left")
    return figure


def _pairs(people: Experiment) -> Figure:
    """One person's power against another's, and the Spearman correlation."""
    figure, axes = _panels(3, 2, height=6.2)
    # tick labels stand beyond the ends of equal axes
    figure.set_layout_engine("constrained", w_pad=0.12)
    for column, title, spectra, rho, style in (
        (axes[:, 0], "FFT", people.fft, people.rho_fft, {"ms": 2.0, "alpha": 0.5}),
        (axes[:, 1], "Welch", people.welch, people.rho_welch, {"ms": 4.0}),
    ):
        for ax, (i, j), value in zip(column, people.pairs, rho, strict=True):
            both = np.stack([spectra[i].proportional, spectra[j].proportional])
            ends = [both.min(), both.max()]
            ax.loglog(*both, ".", color=BLUE, **style)
            ax.plot(ends, ends, color=ink(), lw=0.6)
            ax.set_title(f"{title}: ρ = {value:.3f}", fontweight="normal")
            ax.set_aspect("equal", adjustable="datalim")
            _decades(ax, ends)
            ax.set(xlabel=f"person {i + 1}", ylabel=f"person {j + 1}")
    words = f"{SIMULATED}: {PROPORTIONAL.lower()} of two people"
    figure.suptitle(words, x=0.01, ha="left", fontsize=8)
    return figure


def _decades(ax: Axes, ends: list[float]) -> None:
    """At most three ticks at powers of ten."""
    low, high = np.floor(np.log10(ends[0])), np.ceil(np.log10(ends[1]))
    ticks = 10.0 ** np.arange(low, high + 1, max(1, np.ceil((high - low) / 3)))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_ticks(ticks)
        axis.set_ticks([], minor=True)


def _readings(found: Sequence[Reading]) -> Figure:
    """Force and proportional power of the readings."""
    figure, axes = _panels(len(found), 2, height=1.45 * len(found))
    for (left, right), reading in zip(axes, found, strict=True):
        percent = 100 * (reading.force / reading.force.mean() - 1)
        left.plot(WINDOW[0] + np.arange(percent.size) / 100, percent, color=BLUE, lw=0.5)
        left.set(xlim=WINDOW, ylabel="Force (%)", title=reading.key)
        spectrum = reading.spectrum
        style: Style = {"color": BLUE, "marker": "o", "ms": 2.2, "lw": 1.0}
        right.plot(spectrum.frequency, spectrum.proportional, **style)
        _stated(right)
        right.set(xlim=(0, 12), ylim=(0, None), ylabel="Power")
        right.set_title("proportional", fontweight="normal")
    axes[-1, 0].set_xlabel("Time (s)")
    axes[-1, 1].set_xlabel("Frequency (Hz)")
    return figure


FIGURES: dict[str, Callable[[Reproduction], Figure]] = {
    name: styled(make)
    for name, make in {
        "fig2": lambda r: _run(r.slifkin.force, FORCE, 6.0),
        "fig3": lambda r: _spectrum(
            r.slifkin.spectrum, BLUE, tuned=r.slifkin, ordinate="Power of the force (N²/Hz)"
        ),
        "fig4a": lambda r: _spectrum(r.slifkin.spectrum, BLUE, tuned=r.slifkin),
        "fig4b": lambda r: _spectrum(r.slifkin.spectrum, BLUE, log=True, tuned=r.slifkin),
        "fig5": lambda r: _run(r.slifkin.displacement, r"Displacement $x_\mathrm{z}$", 6.0),
        "fig6a": lambda r: _run(r.hamilton.force, FORCE, 2.0),
        "fig6b": lambda r: _spectrum(r.hamilton.moved, GREEN),
        "fig7": lambda r: _fft_and_welch(r.experiment),
        "fig8": lambda r: _pairs(r.experiment),
        "readings": lambda r: _readings(r.readings),
    }.items()
}
