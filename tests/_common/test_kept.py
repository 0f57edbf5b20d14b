"""Compiled programs that outlive the process: loaded where nothing changed, made again where
anything stands against it."""

import os
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import ended, python, true_python

import jaxmuscle as jm
from jaxmuscle._common import programs
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import Kept
from jaxmuscle.model._muscle import Muscle


def solved(task, matrix, scale=1.0):
    """A function of a task's numbers, of an array and of a fixed number, that needs LAPACK."""
    return {"x": jnp.linalg.solve(matrix, matrix[0]) * scale, "base": task.muscle.base()}


TASK = as_arrays(jm.Isometric(), np.float64)
MATRIX = np.array([[2.0, 1.0], [0.5, 3.0]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    # Tests may use several devices; a program is kept for one.
    monkeypatch.setattr(programs, "program_folder", lambda: tmp_path)
    monkeypatch.setattr(programs.jax, "devices", lambda *_: [jax.local_devices()[0]])
    monkeypatch.setattr(programs, "KNOWN", (*programs.KNOWN, __name__))
    return tmp_path


def assert_right(found, scale=1.0):
    np.testing.assert_allclose(found["x"], np.linalg.solve(MATRIX, MATRIX[0]) * scale, rtol=1e-12)
    np.testing.assert_allclose(found["base"], np.asarray(TASK.muscle.base()), rtol=1e-12)


def test_a_second_process_traces_nothing(x64, folder):
    first, second = Kept(solved), Kept(solved)
    for _ in range(2):
        assert_right(first(TASK, MATRIX))
    assert_right(second(TASK, MATRIX))
    assert (first.traces, second.traces) == (1, 0)
    for name in ("x", "base"):
        np.testing.assert_array_equal(first(TASK, MATRIX)[name], second(TASK, MATRIX)[name])
    assert_right(second(TASK, 1.0 * MATRIX, 2.5), 2.5)  # another fixed number is another program
    other = second(as_arrays(TASK.replace(k_w=4e5), np.float64), MATRIX)  # other numbers are not
    assert float(other["base"][0]) == pytest.approx(
        float(TASK.muscle.base()[0]) * 4e5 / float(TASK["k_w"])
    )
    assert second.traces == 1


@pytest.mark.parametrize("known", ["xla_cpu_use_fusion_emitters", "xla_cpu_that_is_gone"])
def test_an_option_that_xla_does_not_know_is_done_without(x64, folder, monkeypatch, known):
    monkeypatch.setattr(programs, "OPTIONS", {known: False})
    assert_right(Kept(solved)(TASK, MATRIX))
    monkeypatch.setattr(programs, "program_folder", lambda: None)
    assert_right(Kept(solved)(TASK, MATRIX))


def test_a_fault_in_compiling_is_not_hidden(x64, folder, monkeypatch):
    monkeypatch.setattr(programs, "OPTIONS", {"xla_backend_optimization_level": "perhaps"})
    with pytest.raises(jax.errors.JaxRuntimeError, match="perhaps"):
        Kept(solved)(TASK, MATRIX)


def test_precision_makes_another_program(folder):
    program = Kept(solved)
    with jax.enable_x64(True):
        assert program(TASK, MATRIX)["x"].dtype == jnp.float64
    assert program(TASK, MATRIX)["x"].dtype == jnp.float32 and program.traces == 2


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-7], lambda b: b[:50] + bytes([b[50] ^ 1]) + b[51:], lambda b: b""]
)
def test_a_damaged_file_is_made_again(x64, folder, damage):
    assert_right(Kept(solved)(TASK, MATRIX))
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) == 2
    for path in files:
        path.write_bytes(damage(path.read_bytes()))
    again = Kept(solved)
    assert_right(again(TASK, MATRIX))
    assert again.traces == 1


def test_changed_code_is_traced_again_and_compiled_only_if_it_says_something_else(
    x64, folder, monkeypatch
):
    assert_right(Kept(solved)(TASK, MATRIX))
    before = {path for path in folder.iterdir() if path.is_file()}
    monkeypatch.setattr(programs, "_code", lambda: "f" * 64)
    changed = Kept(solved)
    assert_right(changed(TASK, MATRIX))
    assert changed.traces == 1
    assert {path for path in folder.iterdir() if path.is_file()} == before  # the same machine code


def test_programs_that_differ_in_unused_arguments_are_not_confused(x64, folder):
    def first(x, y):
        return x + 1

    def second(x, y):
        return y + 1

    one, other = Kept(first), Kept(second)
    other.function.__name__ = "first"
    x, y = np.zeros(3), np.ones(3)
    for _ in range(2):
        assert float(one(x, y)[0]) == 1.0 and float(other(x, y)[0]) == 2.0
        one, other = Kept(first), Kept(second)


def test_what_nobody_uses_is_removed_when_the_code_changes(x64, folder, monkeypatch):
    assert_right(Kept(solved)(TASK, MATRIX))
    old = [path for path in folder.rglob("*") if path.is_file()]
    unused, beside = folder / "unused", folder.parent / "somebody-elses"
    for path in (unused, beside):
        path.write_bytes(b"")
    for path in (*old, unused, beside):
        os.utime(path, (0, 0))
    assert_right(Kept(solved)(TASK, MATRIX))  # the program is in use, and says so
    monkeypatch.setattr(programs, "_code", lambda: "f" * 64)
    assert_right(Kept(solved)(TASK, MATRIX))
    assert beside.exists() and not unused.exists() and sum(path.exists() for path in old) == 1


