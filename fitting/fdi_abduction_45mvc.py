"""Index-finger abduction force at 45 % MVC, measured: mean of two people, 4 Welch segments in
all."""

import jaxmuscle as jm
from common import arguments, load, report

NAME = "fdi-abduction-45mvc"


def fit(target: jm.Target, seed: int = 0) -> jm.fits.FitResult:
    """All default parameters free, band-limited noise."""
    return jm.fit(target.task(), target, key=seed)


if __name__ == "__main__":
    options = arguments(__doc__ or "", csv=False)
    report(fit(load(NAME, options), options.seed), NAME, options.out)
