"""Does the suite notice a wrong number? Random small faults in the package, and which of them a
test finds.

    python tests/mutants.py --count 10 --out out/mutants.json  # 10 mutants of every subject, hours
    python tests/mutants.py --count 10 --tests ../older/tests ...  # the same, seen by other tests

A mutant is a copy of the package with one operator, comparison, number or condition changed. It
runs the test files of its subject in the order of `SUBJECTS`, the most direct first, and of these
first what `make test` runs, then what `make test-all` adds. It ends at the first failure or after
`--seconds`. Other files might find it, too: the share that is killed is a lower bound. Mutants that
were run stay in the file and are not run again.
"""

import argparse
import ast
import collections
import concurrent.futures
import json
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "jaxmuscle"
SUBJECTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "muscle": (
        ("model/_muscle",),
        ("muscle", "task", "hill", "closed_forms", "simulate", "expected"),
    ),
    "tasks": (
        ("model/_tasks", "model/_signals"),
        ("task", "signal", "muscle", "closed_forms", "simulate", "expected"),
    ),
    "noise": (
        ("model/_noise", "model/_pink_noise"),
        ("noise", "pink", "closed_forms", "orders", "expected", "control"),
    ),
    "path": (
        ("simulation/_integrator", "simulation/_batch", "simulation/_simulate"),
        ("simulate", "orders", "closed_forms", "gradients", "control", "ensemble"),
    ),
    "linear response": (
        (
            "response/_equilibrium",
            "response/_linearised",
            "response/_harmonic_line",
            "response/_expected",
            "response/_sensitivity",
            "response/_characteristics",
            "response/_scaling",
        ),
        ("expected", "sensitivity", "static", "scaling", "second_order", "control", "fit"),
    ),
    "spectra": (
        (
            "spectra/_welch",
            "spectra/_settings",
            "spectra/_measures",
            "spectra/_mean",
        ),
        ("spectrum", "metrics", "uncertainty", "control", "simulate"),
    ),
    "likelihood": (
        (
            "objective/_likelihood",
            "spectra/_bin_law",
            "objective/_scoring",
            "uncertainty/_posterior_density",
            "uncertainty/_profile",
        ),
        ("likelihood", "identify", "posterior", "goodness"),
    ),
    "objective": (
        (
            "objective/_moment_models",
            "objective/_coordinates",
            "objective/_problem",
            "objective/_consequences",
            "objective/_least_squares",
            "objective/_starts",
            "fits/_search",
            "objective/_covariance",
            "fits/_checks",
            "fits/_model_choice",
        ),
        ("uncertainty", "checks", "fit", "identify", "joint", "fitting", "goodness"),
    ),
    "targets": (
        (
            "data/_target",
            "data/_target_files",
            "data/_target_fields",
            "data/_target_csv",
        ),
        ("target", "digitised", "trials", "cli", "moved"),
    ),
    "recordings": (
        (
            "data/_apart",
            "data/_apart_child",
            "data/_recording",
            "data/_recording_channels",
            "data/_recording_quality",
            "data/_recording_body",
            "data/_recording_choice",
            "data/_recording_csv",
            "data/_recording_files",
            "data/_recording_formats",
            "data/_recording_outliers",
            "data/_recording_table",
            "data/_recording_time",
            "data/_units",
        ),
        (
            "recording",
            "recording_file",
            "recording_formats",
            "hostile",
            "trials",
            "perturbed",
            "reproduce",
        ),
    ),
    "ensemble store": (
        (
            "ensembles/_ensemble",
            "ensembles/_layout",
            "ensembles/_chunks",
            "ensembles/_opening",
            "ensembles/_run",
            "ensembles/_store",
            "ensembles/_summary",
            "ensembles/_running_moments",
            "ensembles/_sweep",
        ),
        ("ensemble", "stores", "workers"),
    ),
}
ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
}
COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPPOSITE = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "any": "all",
    "all": "any",
    "sin": "cos",
    "cos": "sin",
    "real": "imag",
    "argmin": "argmax",
    "argmax": "argmin",
}
# what they say is tested, not counted
WORDS_AND_PICTURES = {"__str__", "__repr__", "plot", "message", "remarks", "notices"}


NO_TESTS = 5  # pytest's exit code where none has the mark
COMMANDS = {"make test": "not slow", "make test-all": "slow"}  # which tests each runs first