def test_what_holds_an_own_class_is_not_kept(x64, tmp_path, monkeypatch):
    class Own(Muscle):
        """Somebody else's muscle, whose code may change without a sign. The tests keep what stands
        in a file, not this."""

    monkeypatch.setattr(programs, "program_folder", lambda: tmp_path)
    task = TASK.with_parts(muscle=Own())
    assert_right(Kept(solved)(task, MATRIX))
    assert not list(tmp_path.rglob("*"))


def test_a_folder_that_cannot_be_written_is_done_without(x64, folder, monkeypatch):
    def full(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(programs, "replacing", full)
    assert_right(Kept(solved)(TASK, MATRIX))


def test_a_folder_that_is_new_costs_its_neighbours_nothing(x64, tmp_path, monkeypatch):
    """The folder may lie in a cache that somebody has set up for all of JAX."""
    neighbour = tmp_path / "neighbour"
    neighbour.write_bytes(b"")
    os.utime(neighbour, (0, 0))
    monkeypatch.setattr(programs, "program_folder", lambda: tmp_path / "jaxmuscle")
    monkeypatch.setattr(programs, "KNOWN", (*programs.KNOWN, __name__))
    assert_right(Kept(solved)(TASK, MATRIX))
    assert neighbour.exists()


def test_equal_numbers_of_other_types_are_other_programs(folder):
    def typed(x, flag):
        return x + (1 if flag is True else 2)

    program = Kept(typed)
    assert [float(program(np.zeros(1), flag)[0]) for flag in (True, 1, 1.0)] == [1.0, 2.0, 2.0]


def test_derivatives_and_batches_go_through(x64, folder):
    program = Kept(lambda x: jnp.sum(x**3))
    assert jax.grad(program)(2.0 * jnp.ones(2)).tolist() == [12.0, 12.0]
    assert jax.vmap(program)(jnp.ones((3, 2))).tolist() == [2.0, 2.0, 2.0]


def test_fixed_outputs_and_modules_come_back(x64, folder):
    def both(task, x):
        return task.replace(k_w=x), "text", None

    for program in (Kept(both), Kept(both)):
        task, text, none = program(jm.Isometric(), jnp.asarray(3.0))
        assert float(task["k_w"]) == 3.0 and text == "text" and none is None
        assert task.settings == jm.Isometric().settings


def test_what_a_loaded_program_gives_is_the_same_argument_for_the_next(x64, folder):
    """A module's `repr` leaves out a field that is the default object; what was read from a file is
    another object."""

    def stiffer(task):
        return task.replace(k_w=2.0 * task["k_w"])

    made, loaded = Kept(stiffer)(TASK), Kept(stiffer)(TASK)
    Kept(solved)(made, MATRIX)
    program = Kept(solved)
    program(loaded, MATRIX)
    assert program.traces == 0


def test_threads_make_one_result(x64, folder):
    program, found = Kept(solved), []
    threads = [
        threading.Thread(target=lambda: found.append(program(TASK, MATRIX))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    for result in found:
        np.testing.assert_allclose(
            np.asarray(result["x"], float), np.linalg.solve(MATRIX, MATRIX[0]), rtol=1e-5
        )


SOLVED = """
import jax, jax.numpy as jnp, numpy as np, jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import Kept
jax.config.update("jax_enable_x64", True)
program = Kept(lambda task, matrix: (jnp.linalg.solve(matrix, matrix[0]), task.muscle.base()))
found = program(as_arrays(jm.Isometric(), np.float64), np.array([[2.0, 1.0], [0.5, 3.0]]))
print(program.traces, *(np.asarray(x).tobytes().hex() for x in found), sep="-")
"""


def test_between_processes(tmp_path):
    """Two at once, then one more, which traces nothing. Without a cache there are no files."""
    users: Any = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"), "XLA_FLAGS": ""}
    off = users | {"JAXMUSCLE_CACHE": "off", "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "none")}
    alone, *both = [
        ended(one)[0].partition("-")
        for one in [python(SOLVED, **given) for given in (off, users, users)]
    ]
    assert alone[0] == "1" and not (tmp_path / "none" / "jaxmuscle").exists()
    last = ended(python(SOLVED, **users))[0].partition("-")
    assert last[0] == "0" and all(found[2] == last[2] for found in (alone, *both))


LOADED = """
import sys, jax, numpy as np, jaxmuscle as jm
from jaxmuscle.response import _expected
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")  # as the tests
power = np.asarray(jm.expected_spectrum(jm.Isometric()).power)
heavy = {"diffrax", "optimistix", "scipy.signal", "scipy.stats", "matplotlib", "rich"}
heavy &= set(sys.modules)
print(_expected._compiled_response.traces, power.tobytes().hex(), len(heavy))
"""


def test_another_process_loads_what_this_one_made(x64):
    """It traces nothing, and imports nothing that only tracing and drawing need."""
    power = np.asarray(jm.expected_spectrum(jm.Isometric()).power)
    assert ended(true_python(LOADED))[0].split() == ["0", power.tobytes().hex(), "0"]
