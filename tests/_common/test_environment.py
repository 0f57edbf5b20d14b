"""The surroundings of a fit: double precision, one thread of linear algebra, everything as before
afterwards. The folder of compiled programs, which are code."""

import contextlib
import os
import stat
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import threadpoolctl
from processes import ended, true_python

from jaxmuscle._common import environment
from jaxmuscle._common.environment import fitting, program_folder

OUT = Path(__file__).parents[2] / ".test-out"


def threads():
    np.linalg.inv(np.eye(2))
    return [
        one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"
    ]


def test_linear_algebra_has_one_thread_until_the_last_fit_has_ended():
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        assert set(before) == {2}
        first, second = contextlib.ExitStack(), contextlib.ExitStack()
        first.enter_context(fitting())
        second.enter_context(fitting())
        assert set(threads()) == {1} and jax.config.jax_enable_x64
        second.close()
        assert set(threads()) == {1}
        first.close()
        assert threads() == before and not jax.config.jax_enable_x64


def test_after_an_error_all_is_as_before():
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        with pytest.raises(RuntimeError, match="stop"), fitting():
            raise RuntimeError("stop")
        assert set(threads()) == {2} and not jax.config.jax_enable_x64


# --- the folder of compiled programs


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of JAX's own cache, in which that of the programs lies."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)


def said(caplog):
    return [record.getMessage() for record in caplog.records]


def assert_refused(caplog, reason):
    """Not used, which is said once."""
    for _ in range(3):
        assert program_folder() is None
    (notice,) = said(caplog)
    assert notice.startswith("notice: ") and reason in notice


def test_programs_lie_beside_those_of_jax_or_in_the_users_folder(cache, tmp_path, monkeypatch):
    assert program_folder() == cache / "jaxmuscle-programs"
    monkeypatch.setattr(
        environment.platformdirs, "user_cache_path", lambda name: tmp_path / "user" / name
    )
    jax.config.update("jax_compilation_cache_dir", None)
    assert program_folder() == tmp_path / "user" / "jaxmuscle" / "programs"
    assert jax.config.jax_compilation_cache_dir is None
    jax.config.update("jax_compilation_cache_dir", "gs://somewhere")
    assert program_folder() is None
    monkeypatch.setenv("JAXMUSCLE_CACHE", "off")
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "off"))
    assert program_folder() is None and not (tmp_path / "off").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="modes are those of POSIX")
def test_what_is_made_is_for_the_user_alone(cache, caplog):
    before = os.umask(0)
    try:
        folder = program_folder()
    finally:
        os.umask(before)
    assert folder is not None
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder, cache)] == [0o700, 0o700]
    assert program_folder() == folder and not said(caplog)


@pytest.mark.skipif(sys.platform == "win32", reason="modes are those of POSIX")
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o755, 0o1777])
def test_a_folder_that_others_can_open_is_not_used(cache, caplog, mode):
    folder = cache / "jaxmuscle-programs"
    folder.mkdir(parents=True)
    folder.chmod(mode)
    assert_refused(caplog, f"{folder} is not used")


@pytest.mark.skipif(sys.platform == "win32", reason="modes are those of POSIX")
@pytest.mark.parametrize(
    ("mode", "alone", "used"),
    [
        (0o755, False, True),
        (0o1777, False, True),  # as /tmp: what is in it can be replaced by its owner only
        (0o775, True, True),  # the group that bears the user's name
        (0o777, True, False),
        (0o775, False, False),
    ],
)
def test_nobody_else_may_replace_the_folder(cache, caplog, monkeypatch, mode, alone, used):
    import grp
    import pwd

    above = cache.parent / "above"
    above.mkdir()
    above.chmod(mode)
    name = pwd.getpwuid(os.geteuid()).pw_name
    members = [name] if alone else [name, "somebody"]
    monkeypatch.setattr(grp, "getgrgid", lambda _: SimpleNamespace(gr_name=name, gr_mem=members))
    jax.config.update("jax_compilation_cache_dir", str(above / "cache"))
    if used:
        assert program_folder() == above / "cache" / "jaxmuscle-programs" and not said(caplog)
    else:
        assert_refused(caplog, f"others can write to {above}")


