"""The page as one file without the network: its parts joined, the facts and the content written
into it."""

import json
import re
from importlib import resources
from typing import Any

from jaxmuscle.data._target import Target
from jaxmuscle.model._muscle import Muscle, QuadraticDamping, QuadraticStiffness
from jaxmuscle.model._signals import AbstractSignal, Constant, RampHold, SmoothStep
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._linearised import has_response

from ._facts import bare_table, facts

# In an order in which each follows those that it imports.
MODULES = (
    "numbers",
    "settings",
    "task",
    "noise",
    "covariance",
    "harmonic",
    "spectrum",
    "statistics",
    "simulate",
    "target",
    "model",
    "figure",
    "view",
    "controls",
    "state",
    "app",
)
_IMPORT = re.compile(r"^import [^;]*;\n", re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)
_SHOWN = ("name", "bins", "frequency", "proportional_power", "sigma", "segments", "dispersion")


def page(task: AbstractTask | None = None, target: Target | None = None) -> str:
    """The explorer as the text of one HTML file, which needs neither server nor network.

        from jaxmuscle import explorer

        text = explorer.page(jm.Isometric(k_w=4e5))
        Path("explorer.html").write_text(text, encoding="utf-8")

    It computes the expected spectrum of a task in JavaScript, as `expected_spectrum` does, while
    sliders move.

    **Arguments:** `task` that it begins with (default: `Isometric()`); `target` that is drawn over
    its spectrum.

    **Returns:** the text. Write it to a file that ends in .html and open that in a browser.

    **Raises:** `ValueError` for a muscle, a law or an input that the page does not know, for a task
    without linear response, and for a target without a spectrum.
    """
    script = "\n".join(_EXPORT.sub("", _IMPORT.sub("", part_of(f"{name}.mjs"))) for name in MODULES)
    pieces = {
        "STYLE": part_of("style.css"),
        "FACTS": _json(facts()),
        "CONTENT": _json(content(task, target)),
        "SCRIPT": script,
    }
    return re.sub(
        r"/\*(STYLE|FACTS|CONTENT|SCRIPT)\*/", lambda found: pieces[found[1]], part_of("page.html")
    )


def part_of(name: str) -> str:
    """The text of one part of the page."""
    return (resources.files("jaxmuscle.explorer") / "page" / name).read_text(encoding="utf-8")


def _json(value: Any) -> str:
    """JSON that can stand in a page: no tag of it is closed early."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def content(task: AbstractTask | None, target: Target | None) -> dict[str, Any]:
    """What the page begins with, as JSON holds it."""
    if task is None:
        return {}
    _check(task)
    if target is None:
        return {"state": {"table": bare_table(task)}}
    if not target.bins.size:
        raise ValueError(
            f"{target.name} has no spectrum, only a frequency response: the explorer draws spectra"
        )
    seen = target.to_table() | {
        "bins": target.bins.tolist(),
        "frequency": target.frequency.tolist(),
    }
    shown = {key: seen.get(key) for key in _SHOWN} | {
        "dispersion": target.dispersion,
        "notices": list(target.notices),
        "newtons": target.mean_force is not None,
    }
    return {
        "state": {"table": bare_table(task.with_parts(settings=target.settings)), "target": shown}
    }


def _check(task: AbstractTask) -> None:
    muscle = task.muscle
    laws = (
        []
        if type(muscle) is not Muscle
        else [
            (muscle.stiffness_w, QuadraticStiffness),
            (muscle.stiffness_z, QuadraticStiffness),
            (muscle.damping_w, QuadraticDamping),
            (muscle.damping_z, QuadraticDamping),
        ]
    )
    if not laws or any(type(law) is not kind for law, kind in laws):
        raise ValueError(
            "the explorer knows only the paper's muscle with its quadratic laws; this task has a"
            " muscle or law of its own: use expected_spectrum in Python"
        )
    for name in ("P_w", "F_ext", "x_z"):
        signal = getattr(task, name, None)
        if isinstance(signal, AbstractSignal) and not isinstance(
            signal, Constant | SmoothStep | RampHold
        ):
            raise ValueError(
                f"{name} is a {type(signal).__name__}, which no slider can set: hold it at its"
                " level, with task.settled()"
            )
    has_response(task, required=True)
