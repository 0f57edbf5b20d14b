"""Where the seconds of a test run go: a table by file and by phase, printed at its end.

JAX tells how long it traces, lowers and compiles; the rest of a test is running, or waiting for
commands that it started. A function that is traced within another counts once. Everything also goes
to .test-out/timing.json.
"""

import json
import resource
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import jax
import processes
import pytest

PHASES = ("collect", "trace", "lower", "compile", "load", "commands", "run")
EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
    # a compiled program read from the cache
    "/jax/compilation_cache/cache_retrieval_time_sec": "load",
}
LONGEST_FIRST = (
    "test_pages",
    "test_perturbed_fit",
    "test_moved",
    "test_input_design",
    "test_fit",
    "test_hill",
    "test_expected",
    "test_joint",
    "test_trials",
    "test_goodness",
    "test_ensemble",
    "test_several",
    "test_compare",
    "test_posterior",
    "test_study",
    "test_control",
    "test_slow",
    "test_adequacy",
    "test_ladder",
    "test_rungs",
    "test_gradients",
    "test_drive",
    "test_tremor",
    "test_pink",
    "test_simulate",
    "test_reproduce",
    "test_scaling",
    "test_identify",
    "test_likelihood",
    "test_cli",
)
COUNTS = {"compile": "compiled", "load": "loaded"}
HEADING = f"{'seconds':>32} " + "".join(f"{column:>9}" for column in (*PHASES, *COUNTS.values()))


def rank(file: str) -> int:
    """Where a test file stands in the order of work."""
    return LONGEST_FIRST.index(file) if file in LONGEST_FIRST else len(LONGEST_FIRST)


def seconds_of_commands() -> float:
    """Processor time of the processes that this one started, or had forked, and that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime + sum(processes.TAKEN)


class Phases:
    """Seconds that JAX spent in each phase since the last look, without counting nested ones
    twice."""

    def __init__(self) -> None:
        self.spans: list[tuple[float, float]] = []
        self.seconds: Counter[str] = Counter()
        jax.monitoring.register_event_duration_secs_listener(self.listen)

    def listen(self, event: str, duration: float, **_: Any) -> None:
        phase = EVENTS.get(event)
        if phase is None:
            return
        end = time.perf_counter()
        start, own = end - duration, duration
        # ended earlier and began later: within this one
        while self.spans and self.spans[-1][0] >= start - 1e-6:
            inner = self.spans.pop()
            own -= inner[1] - inner[0]
        self.spans.append((start, end))
        self.seconds[phase] += max(own, 0.0)
        if phase in COUNTS:
            self.seconds[COUNTS[phase]] += 1
        if phase == "load":  # JAX reports a program that was loaded as compiled, too
            self.seconds["compiled"] -= 1

    def taken(self) -> Counter[str]:
        """What has come since the last call."""
        seconds, self.seconds, self.spans = self.seconds, Counter(), []
        return seconds


class Timing:
    """Measures each test where it runs; the controller of several workers adds up and prints."""

    def __init__(self, config: pytest.Config) -> None:
        self.config, self.phases = config, Phases()
        self.tests: dict[str, dict[str, float]] = {}
        self.begun, self.start = time.perf_counter(), Counter[str]()

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(self, collector: pytest.Collector) -> Any:
        start = time.perf_counter()
        report = yield
        if isinstance(collector, pytest.Module):
            self.tests[f"{collector.nodeid}::"] = {"collect": time.perf_counter() - start}
            self.phases.taken()
        return report

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Any:
        start, commands = time.perf_counter(), seconds_of_commands()
        result = yield
        found = self.phases.taken()
        whole, ended = time.perf_counter() - start, seconds_of_commands() - commands
        found["commands"] = min(ended, whole)
        found["run"] = max(whole - sum(found[phase] for phase in PHASES), 0.0)
        self.tests[item.nodeid] = dict(found)
        return result

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput["timing"] = self.tests  # pyright: ignore

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: object) -> None:
        for test, found in getattr(node, "workeroutput", {}).get("timing", {}).items():
            mine = self.tests.setdefault(test, {})
            for phase, seconds in found.items():
                mine[phase] = mine.get(phase, 0.0) + seconds

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        if not self.tests or self.config.option.collectonly:
            return
        files: defaultdict[str, Counter[str]] = defaultdict(Counter)
        for test, found in self.tests.items():
            files[Path(test.partition("::")[0]).stem].update(found)
        total = Counter[str]()
        for found in files.values():
            total.update(found)
        write = terminalreporter.write_line
        write("")
        write(HEADING)
        for name, found in sorted(files.items(), key=lambda item: -sum(item[1][p] for p in PHASES)):
            write(row(name, found))
        write(row("all", total))
        write(f"{time.perf_counter() - self.begun:.0f} s from start to end")
        folder = Path(self.config.rootpath) / ".test-out"
        folder.mkdir(exist_ok=True)
        (folder / "timing.json").write_text(json.dumps(self.tests, indent=0), encoding="utf-8")


def row(name: str, found: Counter[str]) -> str:
    whole = sum(found[phase] for phase in PHASES)
    seconds, counts = (
        "".join(f"{found[c]:{f}}" for c in columns)
        for columns, f in ((PHASES, "9.1f"), (COUNTS.values(), "9.0f"))
    )
    return f"{name:>24} {whole:7.1f} {seconds}{counts}"
