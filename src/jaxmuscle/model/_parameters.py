"""The one table of parameters: symbol, unit, default, bounds, prior and source; and how a name
finds its value."""

import collections
import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxmuscle._common.arrays import _is_scalar, as_inexact, checked, is_concrete, require
from jaxmuscle._common.text import choices

_HAND = (
    "about the mass of a hand, 0.6 % of body mass (Winter 2009, Biomechanics, table 4.1); allows"
    " large time steps"
)
_STIFF = (
    "K_0 = k x_ref^2 = 200 N/m, about the postural stiffness of a hand (Mussa-Ivaldi et al. 1985)"
)
_DAMP = (
    "no measured damping: C_0 = c v_ref^2 of both tissues was chosen so that the slow eigenvalue of"
    " isometric force, -9.6/s (1.5 Hz), is near the corner of force spectra (fits of the measured"
    " ones: 0.4 and 0.9 Hz)"
)
_REF = "sets the range over which the muscle is linear: displacements here are about 0.01 m"
_REF_V = "sets the range over which the muscle is linear: velocities in a hold are far below 1 m/s"
_HUMAN = "coefficient of variation of isometric force near 1 %, as people show"
_PAPER_K = f"{_HUMAN}; the paper has 0.16 % of the initial stiffness coefficient"
_PAPER_C = "the paper: 0.01 % of the initial damping coefficient"
_TWITCH = (
    "twitch contraction times of human muscles, 50 to 110 ms (Buchthal & Schmalbruch 1970, Acta"
    " Physiol Scand 79:435)"
)
_REFLEX = (
    "short-latency stretch reflex of the human ankle, about 45 ms (Kearney, Stein & Parameswaran"
    " 1997, IEEE Trans Biomed Eng 44(6):493)"
)
_TREMOR = "physiological tremor of hand and wrist, 8 to 12 Hz (Elble & Koller 1990, Tremor)"
_SLOW = "a slower oscillation of wrist force seen near 3 to 4 Hz"


DEFAULT_FREE = (
    "k_w",
    "k_z",
    "c_w",
    "c_z",
    "harmonic_amplitude",
    "harmonic_frequency",
    "noise_K_w",
    "noise_K_z",
)
REFLEX = ("reflex_gain", "reflex_delay", "reflex_time")
HARMONIC = ("harmonic_amplitude", "harmonic_frequency")
RESONANCES = ("resonance", "resonance_2")
RESONANCE = tuple(
    f"{which}_{what}" for which in RESONANCES for what in ("amplitude", "frequency", "width")
)
# where a task has them
USUALLY_FREE = (*DEFAULT_FREE, "noise_correlation_time", "activation_time", *RESONANCE)
CHANNELS = ("K_w", "K_z", "C_w", "C_z")
INPUTS = (*CHANNELS, "P_w")


def default(name: str) -> float:
    """The default value of a parameter of the table."""
    return PARAMETERS[name].default


class Parameter(NamedTuple):
    """One row of the parameter table: `name`, `symbol`, `unit`, `default`, `meaning`, and the
    `source` of the default.

    `lower` and `upper` bound what is physically possible, `fit_lower` and `fit_upper` what a fit
    may reach. A positive parameter is fitted in log space; `prior_sd` is then the standard
    deviation of its logarithm, otherwise it is in the parameter's own unit.
    """

    name: str
    symbol: str
    unit: str
    default: float
    meaning: str
    source: str
    lower: float = 0.0
    upper: float = math.inf
    prior_sd: float = 1.0
    positive: bool = True
    fit_lower: float = 0.0
    fit_upper: float = math.inf

    @property
    def range(self) -> str:
        """What is physically possible, in words."""
        low, high = (
            None if math.isinf(bound) else f"{bound:g}" for bound in (self.lower, self.upper)
        )
        if low is None:
            return "any number" if high is None else f"{high} or less"
        return f"{low} or more" if high is None else f"{low} to {high}"


def _free_sign(name, symbol, unit, default, meaning, source, prior_sd):
    free = dict.fromkeys(("lower", "fit_lower"), -math.inf)
    row = Parameter(name, symbol, unit, default, meaning, source, prior_sd=prior_sd)
    return row._replace(positive=False, **free)