class Mutant(NamedTuple):
    subject: str
    file: str
    line: int
    column: int
    before: str
    after: str

    @property
    def name(self) -> str:
        return f"{self.file}:{self.line}:{self.column} {self.before} -> {self.after}"


def changed(node: ast.AST) -> Iterator[ast.AST]:  # noqa: C901 (a case for each kind of node)
    """What a node may be exchanged for."""
    match node:
        case ast.BinOp() if type(node.op) in ARITHMETIC:
            yield ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)
        case ast.Compare(ops=[op]) if type(op) in COMPARISONS:
            yield ast.Compare(node.left, [COMPARISONS[type(op)]()], node.comparators)
        case ast.BoolOp():
            yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        case ast.UnaryOp(op=ast.USub() | ast.Not()) if not isinstance(node.operand, ast.Constant):
            yield node.operand
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() as value):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float() as value):
            yield ast.Constant(2 * value if value else 1.0)
        case ast.IfExp():
            yield ast.IfExp(node.test, node.orelse, node.body)
        case ast.Call(func=ast.Attribute(attr="where"), args=[test, one, other]):
            yield ast.Call(node.func, [test, other, one], node.keywords)
        case ast.Call(func=ast.Attribute(attr=name)) if name in OPPOSITE:
            yield ast.Call(
                ast.Attribute(node.func.value, OPPOSITE[name], ast.Load()), node.args, node.keywords
            )
        case ast.Call(func=ast.Name(id=name)) if name in OPPOSITE:
            yield ast.Call(ast.Name(OPPOSITE[name], ast.Load()), node.args, node.keywords)


def of_numbers(node: ast.AST) -> Iterator[ast.AST]:
    """The node and all below it that numbers can depend on: no annotations, errors, texts,
    figures."""
    skipped = (ast.Raise, ast.JoinedStr, ast.arg, ast.Import, ast.ImportFrom, ast.Assert)
    if isinstance(node, skipped) or (
        isinstance(node, ast.FunctionDef) and node.name in WORDS_AND_PICTURES
    ):
        return
    if isinstance(node, ast.If) and any(isinstance(inside, ast.Raise) for inside in node.body):
        yield from of_numbers(node.test)
        return
    yield node
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from of_numbers(child)


def of_file(subject: str, path: Path) -> list[Mutant]:
    text = path.read_text(encoding="utf-8")
    found = []
    for node in of_numbers(ast.parse(text)):
        for other in changed(node):
            before, after = (
                ast.get_source_segment(text, node),
                ast.unparse(ast.fix_missing_locations(other)),
            )
            if before and "\n" not in before:
                found.append(
                    Mutant(
                        subject,
                        path.relative_to(SOURCE).with_suffix("").as_posix(),
                        node.lineno,
                        node.col_offset,
                        before,
                        f"({after})",
                    )
                )
    return found


def of_subject(subject: str) -> list[Mutant]:
    return [m for file in SUBJECTS[subject][0] for m in of_file(subject, SOURCE / f"{file}.py")]


def sampled(count: int, seed: int) -> list[Mutant]:
    """So many of every subject, each on a line of its own."""
    chosen = []
    for subject in SUBJECTS:
        sites = of_subject(subject)
        random.Random(f"{seed} {subject}").shuffle(sites)
        one_a_line = {(m.file, m.line): m for m in reversed(sites)}
        chosen += [m for m in sites if one_a_line[m.file, m.line] is m][:count]
    return chosen


def applied(mutant: Mutant, text: str) -> str:
    lines = text.split("\n")
    line = lines[mutant.line - 1].encode()
    end = mutant.column + len(mutant.before.encode())
    assert line[mutant.column : end].decode() == mutant.before
    lines[mutant.line - 1] = (line[: mutant.column] + mutant.after.encode() + line[end:]).decode()
    return "\n".join(lines)


