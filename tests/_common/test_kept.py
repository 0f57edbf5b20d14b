"""Compiled programs that outlive the process: loaded where nothing changed, made again where
anything stands against it."""

import os
import threading
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import SRC, ended, python, true_python

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


def stepped(x, size, unused, *, solve):
    """Fifty steps of a loop, to which an input makes no difference, and which may call LAPACK."""

    def step(state, number):
        more = jnp.linalg.solve(jnp.diag(1 + state**2), state) if solve else state / (1 + state**2)
        return state + size * more + jnp.where(size > -1, 0, unused), state[0] + number

    return programs.in_one_piece(lambda: jax.lax.scan(step, x, jnp.arange(50.0)))


ONE_PIECE = """
import jax, numpy as np, test_kept
from jaxmuscle._common import programs

programs.program_folder = lambda: None
for solve in (False, True):
    with jax.enable_x64(True):
        program = programs.Kept(test_kept.stepped, simulates=True)
        test_kept.assert_stepped(program, solve)
        print(solve, program.traces)
"""


def assert_stepped(program, solve):
    """Against the same steps in NumPy."""
    state, seen = np.linspace(0.1, 1, 6), []
    last, found = program(state, np.array(0.1), np.ones(6), solve=solve)
    for number in range(50):
        seen.append(state[0] + number)
        state = state + 0.1 * state / (1 + state**2)
    np.testing.assert_allclose(last, state, rtol=1e-12)
    np.testing.assert_allclose(found, seen, rtol=1e-12)


@pytest.mark.parametrize("solve", [False, True])
def test_a_loop_in_one_piece_has_the_same_numbers(x64, folder, solve):
    """With LAPACK inside it cannot be one piece, and is traced a second time."""
    program = Kept(stepped, simulates=True)
    assert_stepped(program, solve)
    assert program.traces == (2 if solve and jax.default_backend() == "cpu" else 1)
    again = Kept(stepped, simulates=True)
    assert_stepped(again, solve)
    assert again.traces == 0


def test_a_loop_in_one_piece_as_users_compile_it():
    """XLA ends the process at a piece with an input that its simplification has made useless."""
    here = Path(__file__).parent
    folders = os.pathsep.join(map(str, (SRC, here, here.parent)))
    said, _ = ended(true_python(ONE_PIECE, XLA_FLAGS="", PYTHONPATH=folders))
    assert said.split() == ["False", "1", "True", "2"]


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


@pytest.mark.parametrize(
    "content",
    [
        lambda name, shape: 5,
        lambda name, shape: name,
        lambda name, shape: (name, shape),
        lambda name, shape: (5, shape, False),
        lambda name, shape: ("another", shape, False),
        lambda name, shape: ("null\0", shape, False),
        lambda name, shape: (name, None, False),
        lambda name, shape: (name, {"x": shape["x"]}, False),
        lambda name, shape: (name, {"x": shape["base"], "base": shape["x"]}, False),
    ],
)
def test_an_entry_that_is_something_else_is_made_again(x64, folder, content):
    """Whole, with the digest that it must have."""
    assert_right(Kept(solved)(TASK, MATRIX))
    (place,) = [path for path in folder.rglob("*") if path.is_file() and path.parent != folder]
    name, shape, _ = programs._read(place)
    programs._write(place, lambda: content(name, shape))
    again, then = Kept(solved), Kept(solved)
    assert_right(again(TASK, MATRIX))
    assert_right(then(TASK, MATRIX))
    assert (again.traces, then.traces) == (1, 0)


def test_a_program_that_is_something_else_is_made_again(x64, folder):
    assert_right(Kept(solved)(TASK, MATRIX))
    (program,) = [path for path in folder.iterdir() if path.is_file()]
    programs._write(program, lambda: 5)
    assert_right(Kept(solved)(TASK, MATRIX))
    again = Kept(solved)
    assert_right(again(TASK, MATRIX))
    assert again.traces == 0


def test_what_is_read_is_no_other_programs(x64, folder):
    """A file that was copied to the name of another is noticed."""
    program = Kept(solved)
    for scale in (1.0, 2.5):
        assert_right(program(TASK, MATRIX, scale), scale)
    one, other = [path for path in folder.rglob("*") if path.is_file() and path.parent != folder]
    one.write_bytes(other.read_bytes())
    program = Kept(solved)
    for scale in (1.0, 2.5):
        assert_right(program(TASK, MATRIX, scale), scale)
    assert program.traces == 1


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


