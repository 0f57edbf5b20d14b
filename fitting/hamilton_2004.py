"""Hamilton, Jones & Wolpert (2004): reconstructed from the text, or your own digitised figure."""

import jaxmuscle as jm
from common import arguments, load, report

NAME = "hamilton-2004"


def fit(target: jm.Target, seed: int = 0) -> jm.fits.FitResult:
    """All default parameters free, band-limited noise."""
    return jm.fit(target.task(), target, key=seed, rungs=0)  # the model of the paper


if __name__ == "__main__":
    options = arguments(__doc__ or "", csv=True)
    report(fit(load(NAME, options), options.seed), NAME, options.out)
