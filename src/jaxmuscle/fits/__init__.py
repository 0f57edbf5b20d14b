"""Fits of one target, of several targets together and of a cohort. Steps are made in `objective`,
what a fit prints is written in `reports`.

One fit goes through these files:

    _fit, _joint, _cohort        what is asked for; a moved record through _perturbed first
    _model_choice <-> _search    one model after the other; starts, descent, correction (_stages)
    _verdict                     does it describe the data? with _refit, _intervals, _signal_checks
    _report                      numbers with their errors; _checks says what looks wrong
    _result                      FitResult and its file

_study and _differences compare people; _reopened makes the problem of a result again; _own_problem
is a fit for another optimiser.

Words: a *rung* is a model, by how rich it is; a *part* what a fit has for each target; the *line*
the sharp peak of the harmonic in a spectrum; a *stage* a descent of the search; *seen* what the
model gives at a point.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
