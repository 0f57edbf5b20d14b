"""What the peaks of the spectra say of a fit: which rhythms of the model may be stated."""

import math
from collections.abc import Iterable, Mapping

from jaxmuscle.data._measured import can_be_tested
from jaxmuscle.data._target import Target
from jaxmuscle.objective._arguments import SLOWER, base_of, target_of
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._starts import SLOWEST
from jaxmuscle.spectra._peak_test import find_peaks

from ._part import Estimate

NEAR = 0.25  # in the logarithm: what lies at a peak
CORNER = "corner_frequency"


def find_tremor(target: Target) -> float | None:
    """Frequency [Hz] of the significant peak that is measured in the band of tremors; None without
    one."""
    seen = target.measured.get("tremor_frequency")
    return None if seen is None or not math.isfinite(seen.value) else float(seen.value)


def find_slower_peak(target: Target) -> float | None:
    """Frequency [Hz] of the clearest significant peak below the tremors, from 1.5 Hz on; None
    without one."""
    band = SLOWEST, SLOWER[1]
    if not can_be_tested(target, band):
        return None
    given = target.proportional_power, target.settings, target.segments or (), band
    return next((peak.frequency for peak in find_peaks(*given).peaks), None)


def find_unseen(
    problem: FitProblem, table: Mapping[str, Estimate]
) -> tuple[set[str], tuple[str, ...]]:
    """Quantities that the peaks do not bear out, and why, in sentences.

    Of a resonance a significant peak is needed at most a quarter away from its frequency, in one of
    the targets that it acts on; a corner frequency must not lie so near to a tremor: there the
    muscle swings instead.
    """
    if not any(base_of(n).startswith("resonance") or base_of(n) == CORNER for n in table):
        return set(), ()
    peaks = {
        "resonance": [find_tremor(part.target) for part in problem.parts],
        "resonance_2": [find_slower_peak(part.target) for part in problem.parts],
    }
    without, said = set[str](), list[str]()
    for name, estimate in table.items():
        base, own = base_of(name), target_of(name)
        here = [i for i, part in enumerate(problem.parts) if own in ("", part.name)]
        # a bend of the slow part may look like a slower peak: that is what a corner is
        if base == CORNER and any(_near(estimate.value, f) for f in _of(peaks["resonance"], here)):
            without.add(name)
            said.append(
                f"{name} ({estimate.value:.3g} Hz) lies at the tremor that is measured: here the"
                " muscle of the model swings as the tremor does. It is not stated"
            )
        which = base.removesuffix("_frequency")
        if which not in peaks or which == base:
            continue
        seen = _of(peaks[which], here)
        if any(_near(estimate.value, f) for f in seen):
            continue
        at = "@" + own if own else ""
        names = {f"{which}_{what}" for what in ("amplitude", "frequency", "width", "share")}
        without |= {n for n in table if base_of(n) in names and n.endswith(at)}
        said.append(_why(name, estimate.value, seen))
    return without, tuple(said)


def _of(peaks: list[float | None], parts: Iterable[int]) -> list[float]:
    return [f for i in parts if (f := peaks[i]) is not None]


def _near(frequency: float, peak: float) -> bool:
    return abs(math.log(max(frequency, 1e-9) / peak)) < NEAR


def _why(name: str, value: float, seen: list[float]) -> str:
    where = "tremor" if "_2_" not in name else "slower rhythm"
    if not seen:
        return (
            f"the spectrum shows no significant peak for a {where}: the resonance of the model only"
            " helps to describe the spectrum, and its numbers are not stated"
        )
    return (
        f"{name} ({value:.3g} Hz) lies elsewhere than the peak that is measured"
        f" ({', '.join(f'{f:.3g}' for f in seen)} Hz), so it is not stated"
    )
