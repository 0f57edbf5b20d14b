"""Every error that jaxmuscle raises of its own: light to import."""


class PresetError(ValueError):
    """A preset that is unknown or cannot be read; the message names it and the remedy."""


class TargetError(ValueError):
    """A target that cannot be used; the message names the file, the line or key, and the remedy."""


class SimulationError(RuntimeError):
    """A trajectory did not stay finite; the message names seeds and parameters."""


class OperatingPointError(ValueError):
    """A task has no usable equilibrium."""


class FirstOrderWarning(UserWarning):
    """The perturbations of a task are so large that its simulation may give other numbers than the
    linear response.

    See docs/model.md, *Where first order ends*.
    """


class StoreError(ValueError):
    """A store that is there already, cannot be resumed, or cannot be written; the message says what
    to do."""


class NotMixedError(RuntimeError):
    """Chains that did not mix have no summary; the message says what to do."""


class ResultError(ValueError):
    """A file that is not a fit result; the message names it and the reason."""


class WorkersLostError(RuntimeError):
    """The workers of an executor, or their scheduler, are lost."""