PARAMETERS: dict[str, Parameter] = {
    row.name: row
    for row in (
        # no data tell it: its prior goes into all errors
        Parameter("m_w", "m_w", "kg", 0.5, "active mass", _HAND, prior_sd=0.5),
        Parameter("m_z", "m_z", "kg", 0.5, "passive mass", _HAND),
        Parameter("k_w", "k_w", "N/m^3", 5e5, "active stiffness factor", _STIFF),
        Parameter("k_z", "k_z", "N/m^3", 5e5, "passive stiffness factor", _STIFF),
        Parameter("c_w", "c_w", "N s^3/m^3", 60.0, "active damping factor", _DAMP),
        Parameter("c_z", "c_z", "N s^3/m^3", 5.0, "passive damping factor", _DAMP),
        Parameter("x_ref_w", "x_ref,w", "m", 0.02, "active reference displacement", _REF),
        Parameter("x_ref_z", "x_ref,z", "m", 0.02, "passive reference displacement", _REF),
        Parameter("v_ref_w", "v_ref,w", "m/s", 1.0, "active reference velocity", _REF_V),
        Parameter("v_ref_z", "v_ref,z", "m/s", 1.0, "passive reference velocity", _REF_V),
        Parameter("noise_K_w", "σ_Kw/K_w0", "1", 0.15, "noise on active stiffness", _PAPER_K),
        Parameter("noise_K_z", "σ_Kz/K_z0", "1", 0.005, "noise on passive stiffness", _PAPER_K),
        Parameter("noise_C_w", "σ_Cw/C_w0", "1", 1e-4, "noise on active damping", _PAPER_C),
        Parameter("noise_C_z", "σ_Cz/C_z0", "1", 1e-4, "noise on passive damping", _PAPER_C),
        Parameter(
            "noise_cutoff",
            "f_c",
            "Hz",
            50.0,
            "corner of band-limited noise",
            "half of 100 Hz, to which recordings are resampled",
        ),
        Parameter(
            "noise_correlation_time",
            "τ",
            "s",
            0.1,
            "correlation time of Ornstein-Uhlenbeck noise",
            "most fits of measured force: 0.07 to 0.3 s",
            fit_lower=0.005,
            fit_upper=5.0,
        ),
        Parameter("harmonic_amplitude", "A/K_0", "1", 0.003, "harmonic amplitude", _HUMAN),
        Parameter(
            "harmonic_frequency",
            "f_S",
            "Hz",
            4.25,
            "harmonic frequency",
            "the paper: local maximum at 4.251 Hz",
            fit_lower=0.2,
            fit_upper=30.0,
        ),
        Parameter(
            "noise_P_w",
            "σ_Pw",
            "1",
            0.02,
            "noise on the drive, a fraction of P_w; off by default",
            _HUMAN,
        ),
        Parameter(
            "activation_time",
            "T",
            "s",
            0.06,
            "contraction time of a twitch; 0, the default of a task, is none",
            _TWITCH,
            prior_sd=1.0,
            fit_lower=0.005,
            fit_upper=0.5,
        ),
        Parameter(
            "reflex_gain",
            "g",
            "N s/m",
            5.0,
            "gain of a velocity reflex; 0, the default of a task, is none",
            "of the size of the passive damping of the default muscle",
            prior_sd=2.0,
        ),
        Parameter(
            "reflex_delay",
            "d",
            "s",
            0.045,
            "delay of the reflex",
            _REFLEX,
            fit_lower=0.02,
            fit_upper=0.13,
        ),
        Parameter(
            "reflex_time",
            "T_r",
            "s",
            0.05,
            "contraction time of the reflex",
            _TWITCH,
            prior_sd=0.7,
            fit_lower=0.005,
            fit_upper=0.3,
        ),
        Parameter(
            "resonance_amplitude",
            "σ_1",
            "1",
            0.005,
            "resonance of the drive (a tremor), a fraction of P_w",
            _HUMAN,
            prior_sd=2.0,
        ),
        Parameter(
            "resonance_frequency",
            "f_1",
            "Hz",
            9.0,
            "frequency of the resonance",
            _TREMOR,
            prior_sd=0.25,
            fit_lower=0.5,
            fit_upper=30.0,
        ),
        Parameter(
            "resonance_width",
            "b_1",
            "Hz",
            2.0,
            "full width of the resonance at half power",
            _TREMOR,
            prior_sd=0.7,
            fit_lower=0.02,
            fit_upper=15.0,
        ),
        Parameter(
            "resonance_2_amplitude",
            "σ_2",
            "1",
            0.005,
            "a second resonance of the drive, a fraction of P_w",
            _HUMAN,
            prior_sd=2.0,
        ),
        Parameter(
            "resonance_2_frequency",
            "f_2",
            "Hz",
            3.5,
            "frequency of the second resonance",
            _SLOW,
            prior_sd=0.35,
            fit_lower=0.5,
            fit_upper=30.0,
        ),
        Parameter(
            "resonance_2_width",
            "b_2",
            "Hz",
            1.0,
            "full width of the second resonance at half power",
            _SLOW,
            prior_sd=0.7,
            fit_lower=0.02,
            fit_upper=15.0,
        ),
        _free_sign(
            "harmonic_phase",
            "φ",
            "rad",
            0.0,
            "harmonic phase",
            "unknown; hardly any influence above 1 Hz",
            math.pi,
        ),
        Parameter(
            "P_w",
            "P_w",
            "N",
            5.0,
            "active force level",
            "light pressing, displacement near 0.01 m",
            -math.inf,
        ),
        _free_sign("F_ext", "F_ext", "N", 0.0, "external force level", "the paper's Task 2", 5.0),
        _free_sign(
            "x_z", "x_z", "m", 0.0, "displacement of the insertion", "the paper: held", 0.01
        ),
    )
}