def judged(mutant: Mutant, folder: Path, seconds: float) -> dict[str, Any]:
    """Runs its tests in a copy of the project for so long; what failed first, or None."""
    path = folder / "src" / "jaxmuscle" / f"{mutant.file}.py"
    original = (SOURCE / f"{mutant.file}.py").read_text(encoding="utf-8")
    path.write_text(applied(mutant, original), encoding="utf-8")
    files = [
        str(file)
        for test in SUBJECTS[mutant.subject][1]
        for file in sorted((folder / "tests").rglob(f"test_{test}.py"))
    ]
    begun, killer, noticed_by, ended = time.monotonic(), None, None, True
    try:
        for name, mark in COMMANDS.items():
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-x",
                "-q",
                "--tb=no",
                "-p",
                "no:cacheprovider",
                "-m",
                mark,
                *files,
            ]
            done = subprocess.run(
                command,
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
                timeout=max(1.0, seconds - (time.monotonic() - begun)),
                env=os.environ | {"PYTHONPATH": str(folder / "src")},
            )
            failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
            if done.returncode not in (0, NO_TESTS):
                killer = failed.group(1) if failed else f"exit {done.returncode}"
                noticed_by = name
                break
    except subprocess.TimeoutExpired:
        ended = False
    finally:
        path.write_text(original, encoding="utf-8")
    return {
        "killed by": killer,
        "command": noticed_by,
        "all run": ended,
        "seconds": round(time.monotonic() - begun, 1),
    }


def copied(folder: Path, tests: Path) -> Path:
    """The project in `folder` with those tests; compiled programs are shared with the project
    itself."""
    kept = shutil.ignore_patterns(
        ".git", ".venv", "out", "site", ".test-out", "__pycache__", "tests"
    )
    shutil.copytree(ROOT, folder, ignore=kept, symlinks=True)
    shutil.copytree(tests, folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    (ROOT / ".test-out").mkdir(exist_ok=True)
    (folder / ".test-out").symlink_to(ROOT / ".test-out")
    return folder


def table(found: dict[str, Any]) -> str:
    """Mutants of every subject, how many each command notices, then the survivors."""
    count = collections.Counter(row["subject"] for row in found.values())
    killed = {name: collections.Counter[str]() for name in COMMANDS}
    for row in found.values():
        killed["make test"][row["subject"]] += row["command"] == "make test"
        killed["make test-all"][row["subject"]] += row["killed by"] is not None
    numbers = {name: [count[name], *(of[name] for of in killed.values())] for name in count}
    numbers["all"] = [count.total(), *(of.total() for of in killed.values())]
    rows = [f"{name:18}" + "".join(f"{n:14}" for n in row) for name, row in numbers.items()]
    alive = [
        f"  survives: {row['subject']}: {name}"
        for name, row in found.items()
        if row["killed by"] is None
    ]
    heading = f"{'subject':18}" + "".join(f"{name:>14}" for name in ("mutants", *COMMANDS))
    return "\n".join([heading, *rows, *alive])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10, help="mutants of every subject")
    parser.add_argument("--seed", type=int, default=14)
    parser.add_argument("--tests", type=Path, default=ROOT / "tests")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "mutants.json")
    parser.add_argument(
        "--seconds", type=float, default=180.0, help="for one mutant; then it counts as not noticed"
    )
    parser.add_argument(
        "--names", type=Path, help="a file with the names of mutants, one a line: run these"
    )
    parser.add_argument("--only", default="", help="mutants whose name contains this")
    parser.add_argument("--list", action="store_true", help="show the mutants, run none")
    given = parser.parse_args()
    if given.names is None:
        mutants = [m for m in sampled(given.count, given.seed) if given.only in m.name]
    else:
        asked = given.names.read_text(encoding="utf-8").splitlines()
        mutants = [m for subject in SUBJECTS for m in of_subject(subject) if m.name in asked]
    if given.list:
        print("\n".join(f"{m.subject:16} {m.name}" for m in mutants))
        return
    found = json.loads(given.out.read_text(encoding="utf-8")) if given.out.exists() else {}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,
        concurrent.futures.ThreadPoolExecutor(2) as workers,
    ):
        folders: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for number in range(2):
            folders.put(copied(Path(scratch) / str(number), given.tests))

        def one(mutant: Mutant) -> tuple[Mutant, dict[str, Any]]:
            folder = folders.get()
            try:
                return mutant, judged(mutant, folder, given.seconds)
            finally:
                folders.put(folder)

        left = [workers.submit(one, m) for m in mutants if m.name not in found]
        for done in concurrent.futures.as_completed(left):
            mutant, row = done.result()
            found[mutant.name] = {"subject": mutant.subject} | row
            given.out.write_text(json.dumps(found, indent=1), encoding="utf-8")
            print(
                f"{row['seconds']:6.0f} s  {mutant.name}  {row['killed by'] or 'SURVIVES'}",
                flush=True,
            )
    print(table(found))


if __name__ == "__main__":
    main()
