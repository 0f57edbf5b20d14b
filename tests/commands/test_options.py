"""Every option of every command with every kind of wrong value: exit code 2, one sentence, before
anything is compiled."""

import enum
import inspect
import typing
from pathlib import Path
from typing import Any

import pytest
import typer.testing
from in_process import write_recording, write_spectrum
from typer.testing import CliRunner

from jaxmuscle._common import programs
from jaxmuscle.commands.main import app

COMMANDS: dict[str, Any] = {
    each.callback.__name__: each.callback for each in app.registered_commands if each.callback
}
MADE = typer.main.get_command(app)
VALID = {
    "fit": ["t.csv", "--segments", "12"],
    "simulate": ["zagrodny-slifkin"],
    "analyse": ["r.csv"],
    "ensemble": ["zagrodny-slifkin", "--seeds", "4", "--out", "e.zarr"],
    "steadiness": ["r.csv"],
    "compare": ["t.csv"],
    "posterior": ["t.csv", "--segments", "12"],
    "design": ["zagrodny-slifkin"],
    "reproduce": [],
    "speed": [],
    "identifiability": ["t.csv", "--segments", "12"],
    "study": ["s.csv"],
    "demo": [],
    "explore": ["t.csv", "--no-open", "--out", "e.html"],
}
NUMBERS = ("nan", "inf", "-inf", "1e400", "-1", "9" * 40, "", "text", "1,5", "1e300", "0")
WHOLE = (*NUMBERS, "1.5", "0x10")
TEXTS = ("", "text", "..", "\x01", "a\nb")
PATHS = ("missing.csv", "folder", "..", "r\n.csv", "x\1y.csv")  # no argument holds a NUL
# Zero is one of these; a number below 0 one of the others.
ZERO = {"seed", "skip_rows", "max_gap", "rungs", "delay", "spread", "process_id", "rung", "alpha"}
SIGNED = {"delay"}
# not yet a mistake
LARGE = {"max_gap", "delay", "mvc", "lever_arm", "rms", "peak", "speed", "acceleration"}
FREE = {"output", "force", "as_json"}  # a folder may have any name
# Known only when the linear response is there, or of no influence where nothing has that name.
LATER = {("design", "quantity")}


class Compiled(Exception):
    """The work has begun."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with valid files; whoever calls a compiled program other than that of a key
    fails."""
    run = programs.Kept.__call__

    def call(self, *arguments, **keywords):
        if self.function.__module__ == "jaxmuscle._common.keys":
            return run(self, *arguments, **keywords)
        raise Compiled(self.function.__name__)

    monkeypatch.setattr(programs.Kept, "__call__", call)
    # Typer would build all commands with their options for every call, which takes longer than the
    # call.
    monkeypatch.setattr(typer.testing, "_get_command", lambda app: MADE, raising=False)
    monkeypatch.chdir(tmp_path)
    write_spectrum(tmp_path / "t.csv")
    for name in ("r.csv", "r2.csv"):
        write_recording(tmp_path / name, samples=3000)
    (tmp_path / "s.csv").write_text("file,person\nr.csv,a\nr2.csv,b\n")
    (tmp_path / "folder").mkdir()
    return tmp_path


def kind_of(parameter: inspect.Parameter) -> Any:
    """The type of an option, without `None` and `list`."""
    given = (
        typing.get_args(parameter.annotation)[0]
        if typing.get_args(parameter.annotation)
        else parameter.annotation
    )
    options = [kind for kind in typing.get_args(given) if kind is not type(None)] or [given]
    inner = typing.get_args(options[0]) if typing.get_origin(options[0]) is list else ()
    return inner[0] if inner else options[0]


def wrong_values(name: str, kind: Any) -> tuple[str, ...]:
    if kind in (int, float):
        values = [v for v in (WHOLE if kind is int else NUMBERS) if not (name in ZERO and v == "0")]
        values = [v for v in values if not (name in SIGNED and v == "-1")]
        return tuple(v for v in values if not (name in LARGE and v in ("1e300", "9" * 40)))
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return ("", "text", "WHITE ")
    return PATHS if kind is Path or name in ("store", "target", "paths") else TEXTS


def cases(command: str) -> list[tuple[str, str, list[str]]]:
    """Option, wrong value and arguments."""
    found = []
    for name, parameter in inspect.signature(COMMANDS[command]).parameters.items():
        kind = kind_of(parameter)
        if name in FREE or kind is bool or (command, name) in LATER or name == "reading":
            continue
        [about] = typing.get_args(parameter.annotation)[1:] or [None]
        for value in wrong_values(name, kind):
            if type(about).__name__ == "ArgumentInfo":
                rest = VALID[command][1:] if command == "ensemble" else []
                found.append((name, value, [command, *rest, "--", value]))
                continue
            declared = [
                flag for flag in getattr(about, "param_decls", ()) or () if flag.startswith("--")
            ]
            flag = declared[0] if declared else "--" + name.replace("_", "-")
            valid = list(VALID[command])
            if flag in valid:
                del valid[valid.index(flag) : valid.index(flag) + 2]
            found.append((name, value, [command, *valid, f"{flag}={value}"]))
    return found


@pytest.mark.parametrize("command", VALID)
def test_a_wrong_value_is_one_sentence(command, here):
    wrong = []
    for name, value, arguments in cases(command):
        result = CliRunner().invoke(app, arguments)
        said = result.stderr.partition("error:")[2] or result.stderr
        sentences = [line for line in said.strip().splitlines() if line.strip()]
        if isinstance(result.exception, Compiled):
            wrong.append(f"--{name} {value!r}: accepted")
        elif not isinstance(result.exception, SystemExit) or result.exit_code != 2:
            wrong.append(f"--{name} {value!r}: exit {result.exit_code}, {result.exception!r}"[:200])
        elif (
            "Traceback" in result.output
            or not sentences
            or ("error:" in result.stderr and len(sentences) > 1)
        ):
            wrong.append(f"--{name} {value!r}: {result.stderr[-200:]!r}")
    assert not wrong, f"{len(wrong)} of {len(cases(command))}:\n" + "\n".join(wrong)
    assert {path.name for path in here.iterdir()} <= {
        "t.csv",
        "r.csv",
        "r2.csv",
        "s.csv",
        "folder",
        "out",
    }


def test_every_command_is_tried():
    assert set(VALID) == set(COMMANDS) - {"targets", "presets"}  # these two have no value to give
