"""The models that a fit tries one after the other."""

from ._activation import Activation
from ._parameters import default
from ._resonant_noise import ResonantNoise
from ._tasks import AbstractTask, PrescribedLength

SLOW, TWITCH, LINE, RESONANCE = "slow part", "twitch", "regular rhythm", "resonance"
REFLEX = "stretch reflex"
# as `model_name` calls what `on_rung` makes
RUNGS = (
    f"{SLOW} + {LINE}",
    f"{SLOW} + {TWITCH} + {LINE}",
    f"{SLOW} + {TWITCH} + {RESONANCE}",
    f"{SLOW} + {TWITCH} + two {RESONANCE}s",
)
# what a comparison calls them, with the task's own noise
RICHER = {"activation": 1, "resonance": 2, "two resonances": 3}
QUIET = -1  # below the base model, without a rhythm


def rung_name(rung: int) -> str:
    """A model of the ladder in words."""
    return f"{SLOW} alone" if rung == QUIET else RUNGS[rung]


def model_name(task: AbstractTask) -> str:
    """What the force of a task is made of, in words: the muscle's answer to its noise (the slow
    part), the twitch of an activation, a harmonic (a regular rhythm), resonances."""
    count = sum(isinstance(noise, ResonantNoise) for noise in task.noise.components)
    parts = [SLOW, *[TWITCH] * (task.activation is not None)]
    parts += [LINE] * (float(task.harmonic.amplitude) != 0)
    parts += [REFLEX] * (isinstance(task, PrescribedLength) and task.reflex is not None)
    parts += [RESONANCE, f"two {RESONANCE}s"][count - 1 : count] if count else []
    return " + ".join(parts) if len(parts) > 1 else f"{SLOW} alone"


def on_rung(task: AbstractTask, rung: int) -> AbstractTask:
    """The task with what measured force asks for beyond the base model, by `rung`:

        task = jm.model.on_rung(jm.Isometric(), 2)  # slow part + twitch + resonance
        task["resonance_frequency"]

    0, as it is; 1, with an `Activation` between the nervous drive and the active tissue; 2, with a
    `ResonantNoise` on the drive as well instead of the harmonic; 3, with a second
    resonance. Each begins at the default of the parameter table.

    **Raises:** `ValueError` for other rungs, and for a task that has an activation or a resonance
    already.
    """
    if rung not in range(len(RUNGS)):
        raise ValueError(f"rung = {rung} must be one of 0 to {len(RUNGS) - 1}")
    if not is_base(task):
        raise ValueError(
            "this task has an activation or a resonance already: start from one without"
        )
    if rung >= 1:
        task = task.with_parts(activation=Activation())
    for which in ("resonance", "resonance_2")[: max(rung - 1, 0)]:
        values = (default(f"{which}_{what}") for what in ("amplitude", "frequency", "width"))
        task = task.with_parts(noise=task.noise + ResonantNoise(*values))
    return task.replace(harmonic_amplitude=0.0) if rung >= 2 else task


def is_base(task: AbstractTask) -> bool:
    """Whether a task has neither activation nor resonance."""
    return task.activation is None and not any(
        isinstance(noise, ResonantNoise) for noise in task.noise.components
    )
