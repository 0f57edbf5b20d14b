"""The options of a fit, declared once: what `fit`, `fit_cohort` and `problem` take as
keywords (their docstrings say what each does)."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, TypedDict

from jaxmuscle._common.arguments import check_options, count, is_real, positive
from jaxmuscle._common.keys import check_key, number_of
from jaxmuscle._common.progress import Tell, nothing
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Key
from jaxmuscle.model._noise import AbstractNoise
from jaxmuscle.model._parameters import proper_names, proper_values


def check_named(free: Any, fix: Any, bounds: Any, priors: Any) -> None:
    """Raise a `ValueError` naming the argument and the parameter whose value is none."""
    if free is not None and (isinstance(free, str) or not isinstance(free, Iterable)):
        raise ValueError(f"free = {free!r}: give a list of names, as ['k_w']")
    if isinstance(free, list | tuple) and not all(isinstance(name, str) for name in free):
        raise ValueError(f"free = {free!r}: names are texts")
    for name, value in _entries("fix", fix):
        if not is_real(value):
            raise ValueError(f"fix[{name!r}] = {value!r}: give a finite number")
    for name, pair in _entries("bounds", bounds):
        low, high = pair if isinstance(pair, tuple | list) and len(pair) == 2 else (None, None)
        ends = (is_real(low) or low == -math.inf) and (is_real(high) or high == math.inf)
        if low is None or high is None or not ends or not low < high:
            raise ValueError(f"bounds[{name!r}] = {pair!r}: give two numbers, the lower first")
    for name, sd in _entries("priors", priors):
        if sd is not None and not (is_real(sd) and sd > 0):
            raise ValueError(
                f"priors[{name!r}] = {sd!r}: give a standard deviation above 0, or None for a flat"
                " prior"
            )


def check_data(coefficient_of_variation: Any, mean_force: Any) -> None:
    """Raise a `ValueError` for what does not say whether and which further data there are."""
    if not isinstance(coefficient_of_variation, bool):
        raise ValueError(
            f"coefficient_of_variation = {coefficient_of_variation!r}: give True or False, whether"
            " it is data"
        )
    if mean_force is None or mean_force is False:
        return
    pair = (
        mean_force
        if isinstance(mean_force, tuple | list) and len(mean_force) == 2
        else (math.nan, math.nan)
    )
    if not (is_real(pair[0]) and is_real(pair[1]) and pair[1] > 0):
        raise ValueError(
            f"mean_force = {mean_force!r}: give the mean and its standard error [N], as (20.0,"
            " 0.4), or False"
        )


def _entries(argument: str, given: Any) -> Iterable[tuple[str, Any]]:
    if given is None:
        return ()
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise ValueError(f"{argument} = {given!r}: give a dictionary by the names of parameters")
    return given.items()


METHODS = ("linear", "montecarlo")
REFLEXES = ("auto", "none", "linear")
MOST = 10**9  # of starts, seeds and steps: what is more is a slip
DT = 2.5e-3


class ParameterOptions(TypedDict, total=False):
    """Which parameters are fitted, and what is known of them beforehand."""

    free: Iterable[str] | None
    fix: Mapping[str, float] | None
    bounds: Mapping[str, tuple[float, float]] | None
    priors: Mapping[str, float | None] | None


class DataOptions(ParameterOptions, total=False):
    """And what the data are."""

    noise: str | AbstractNoise | None
    coefficient_of_variation: bool


class SearchOptions(DataOptions, total=False):
    """And how it is searched for."""

    starts: int | None
    max_steps: int
    key: Key


class SimulationOptions(SearchOptions, total=False):
    """And what is simulated, and tried."""

    seeds: int | None
    check_seeds: int | None
    rungs: int | None


class OneFitOptions(SimulationOptions, total=False):
    """And of one target."""

    method: str
    mean_force: tuple[float, float] | Literal[False] | None
    dt: float
    reflex: str


class JointFitOptions(SimulationOptions, total=False):
    """And of several targets together."""

    separate: Iterable[str]
    proportional: Iterable[str]
    mean_force: Mapping[str, tuple[float, float]] | None
    reflex: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How a fit is done: all that its keywords may say, checked.

    `also_free`: what is free besides `free`, whatever that is; `carried`, by which number the task
    was multiplied to come to a measured mean force.
    """

    free: Iterable[str] | None = None
    fix: Mapping[str, float] | None = None
    noise: str | AbstractNoise | None = None
    method: str = "linear"
    starts: int | None = None
    seeds: int | None = None
    check_seeds: int | None = None
    key: Key = 0
    bounds: Mapping[str, tuple[float, float]] | None = None
    priors: Mapping[str, float | None] | None = None
    coefficient_of_variation: bool = True
    mean_force: tuple[float, float] | Literal[False] | None = None
    also_free: tuple[str, ...] = ()
    carried: float | None = None
    max_steps: int = 40
    dt: float = DT
    rungs: int | None = None
    reflex: str = "auto"
    progress: Tell = nothing

    @classmethod
    def of(
        cls, caller: Callable[..., Any], known: type, given: Mapping[str, Any], **own: Any
    ) -> "FitOptions":
        """From the keywords of a function that takes the `known` ones, a `TypedDict`, and from what
        it says itself. Raises `TypeError` for another keyword."""
        check_options(caller, known, given)
        return cls(**given, **own)

    def __post_init__(self) -> None:
        check_named(self.free, self.fix, self.bounds, self.priors)
        named = {"free": proper_names(self.free)}
        named |= {name: proper_values(getattr(self, name)) for name in ("fix", "bounds", "priors")}
        for name, value in named.items():
            object.__setattr__(self, name, value)
        if self.method not in METHODS:
            raise ValueError(f"method = {self.method!r}: {choices(self.method, METHODS)}")
        for name, least in (
            ("starts", 1),
            ("seeds", 0),
            ("check_seeds", 0),
            ("max_steps", 1),
            ("rungs", 0),
        ):
            if getattr(self, name) is not None:
                count(name, getattr(self, name), least, MOST)
        if self.reflex not in REFLEXES:
            raise ValueError(f"reflex = {self.reflex!r}: {choices(str(self.reflex), REFLEXES)}")
        check_key(self.key)
        positive("dt", self.dt)
        check_data(self.coefficient_of_variation, self.mean_force)

    @property
    def seed(self) -> int | None:
        """The key, if it was given as a number."""
        return number_of(self.key)
