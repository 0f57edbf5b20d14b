"""What the fitting scripts share: arguments, fit, report, files."""

import argparse
from collections.abc import Iterable
from pathlib import Path

import jax
import numpy as np

import jaxmuscle as jm
from jaxmuscle.plot import fit as figure


def arguments(description: str, *, csv: bool, preset: bool = False) -> argparse.Namespace:
    """Command line of a script; `csv` adds the user's own digitised spectrum, `preset` a file for
    the fitted task."""
    parser = argparse.ArgumentParser(description=description)
    if csv:
        parser.add_argument(
            "csv",
            nargs="?",
            help="your own digitised spectrum (two columns: Hz, proportional power)",
        )
        parser.add_argument("--segments", type=int, help="Welch segments behind that spectrum")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="default: out/fitting/NAME")
    if preset:
        parser.add_argument("--preset", type=Path, help="write the preset to this file")
    return parser.parse_args()


def load(name: str, options: argparse.Namespace) -> jm.Target:
    """The user's CSV if one was given, else the bundled target."""
    if getattr(options, "csv", None):
        return jm.load_target(
            options.csv, quantity=jm.load_target(name).quantity, segments=options.segments
        )
    return jm.load_target(name)


def report(result: jm.fits.FitResult, name: str, out: Path | None) -> None:
    """Print the result and write `fit.json` and `fit.png`."""
    folder = out or Path("out/fitting") / name
    folder.mkdir(parents=True, exist_ok=True)
    result.save(folder / "fit.json")
    figure(result).savefig(folder / "fit.png", dpi=150)
    print(result)
    print(f"written: {folder}/fit.json, fit.png")


def rounded(task: jm.model.AbstractTask, names: Iterable[str]) -> jm.model.AbstractTask:
    """The named values to four significant digits."""
    return task.replace(**{name: float(f"{float(task[name]):.4g}") for name in names})


def distance(task: jm.model.AbstractTask, target: jm.Target) -> float:
    """Root mean square of the log ratio between the mean spectrum of 200 seeds and a target."""
    power = jm.ensemble(task, jax.random.key(1), seeds=200).spectrum().mean().proportional
    return float(np.std(np.log(np.asarray(power)) - np.log(target.proportional_power)))
