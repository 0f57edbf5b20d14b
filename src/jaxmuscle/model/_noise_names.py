"""All noises by name."""

from typing import Any

import equinox as eqx
import numpy as np

from jaxmuscle._common.text import choices

from ._noise import AbstractNoise
from ._pink_noise import PinkNoise
from ._white_noise import BandLimitedNoise, OrnsteinUhlenbeckNoise, WhiteNoise

NOISES: dict[str, type[AbstractNoise]] = {
    "white": WhiteNoise,
    "band-limited": BandLimitedNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckNoise,
    "pink": PinkNoise,
}


def made_by_name(name: Any) -> AbstractNoise:
    """The noise of that name at its default amplitudes. Raises `ValueError` for another name."""
    if not isinstance(name, str) or name not in NOISES:
        raise ValueError(f"noise = {name!r}: {choices(name, NOISES)}")
    kind: Any = NOISES[name]
    return kind().per_channel()


def named_noise(name: str, needed: tuple[int, ...]) -> AbstractNoise:
    """The noise of that name at its default amplitudes on the channels that a task can have it on,
    0 on the others.

    `needed`: the smoothness that each channel needs there. If no channel can have it, none is left
    out: the task says why.
    """
    made = made_by_name(name)
    amplitude = np.asarray(made.amplitude)
    smooth = np.array([needed[i] for i in made.acts_on]) <= made.smoothness
    return (
        eqx.tree_at(lambda n: n.amplitude, made, np.where(smooth, amplitude, 0.0))
        if smooth.any()
        else made
    )