def muscle_paths(muscle: Any) -> dict[str, tuple]:
    """Name of every number of a muscle, and where it stands in the task."""
    paths: dict[str, tuple] = {}
    for field, value in _dynamic_fields(muscle):
        if _is_scalar(value) and np.ndim(value) == 0:
            paths[field] = ("muscle", field)
        elif isinstance(value, eqx.Module):
            suffix = field[-2:] if field[-2:] in ("_w", "_z") else ""
            for inner, leaf in _dynamic_fields(value):
                if _is_scalar(leaf):
                    paths[inner + suffix] = ("muscle", field, inner)
    return paths


def _dynamic_fields(module: Any) -> list[tuple[str, Any]]:
    fields = dataclasses.fields(module)
    return [
        (f.name, getattr(module, f.name)) for f in fields if not f.metadata.get("static", False)
    ]


def paths_of(task: Any) -> dict[str, tuple]:
    """Name and path of every parameter of a task: the muscle's, the noise's, the harmonic's and the
    input levels."""
    paths = muscle_paths(task.muscle)
    paths |= _noise_paths(task.noise)
    if task.activation is not None:
        paths["activation_time"] = ("activation", "time")
    for field in ("amplitude", "frequency", "phase"):
        paths[f"harmonic_{field}"] = ("harmonic", field)
    fields = {field.name for field in dataclasses.fields(task)}
    if "reflex" in fields and task.reflex is not None:
        paths |= {f"reflex_{field}": ("reflex", field) for field in ("gain", "delay", "time")}
    for field in ("P_w", "F_ext", "x_z"):
        if field in fields:
            paths[field] = (
                (field, "level") if isinstance(getattr(task, field), eqx.Module) else (field,)
            )
    return paths


def _noise_paths(noise: Any) -> dict[str, tuple]:
    """Of a sum: `noise_` and `resonance_`, then `noise_2_` and so on for further ones of the same
    sort."""
    paths: dict[str, tuple] = {}
    counts = collections.Counter()
    for i, part in enumerate(noise.components):
        counts[part.sort] += 1
        first = f"{part.sort}_" if counts[part.sort] == 1 else f"{part.sort}_{counts[part.sort]}_"
        here = ("noise",) if part is noise else ("noise", "parts", i)
        inputs = [INPUTS[k] for k in part.acts_on]
        if part.sort == "resonance" and len(inputs) == 1:
            inputs = ["amplitude"]
        paths |= {f"{first}{name}": (*here, "amplitude", k) for k, name in enumerate(inputs)}
        others = [
            field
            for field, value in _dynamic_fields(part)
            if field != "amplitude" and _is_scalar(value)
        ]
        paths |= {f"{first}{field}": (*here, field) for field in others}
    return paths


