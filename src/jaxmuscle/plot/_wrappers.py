"""Figures that are drawn elsewhere, under their public names."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure


def estimate(estimate: Any, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws the proportional power of a `SpectrumEstimate`, with two standard errors either way, and without control.

    **Arguments:** `estimate`; `ax`, or a new figure; `log`, both axes logarithmic. **Returns:** the axes.
    """
    from ._spectra import draw

    return draw(estimate, ax, log)


def moments(summary: Any, ax: Axes | None = None, point: int = 0) -> Axes:
    """Draws the mean of a reduced ensemble over time, and the bands between its outer quantiles.

    **Arguments:** `summary`, an `EnsembleSummary`; `ax`, or a new figure; `point` of a sweep. **Returns:** the axes.
    """
    from ._moments import draw

    return draw(summary, ax, point)


def fit(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws what a fit found: spectra linear and logarithmic, residuals, simulated output and parameters.

    The band around the target is that of `target`. Residuals are in standard deviations of the log power, positive
    where the target is above the fit. Parameters that were not fitted are left out of the table, and those that the
    data do not determine are marked.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, its place. **Returns:** the figure.
    """
    from ._fit import figure

    return figure(result, ax)


def sensitivity(sensitivity: Any, ax: Axes | None = None) -> Axes:
    """Draws how proportional power answers to the parameters as a heat map, parameters that do nothing left out.

    **Arguments:** `sensitivity`; `ax`, or a new figure high enough for the parameters. **Returns:** the axes.
    """
    from ._sensitivity import draw

    return draw(sensitivity, ax)


def profile(profile: Any, ax: Axes | None = None) -> Axes:
    """Draws a profile likelihood with its interval and the parabola of the curvature. Returns the axes (`ax` or new)."""
    from ._profile import draw

    return draw(profile, ax)


def posterior(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the posterior `found` of what the data determine: densities, and 50, 80 and 95 % regions of pairs.

    **Raises:** `NotMixedError` if the chains did not mix; `ValueError` if the data determine nothing.
    """
    from ._posterior import corner

    return corner(found, ax)


def chains(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws every chain of the posterior `found` over its draws, also of chains that did not mix."""
    from ._posterior import traces

    return traces(found, ax)


def predictive(found: Any, ax: Axes | None = None) -> Axes:
    """Draws the target among spectra that the posterior `found` predicts. **Raises:** `NotMixedError`."""
    from ._posterior import predictive

    return predictive(found, ax)


def comparison(comparison: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the best fit of each noise, AIC and held-out score of every model, and says whether they can be told apart."""
    from ._comparison import figure

    return figure(comparison, ax)


def identifiability(report: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws singular values and standard errors, now and with each further measurement."""
    from ._identifiability import figure

    return figure(report, ax)


def goodness(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws residuals with what is usual in each bin, and the three checks with their reference distributions."""
    from ._checks import goodness_figure

    return goodness_figure(found, ax)


def bootstrap(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the refits of every quantity, the value they were made from and the interval that the fit states.

    **Raises:** `ValueError` if fewer than two refits succeeded.
    """
    from ._checks import bootstrap_figure

    return bootstrap_figure(found, ax)


def joint(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a joint fit: spectrum, fit and residuals of each target, and what they determine together."""
    from ._joint import figure

    return figure(result, ax)


def cohort(cohort: Any, by: str = "person", ax: Axes | None = None) -> Figure | SubFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level" (fraction of MVC).

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    from ._cohort import figure

    return figure(cohort, by, ax)


def recording(recording: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a recording: the trace with its window, and its spectra (Welch, FFT), linear and logarithmic."""
    from ._recording import figure

    return figure(recording, settings, ax)


def static(curves: Any, ax: Any = None) -> tuple[Axes, Axes, Axes]:
    """Draws K(x), C(v) and force against displacement, in three axes (`ax`: three of yours). Returns the axes.

    **Raises:** `ValueError` unless `ax` has three.
    """
    return curves.plot(ax)