def test_what_nobody_uses_is_removed(x64, folder):
    assert_right(Kept(solved)(TASK, MATRIX))
    old = [path for path in folder.rglob("*") if path.is_file()]
    unused, beside = folder / "unused", folder.parent / "somebody-elses"
    for path in (unused, beside):
        path.write_bytes(b"")
    for path in (*old, unused, beside):
        os.utime(path, (0, 0))
    assert_right(Kept(solved)(TASK, MATRIX))  # the program is in use, and says so
    assert_right(Kept(solved)(TASK, MATRIX, 2.5), 2.5)
    assert beside.exists() and not unused.exists() and all(path.exists() for path in old)


def test_the_folder_does_not_grow_for_ever(x64, folder, monkeypatch):
    """What was used longest ago has to go first."""
    scales = [1.0, 2.0, 3.0, 4.0]
    for age, scale in enumerate(scales):
        before = set(folder.rglob("*"))
        assert_right(Kept(solved)(TASK, MATRIX, scale), scale)
        for path in set(folder.rglob("*")) - before:
            os.utime(path, (path.stat().st_mtime - 1000 + age,) * 2)
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    largest = sum(sizes) + max(sizes) // 2  # not all programs have the same size
    monkeypatch.setattr(programs, "LARGEST", largest)
    assert_right(Kept(solved)(TASK, MATRIX, 1.0))  # from now on the second is the oldest
    assert_right(Kept(solved)(TASK, MATRIX, 5.0), 5.0)
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) <= largest
    again = {scale: Kept(solved) for scale in (1.0, 3.0, 4.0, 5.0, 2.0)}
    for scale, program in again.items():
        assert_right(program(TASK, MATRIX, scale), scale)
    assert [program.traces for program in again.values()] == [0, 0, 0, 0, 1]


class Stiff(Muscle):
    """Somebody's muscle."""

    times = 1.0

    def base(self):
        return self.times * Muscle.base(self)


def test_the_program_of_an_own_class_is_traced_in_every_process(x64, tmp_path, monkeypatch):
    """Its code may change without a sign; so what it makes is compared, and then loaded."""
    monkeypatch.setattr(programs, "program_folder", lambda: tmp_path)
    monkeypatch.setattr(programs.jax, "devices", lambda *_: [jax.local_devices()[0]])
    monkeypatch.setattr(programs, "_place", lambda *_: None)  # the tests know their own classes
    compiled, compile_ = [], programs._machine_code
    monkeypatch.setattr(
        programs, "_machine_code", lambda *given: compiled.append(1) or compile_(*given)
    )
    task = TASK.with_parts(muscle=Stiff())
    for times, expected in ((1.0, 1), (1.0, 1), (2.0, 2), (1.0, 2)):
        monkeypatch.setattr(Stiff, "times", times)
        program = Kept(solved)
        np.testing.assert_allclose(
            program(task, MATRIX)["base"], times * np.asarray(TASK.muscle.base()), rtol=1e-12
        )
        assert program.traces == 1 and len(compiled) == expected


def test_what_calls_python_is_not_kept(x64, folder):
    """No other process has that function: JAX's own serialisation refuses it."""

    def calls(x):
        return jax.pure_callback(lambda x: 2.0 * x, x, x)

    for _ in range(2):
        assert Kept(calls)(jnp.ones(2)).tolist() == [2.0, 2.0]
    assert not list(folder.rglob("*"))


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
    assert alone[0] == "1" and not list((tmp_path / "none").glob("jaxmuscle*"))
    last = ended(python(SOLVED, **users))[0].partition("-")
    assert last[0] == "0" and all(found[2] == last[2] for found in (alone, *both))


LOADED = """
import sys, jax, numpy as np, jaxmuscle as jm
from jaxmuscle.response import _rows
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")  # as the tests
power = np.asarray(jm.expected_spectrum(jm.Isometric()).power)
heavy = {"diffrax", "optimistix", "scipy.signal", "scipy.stats", "matplotlib", "rich"}
heavy &= set(sys.modules)
print(_rows._noise_rows.traces, power.tobytes().hex(), len(heavy))
"""


def test_another_process_loads_what_this_one_made(x64):
    """It traces nothing, and imports nothing that only tracing and drawing need."""
    power = np.asarray(jm.expected_spectrum(jm.Isometric()).power)
    assert ended(true_python(LOADED))[0].split() == ["0", power.tobytes().hex(), "0"]


def test_a_folder_that_others_can_open_is_done_without(tmp_path):
    """Nothing is read from it and nothing written; one notice says so."""
    folder = tmp_path / "jax" / "jaxmuscle-programs"
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    twice = SOLVED + "Kept(lambda x: 2.0 * x)(np.ones(2))\n"
    said, errors = ended(python(twice, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "jax")))
    assert said.startswith("1-") and not list(folder.rglob("*"))
    assert errors.count("notice:") == 1 and str(folder) in errors