def names_of(task: Any, part: Any) -> list[str]:
    """Names of one component's amplitudes on the four coefficients."""
    where = next(i for i, each in enumerate(task.noise.components) if each is part)
    here = ("noise",) if part is task.noise else ("noise", "parts", where)
    return [
        n
        for n, path in paths_of(task).items()
        if path[:-1] == (*here, "amplitude") and part.acts_on[path[-1]] < 4
    ]


def amplitude_names(task: Any) -> tuple[str, ...]:
    """Names of the amplitudes of noise and harmonic, which a common factor makes louder."""
    return (
        *(n for n, path in paths_of(task).items() if "amplitude" in path and path[0] == "noise"),
        "harmonic_amplitude",
    )


OFF = ("activation_time", "noise_P_w")
# What a result calls by the name that people use.
SYNONYMS = {"contraction_time": "activation_time"}
BASE = {
    "K_w0": "k_w x_ref_w^2",
    "K_z0": "k_z x_ref_z^2",
    "C_w0": "c_w v_ref_w^2",
    "C_z0": "c_z v_ref_z^2",
}


def proper(name: str) -> str:
    """The name of a parameter in the parameter table: that of "contraction_time" is
    "activation_time"; of one target's, too."""
    own, at, target = name.partition("@")
    return SYNONYMS.get(own, own) + at + target


def usually_free(task: Any, usual: Iterable[str] = USUALLY_FREE) -> tuple[str, ...]:
    """What a fit lets free by default: of the `usual` parameters those that are not 0."""
    values = {name: value_of(task, path) for name, path in paths_of(task).items()}
    # Nothing shows the frequency of what has no amplitude.
    still = [
        n.removesuffix("amplitude")
        for n, v in values.items()
        if n.endswith("_amplitude") and not _positive(v)
    ]
    unseen = tuple(f"{of}{what}" for of in still for what in ("frequency", "width"))
    return tuple(
        n for n in usual if n in values and _positive(values[n]) and not n.startswith(unseen)
    )


def _positive(value: Any) -> bool:
    return not is_concrete(value) or not _is_scalar(value) or bool(np.all(np.asarray(value) > 0))


def value_of(task: Any, path: tuple) -> Any:
    """The value at a path, without a computation of JAX; of an array of amplitudes that cannot be
    looked at the whole."""
    if not isinstance(path[-1], int):
        return part_at(task, path)
    node = part_at(task, path[:-1])
    return np.asarray(node)[..., path[-1]] if _is_scalar(node) and is_concrete(node) else node


def get_parameter(task: Any, name: str) -> Any:
    """Value of a parameter by name, or of a base coefficient (`BASE`); 0 of a parameter that is
    switched off."""
    name = proper(name)
    if name in BASE:
        return task.muscle.base()[tuple(BASE).index(name)]
    if name in OFF and name not in paths_of(task):
        return 0.0
    value = part_at(task, _path(task, name))
    return float(value) if isinstance(value, np.floating) else value


def set_parameters(task: Any, values: dict[str, Any]) -> Any:
    """A copy of the task with the named values, validated as a constructor would; what is off is
    switched on."""
    return checked(assigned(task, values))


def assigned(task: Any, values: dict[str, Any]) -> Any:
    """The same without the task's own checks: of a task that is being made."""
    values = proper_values(values)
    time = values.get("activation_time")
    if time is not None and is_concrete(time) and float(time) == 0:
        task, values = (
            task.with_parts(activation=None),
            {n: v for n, v in values.items() if n != "activation_time"},
        )
    off = [name for name in OFF if name in values and name not in paths_of(task)]
    task = _with_values(task, {name: value for name, value in values.items() if name not in off})
    for name in off:
        task = task.with_input(name)
    return _with_values(task, {name: values[name] for name in off})