@pytest.mark.skipif(sys.platform == "win32", reason="users are those of POSIX")
@pytest.mark.parametrize("which", ["cache/jaxmuscle-programs", "cache", "."])
def test_what_belongs_to_another_user_is_not_used(cache, caplog, monkeypatch, which):
    assert program_folder() is not None
    theirs, look = cache.parent / which, Path.lstat

    def seen(path):
        found = look(path)
        return os.stat_result((*found[:4], 54321, *found[5:])) if path == theirs else found

    monkeypatch.setattr(Path, "lstat", seen)
    assert_refused(caplog, f"{theirs} belongs to another user")


@pytest.mark.skipif(sys.platform == "win32", reason="a link needs a right of its own")
def test_a_link_in_place_of_the_folder_is_not_followed(cache, caplog):
    cache.mkdir(mode=0o700)
    (cache.parent / "own").mkdir(mode=0o700)
    (cache / "jaxmuscle-programs").symlink_to(cache.parent / "own")
    assert_refused(caplog, "no folder that only you can open")


@pytest.mark.skipif(sys.platform == "win32", reason="a link needs a right of its own")
def test_a_link_above_the_folder_is_looked_through(cache, caplog):
    """What counts is where it leads; and it is asked for by that name, so that a link that is
    changed changes nothing."""
    (cache.parent / "own").mkdir(mode=0o700)
    cache.symlink_to(cache.parent / "own")
    assert program_folder() == cache.parent / "own" / "jaxmuscle-programs"
    (cache.parent / "own").chmod(0o777)
    assert_refused(caplog, f"others can write to {cache.parent / 'own'}")


@pytest.mark.parametrize("content", ["text", None])
def test_what_cannot_be_a_folder_is_done_without(cache, caplog, content):
    if content is None:
        cache.symlink_to(cache)
    else:
        cache.write_text(content)
    assert_refused(caplog, "compiled programs are not kept")


def test_on_windows_there_is_nothing_to_look_at(cache, caplog, monkeypatch):
    """Modes say nothing there, and there are no user numbers: Python makes a folder of mode 0700
    for its user alone."""
    monkeypatch.setattr(environment.sys, "platform", "win32")
    monkeypatch.delattr(os, "geteuid", raising=False)
    cache.mkdir(mode=0o777)
    assert program_folder() == cache.resolve() / "jaxmuscle-programs" and not said(caplog)


# --- JAX's own settings

SETTINGS = """
import os, sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
import jaxmuscle as jm

def all_files():
    return sorted(Path(os.environ["XDG_CACHE_HOME"]).rglob("*"))

before = dict(jax.config.values)
task = jm.Isometric()
kind = sys.argv[1]
if kind == "simulate":
    jm.simulate(task, 0, duration=2.0)
elif kind == "spectrum":
    jm.expected_spectrum(task)
    jm.data.steadiness(jm.Recording(np.random.default_rng(0).normal(5.0, 0.1, 4000), 100.0))
elif kind == "speed":
    jm.ensembles.measure(task, 4, 0.2)
else:
    found = jm.fit(task, jm.load_target("vastus-lateralis-26mvc"), free=("c_w", "noise_K_w"),
                   starts=2, seeds=8, check_seeds=0, rungs=0, max_steps=4)
    jm.identifiability(found)
    jm.posterior(found, chains=2, draws=100, warmup=20)
changed = {name for name, value in jax.config.values.items() if value != before[name]}

files = all_files()

@jax.jit
def own(x):
    for _ in range(300):
        x = jnp.sin(x) @ x
    return x

own(np.ones((3, 3)))
print(len(files) > 4, changed, [path for path in all_files() if path not in files])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the folder is named by a variable of Linux")
@pytest.mark.parametrize(
    "kind", ["simulate", "spectrum", "speed", pytest.param("fit", marks=pytest.mark.slow)]
)
def test_settings_of_jax_stay_as_they_are(kind):
    """What a user compiles is not kept in the folder of the programs."""
    users = {"XDG_CACHE_HOME": str(OUT / "user"), "JAX_COMPILATION_CACHE_DIR": ""}
    told = ended(true_python(SETTINGS, kind, **users), seconds=600)[0]
    assert told.split("\n")[-2] == "True set() []"
