"""Commands in this process, and files that they can read."""

import numpy as np
from typer.testing import CliRunner

from jaxmuscle.commands.main import app

GRID = 0.390625 * np.arange(1, 31)
POWER = 1 / (1 + (GRID / 1.2) ** 2) + 0.01


def run(*arguments):
    """A command that ends with an exit code, without a traceback."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    assert "Traceback" not in result.output
    return result


def refused(result, words):
    """Whether it is a user's mistake that these words name."""
    assert result.exit_code == 2, result.output
    assert words in result.stderr, result.stderr


def write_columns(path, **columns):
    """A CSV with these columns."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_spectrum(path):
    """A spectrum on the grid."""
    return write_columns(path, frequency_hz=GRID, proportional_power=POWER)


def write_recording(path, seed=0, samples=2000, **further):
    """A held force of 5 N at 100 Hz; `further` columns."""
    force = 5 + 0.1 * np.random.default_rng(seed).standard_normal(samples)
    return write_columns(path, time_s=np.arange(samples) / 100, force_N=force, **further)