def proper_values(values: Mapping[str, Any] | None) -> dict[str, Any]:
    """What is given by names, by those in the parameter table. Raises `ValueError` for one
    parameter under two names."""
    values = values or {}
    named = {proper(name): value for name, value in values.items()}
    if len(named) < len(values):
        twice = sorted(name for name in values if proper(name) != name and proper(name) in values)
        raise ValueError(
            f"{twice[0]} and {proper(twice[0])} are the same parameter: give one of them"
        )
    return named


def _with_values(task: Any, values: dict[str, Any]) -> Any:
    for name, value in values.items():
        row = PARAMETERS.get(name)
        if name in {field.name for field in dataclasses.fields(task)} and isinstance(
            value, str | eqx.Module
        ):
            raise ValueError(
                f"{name} = {value!r}: it is a part of the task, not a number; use"
                f" task.with_parts({name}=...)"
            )
        if isinstance(value, bool | str | complex | None) or callable(value):
            raise ValueError(f"{name} = {value!r}: give a number")
        if np.ndim(value) > 0:
            raise ValueError(
                f"{name} has the shape {np.shape(value)}: a parameter is one number. For several"
                f" tasks use jaxmuscle.ensembles.Sweep.grid(task, {name}=[...]), or jax.vmap"
            )
        if row is not None:
            unit = "" if row.unit == "1" else f" {row.unit}"
            message = f"{name} = {value}{unit} is outside its range, {row.range}: {row.meaning}"
            finite = np.isfinite(value) if is_concrete(value) else jax.numpy.isfinite(value)
            require(finite, f"{name} = {value}: give a finite number")
            require((value >= row.lower) & (value <= row.upper), message)
        path = _path(task, name)
        index = path[-1] if isinstance(path[-1], int) else None
        fields = path[:-1] if index is not None else path
        node = part_at(task, fields)
        if index is not None:
            parts = [node[i] for i in range(len(node))]
            parts[index] = value
            value = _stack(parts)
        task = eqx.tree_at(
            lambda t, f=fields: part_at(t, f), task, as_inexact(value), is_leaf=lambda x: x is None
        )
    return task


def _stack(parts: list[Any]) -> Any:
    """Scalars to one array: NumPy's as long as all are concrete, so that nothing is rounded before
    it must be."""
    if any(isinstance(p, jax.Array) for p in parts):
        return jax.numpy.stack([jax.numpy.asarray(p) for p in _same_dtype(parts)])
    return np.array([float(p) for p in parts])


def _same_dtype(parts: list[Any]) -> list[Any]:
    dtype = jax.numpy.result_type(*[p.dtype for p in parts if isinstance(p, jax.Array)])
    return [jax.numpy.asarray(p, dtype=dtype) for p in parts]


def part_at(node: Any, fields: tuple) -> Any:
    """What is at the end of a path of fields and positions."""
    for step in fields:
        node = node[step] if isinstance(step, int) else getattr(node, step)
    return node


def _path(task: Any, name: str) -> tuple:
    paths = paths_of(task)
    if name not in paths:
        known = dict.fromkeys([*paths, *(n for n in OFF if n != name)])
        raise ValueError(unknown_parameter(name, known, of=f" of {type(task).__name__}"))
    return paths[name]


def proper_names(names: Iterable[str] | None) -> tuple[str, ...] | None:
    """The names in the parameter table of the given ones; None of None."""
    return None if names is None else tuple(map(proper, names))


def unknown_parameter(
    name: str, known: Iterable[str], *, of: str = "", what: str = "unknown parameter"
) -> str:
    """The message about a name that is not that of a parameter that can be set or fitted."""
    if name in BASE:
        return (
            f"{name} is not a parameter but follows from some ({BASE[name]} in the paper's muscle):"
            f" it can be read, not set or fitted. Give {name[0].lower()}{name[1:3]} instead"
        )
    return f"{what} {name!r}{of}: {choices(name, known)}"
