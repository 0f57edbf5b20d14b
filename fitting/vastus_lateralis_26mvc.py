"""Knee-extension force at 26 % MVC, measured: one person, 12 Welch segments."""

import jaxmuscle as jm
from common import arguments, load, report

NAME = "vastus-lateralis-26mvc"


def fit(target: jm.Target, seed: int = 0) -> jm.fits.FitResult:
    """All default parameters free, band-limited noise."""
    return jm.fit(target.task(), target, key=seed)


if __name__ == "__main__":
    options = arguments(__doc__ or "", csv=False)
    report(fit(load(NAME, options), options.seed), NAME, options.out)
