"""The Python of README and documentation does what it says; commands in them have the options that
they are given."""

import contextlib
import functools
import io
import re
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
import typer
from processes import ended, true_python

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.fits import _intervals
from jaxmuscle.uncertainty import _posterior_checks as _mixing
from jaxmuscle.uncertainty import _profile

TRUTH = jm.Isometric().replace(harmonic_frequency=6.0, harmonic_amplitude=0.012)
ELSEWHERE = {
    "docs/digitise.md": "data/test_digitised.py",
    "docs/own-muscle.md": "whole/test_hill.py",
    "docs/perturbed.md": "data/test_perturbed.py",
    "docs/perturbed-design.md": "uncertainty/test_input_design.py",
    "docs/study.md": "fits/test_study.py",
    "docs/tutorial-steadiness.md": "commands/test_demo.py",
    "docs/tutorial-study.md": "commands/test_demo.py",
}
BELOW = {"docs/gallery.md"}  # its program is read instead
RUN_HERE = {
    "README.md",
    "docs/coming-from-diffrax.md",
    "docs/coming-from-matlab.md",
    "docs/ensembles.md",
    "docs/fit-a-csv.md",
    "docs/fitting.md",
    "docs/force.md",
    "docs/reflex.md",
    "docs/how-to/own-noise.md",
    "docs/how-to/own-optimiser.md",
    "docs/how-to/report-results.md",
    "docs/identifiability.md",
    "docs/machine-learning.md",
    "docs/python.md",
    "docs/recordings.md",
    "docs/reference/figures.md",
    "docs/scaling.md",
    "docs/tutorial.md",
    "docs/uncertainty.md",
}
# Data with a rhythm are also tried with a tremor: two more programs of each fit, which
# fits/test_rungs.py has.
FEW = "rungs=0, starts=16, seeds=16, check_seeds=16"
OF_TRIALS = {"trials.target())": f"trials.target(), {FEW})"}


def jitted(*functions: str) -> dict[str, str]:
    """What is called outside `jit` is traced anew each time: the gradient of the README alone is
    left so."""
    return {f"{function}(": f"jax.jit({function})(" for function in functions}


# The bundled spectrum with the usual settings (see `write_plain`), and its fit, of which is asked
# what to measure next.
PLAIN = 'jm.load_target("plain.toml")'
PLAIN_FIT = f"jm.fit(({PLAIN}).task(), {PLAIN}, {FEW})"
IN_PYTHON = {
    "seeds=100_000": "seeds=100",
    "seeds=1000)": "seeds=100)",
    # as docs/ensembles.md has it
    "summary = jm.ensemble(\n    result.task": "summary = jm.ensemble(\n    jm.Isometric()",
    "jm.identifiability(result)": f"jm.identifiability({PLAIN_FIT})",
    "jm.uncertainty.design_input(result,": f"jm.uncertainty.design_input({PLAIN_FIT},",
} | jitted(
    "jax.grad(variation)", "jax.grad(lambda v: jm.expected_spectrum(rebuild(v)).proportional[10])"
)
FULL = "starts=32, seeds=16, check_seeds=16"
# What a notebook does as the README does is done as there. The ladder, tremor and all, is climbed
# in fits/test_rungs.py.
IN_NOTEBOOKS = {
    "01-first-fit": {"fix=held": f"fix=held, {FEW}"},
    "02-monte-carlo-ensemble": {"seeds=1000": "seeds=100"},
    pages.IN_A_KERNEL: {
        "plt.show()": "None"  # where there is no screen
    },
    "04-from-recording-to-parameters": {"target, starts=40": f"target, {FEW}"},
    "05-uncertainty-and-noise-colour": {
        f"target, {FULL}": "target",
        "task, target, noises=noises, groups=3": ("jm.Isometric(), target"),
        f"jm.Isometric(), measured, {FULL}": f"person, measured, {FEW}",
        "hand = result.task": f"result = {PLAIN_FIT}\nhand = result.task",
        # In the precision of the fit's own simulations: one program.
        "trials = jm.ensemble(": "with jax.enable_x64(True):\n    trials = jm.ensemble(",
        "np.mean(trials.power": "np.mean(np.asarray(trials.power)",
    },
    "06-gradients-and-design": {
        "jax.jvp(spread, (k_w,), (1.0,))": "jax.jit(lambda k: jax.jvp(spread, (k,), (1.0,)))(k_w)",
        # The slopes of the force are known, from a cell before.
        "jax.jacfwd(log_power)(centre, task)": (
            "(slopes if task is person else jax.jacfwd(log_power)(centre, task))"
        ),
        **jitted("jax.grad(spread)"),
    },
    "07-your-own-muscle": {
        "starts=16": FEW,
        '"paper\'s, as printed": jm.Isometric(),': "",  # the muscle of all other pages
        **jitted("jax.vmap(variation, in_axes=(None, 0))"),
        "slope = jax.grad(": "slope = jax.jit(jax.grad(",
        ")(60.0)": "))(60.0)",
    },
    "08-perturb-and-measure": {
        "rungs=0, check_seeds=0": "rungs=0, check_seeds=0, starts=8",
        "starts=16)": "starts=4, seeds=0, check_seeds=0)",
    },
}
CALLED_OFTEN = (
    "fit",
    "fit_cohort",
    "ensemble",
    "profile",
    "posterior",
    "identifiability",
    "comparison.compare_noise",
    "checks.goodness",
    "checks.bootstrap",
    "uncertainty.design_input",
    "response.sensitivity",
)
FEWER: dict[str, dict[str, Any]] = {
    "ensemble": {"chunk": 16},  # one program for any number of seeds
    "fit_cohort": {"starts": 8},
    "goodness": {"replicates": 19},
    "bootstrap": {"replicates": 4},
    "compare_noise": {"groups": 3, "noises": ("white", "band-limited", "ornstein-uhlenbeck")},
    "posterior": {"chains": 2, "draws": 150, "warmup": 200},
}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_plain("plain.toml")
    yield
    plt.close("all")


@functools.cache
def recorded(key):
    """A trial as a force sensor writes it: 2048 Hz, rest, ramp, hold of a known task, release."""
    run = jm.simulate(TRUTH.settled(), jax.random.key(key), duration=40.0, rate=1000.0)
    held = np.interp(np.arange(40 * 2048) / 2048, run.time, np.asarray(run.output, dtype=float))
    level = held.mean()
    force = np.concatenate(
        [np.zeros(4096), level * np.linspace(0, 1, 4096), held, level * np.linspace(1, 0, 2048)]
    )
    rows = "".join(f"{k / 2048:.6f},{f:.6f}\n" for k, f in enumerate(force))
    return "time,force\n" + rows


def write_recordings():
    for number, name in enumerate(("trial.csv", "trial1.csv", "trial2.csv", "trial3.csv")):
        Path(name).write_text(recorded(5 + number), encoding="utf-8")


def write_tremor(path):
    """What an accelerometer writes: 1000 Hz, in g, with gravity."""
    task = jm.PrescribedForce(observe="acceleration").settled()
    run = jm.simulate(task, jax.random.key(6), duration=30.0, rate=1000.0)
    rows = "".join(
        f"{t:.3f},{a / 9.81 + 0.5:.8f}\n"
        for t, a in zip(run.time, np.asarray(run.output), strict=True)
    )
    Path(path).write_text("time,acc\n" + rows, encoding="utf-8")


def write_plain(path):
    """The bundled spectrum, as if its signal had been sampled and low-passed as by the usual
    settings.

    Every choice of settings has programs of its own, and other tests make those of the usual ones.
    What the pages say is the same.
    """
    text = (pages.ROOT / "src/jaxmuscle/targets/vastus-lateralis-26mvc.toml").read_text(
        encoding="utf-8"
    )
    bundled, settings = text.split("[settings]")
    assert "filtered" in settings
    Path(path).write_text(bundled, encoding="utf-8")


def write_spectrum(path, seed=0, task=None):
    """Twelve Welch segments of a known task."""
    expected = np.asarray(jm.expected_spectrum(TRUTH if task is None else task).proportional)
    power = expected * np.random.default_rng(seed).chisquare(24, expected.size) / 24
    frequency = jm.SpectrumSettings().frequency
    rows = "".join(
        f"{f:.6f},{p:.6g}\n" for f, p in zip(frequency, power / power.sum(), strict=True)
    )
    Path(path).write_text("frequency_hz,proportional_power\n" + rows, encoding="utf-8")


def test_every_page_with_python_is_run():
    with_python = {pages.name_of(page) for page in pages.PAGES if pages.blocks(page)}
    assert with_python == RUN_HERE | BELOW | set(ELSEWHERE)
    for page, test in ELSEWHERE.items():
        text = (pages.ROOT / "tests" / test).read_text(encoding="utf-8")
        assert re.search(rf'pages\.run\(\s*"{page}"', text), f"{test} does not run {page}"


@pytest.fixture(scope="module", autouse=True)
def once():
    """Pages and notebooks do the same first fit, a dozen times: what they call with the same
    arguments is run once."""
    done = pages.Once()
    with pytest.MonkeyPatch.context() as patch:
        # Two chains of 150 draws: R-hat scatters by some 0.02 about 1. test_posterior.py draws
        # chains that must mix.
        for name, bound in (("MIXED", 1.2), ("NEARLY", 1.4), ("EFFECTIVE", 5), ("DIVERGING", 0.05)):
            patch.setattr(_mixing, name, bound)
        # Profiles of few points, along one of several maxima, and intervals of few steps. No page
        # says what these end at: uncertainty/test_posterior.py and fits/test_intervals.py do.
        for name, value in (("STEPS", np.array([1.2, 2.5])), ("FAR", np.log([30.0])), ("MODES", 1)):
            patch.setattr(_profile, name, value)
        patch.setattr(_intervals, "TEST_TURNS", 3)
        for called in CALLED_OFTEN:
            wing, _, name = called.rpartition(".")
            home = getattr(jm, wing) if wing else jm
            patch.setattr(home, name, done.of(name, getattr(home, name), **FEWER.get(name, {})))
        yield done


@pytest.fixture(scope="module")
def readme(once, tmp_path_factory):
    """The folder in which the blocks of the README are run, and what they leave behind."""
    folder = tmp_path_factory.mktemp("readme")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_recordings()
        return folder, pages.run("README.md", {}, OF_TRIALS)


@pytest.fixture(scope="module")
def in_python(once, readme):
    """What the README leaves behind, and the page that goes on from it."""
    folder, names = readme
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for seed, name in enumerate("abc"):
            write_spectrum(f"{name}.csv", seed)
        write_plain("plain.toml")
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            names = pages.run("docs/python.md", names, IN_PYTHON)
    return names | {"returned": dict(once.last), "printed": printed}


def test_readme(readme):
    """Every block of Python, on recordings of one person."""
    folder, names = readme
    mine = names["mine"]
    assert (
        names["slope"] != 0
        and mine.success
        and abs(mine.parameters["harmonic_frequency"].value - 6.0) < 0.25 * 0.390625
    )
    variation = mine.derived["model_coefficient_of_variation"]
    # A fourth trial of the same person, known to √3 times the error of the mean of three.
    recording = jm.load_recording(folder / "trial.csv").steady()
    (fourth,) = recording.target().coefficient_of_variation
    assert variation.stderr is not None and abs(variation.value - fourth) < 4 * 2 * variation.stderr


@pytest.mark.slow
def test_the_page_for_python(in_python):
    """The programs of the design document, as the README and its page for Python have them."""
    result, found = in_python["result"], in_python["found"]
    assert result.success and result.chi2_per_bin <= 1.3
    assert "left out: white" in in_python["printed"].getvalue()
    assert found.divergences <= 6  # of 300; whole chains have none
    summary = found.summary()
    for name, derived in result.derived.items():
        # the least-squares estimate lies well inside the posterior: 3 of 300 draws beyond it
        if derived.stderr is not None:
            draws = found.quantities[name]
            low, high = np.quantile(draws, [0.01, 0.99])
            assert low < derived.value < high and summary[name]["low"] < summary[name]["high"], name


@pytest.mark.slow
def test_ensembles(in_python):
    fewer = {"seeds=100_000": "seeds=64", "seeds=5_000": "seeds=48", "seeds=1000": "seeds=32"}
    pages.run("docs/ensembles.md", in_python, fewer)
    assert Path("runs.zarr").exists() and Path("persons.zarr").exists()


@pytest.mark.slow
def test_uncertainty(in_python):
    # the same draws, which take a minute
    assert pages.run("docs/uncertainty.md")["found"] is in_python["found"]
    assert Path("posterior.nc").exists()


@pytest.mark.slow
def test_tutorial_and_report():
    # The target is the bundled one, written and read again.
    few = {
        "target.task(), target)": f"target.task(), target, {FEW})",
        "fix=known": f"fix=known, {FEW}",
    }
    names = pages.run("docs/tutorial.md", {}, few)
    assert "harmonic_frequency" in names["sharper"].free and jm.load_result("mine.json").success
    reported = pages.run("docs/how-to/report-results.md")["reported"]
    assert {"corner_frequency", "coefficient_of_variation"} <= set(reported["quantity"]) and Path(
        "table.csv"
    ).exists()
    few = {"mean_force=(40.5, 0.8)": f"mean_force=(40.5, 0.8), {FEW}"}
    assert pages.run("docs/fitting.md", {}, few)["in_newtons"].derived[
        "model_mean"
    ].value == pytest.approx(40.5, abs=3 * 0.8)


@pytest.mark.slow
def test_force():
    """The share that the page states, and a fit that stays on the lowest rung."""
    names = pages.run("docs/force.md")
    near = names["tremor"][names["near"]].sum() / names["tremor"].sum()
    text = (pages.ROOT / "docs" / "force.md").read_text(encoding="utf-8")
    assert f"It prints {near:.2f}." in text
    assert [rung.number for rung in names["result"].ladder] == [0]


@pytest.mark.slow
def test_identifiability():
    write_spectrum(
        "displacement.csv", task=TRUTH.as_task(jm.PrescribedForce, P_w=TRUTH.P_w, F_ext=2.93)
    )
    # What tests/uncertainty/test_several.py runs on less.
    fewer = {
        'jm.load_target("vastus-lateralis-26mvc")': PLAIN,
        "target.task(), target)": f"target.task(), target, {FEW})",
        "(2.93, 0.06)},": "(2.93, 0.06)}, starts=16, seeds=16, check_seeds=16,",
        'jm.profile(joint, "K_w0")': 'joint["K_w0"]',
        "jm.checks.bootstrap(joint)": "",
        "jm.posterior(joint, key=0)": "",
        "jm.checks.goodness(joint)": "jm.checks.goodness(joint, replicates=19)",
    }
    names = pages.run("docs/identifiability.md", {}, fewer)
    assert len(names["report"].designs) == 4 and jm.load_result("joint.json").success


@pytest.mark.slow
def test_own_data():
    write_spectrum("mine.csv")
    once = {"target.task(), target)": f"target.task(), target, {FEW})"}
    assert pages.run("docs/fit-a-csv.md", {}, once)["target"].segments == (6,) * 10
    write_recordings()
    write_tremor("tremor.csv")
    # With a tremor at once: the program of the fit that fits/test_tremor.py makes.
    few = "rungs=0, starts=8, seeds=0, check_seeds=0"
    quick = {
        "tremor.task(), tremor": f"jm.model.on_rung(tremor.task(), 2), tremor, {few}",
        "held.target())\n": f"held.target(), {FEW})\n",
        "fit(jm.Isometric(), target)": f"fit(jm.Isometric(), target, {FEW})",
    }
    names = pages.run("docs/recordings.md", {}, quick)
    assert names["result"].success and names["moving"].task.quantity == "acceleration"
    assert Path("trial.png").exists()


@pytest.mark.slow
def test_coming_from_elsewhere():
    pages.run("docs/coming-from-matlab.md")
    whole = jitted(
        "jax.jacfwd(last)", "jax.grad(last)", "jax.grad(lambda v: jnp.sum(misfit(v) ** 2))"
    )
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of two lengths
        names = pages.run("docs/coming-from-diffrax.md", {}, whole)
        first = float(names["loss"]((names["logs"], names["Sensor"](jax.numpy.asarray(-5.0)))))
    assert float(names["value"]) < 0.9 * first  # the loop of optax went downhill
    assert names["heights"][-1] < names["heights"][0] - 10  # and that of every number
    assert names["many"].shape == (8,) and np.all(np.isfinite(names["solution"].ys))
    # Welch power of one recording scatters by half, so the mean of eight by less than a fifth.
    assert 0.2 < names["many"].mean() / float(jm.expected_spectrum(jm.Isometric()).power[10]) < 1.8
    assert set(names["slopes"]) == {"c_w", "noise_K_z"}
    # Levenberg-Marquardt stops within 1e-2 of a coordinate
    assert names["better"]["c_w"] == pytest.approx(191.9, rel=0.01)


@pytest.mark.slow
def test_own_optimisers():
    """scipy finds a minimum, a sampler draws, as the page says."""
    try:
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of two lengths
            # The second descent with the slopes of the first: those of its own residuals differ
            # only in what weighs them.
            names = pages.run(
                "docs/how-to/own-optimiser.md",
                {},
                {"jax.jit(jax.jacfwd(closer.residuals))": "slopes"},
            )
        problem = names["problem"]
        assert problem.log_density(names["theta"]) > problem.log_density(problem.start)
    finally:
        jax.config.update("jax_enable_x64", False)
    assert names["found"].success and len(names["draws"]) == 20


LEARNING = "docs/machine-learning.md"


@pytest.mark.slow
def test_machine_learning():
    """Both networks learn in the first steps."""
    few = {
        "range(1000)": "range(100)",
        "20_000": "2_000",
        "key(2), 3000)": "key(2), 200)",
        "coefficient_of_variation=False, rungs=0": f"coefficient_of_variation=False, {FEW}",
        "num_steps=300": "num_steps=20",
        "key(1), 500)": "key(1), 4)",
    }
    try:
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of two lengths
            names = pages.run(LEARNING, {}, few)
        stiffness = 200.0 * np.exp([float(names["network"](x / 0.02)) for x in (0.005, 0.02)])
        # a constant 200 N/m is off by half at 20 mm
        np.testing.assert_allclose(stiffness, [212.5, 400.0], rtol=0.2)
        given = names["inputs"], names["vectors"]
        untrained = names["eqx"].nn.MLP(30, 4, 128, 2, key=names["keys"][2])
        assert names["loss"](names["reader"], *given) < names["loss"](untrained, *given) - 0.5
        assert all(np.all(each > 0) and len(each) == 4 for each in names["draws"].values())
    finally:
        jax.config.update("jax_enable_x64", False)


@pytest.mark.slow
@pytest.mark.parametrize("package", ["numpyro", "dask.distributed"])
def test_machine_learning_with_what_the_tests_do_not_install(package):
    pytest.importorskip(package, reason=f"the tests do not install {package}")
    head = pages.blocks(pages.ROOT / LEARNING)[0]
    code = next(b for b in pages.blocks(pages.ROOT / LEARNING, "py") if package in b)
    for old, new in (
        ("num_warmup=300, num_samples=300", "num_warmup=10, num_samples=10"),
        ("target.task(), target)", f"target.task(), target, {FEW})"),
    ):
        code = code.replace(old, new)
    printed, _ = ended(true_python(head + code, cwd=Path.cwd()))
    assert {"numpyro": "divergences", "dask.distributed": "0.013"}[package] in printed


@pytest.mark.slow
def test_own_noise():
    # The ensemble has the precision of a fit's simulations, which then needs none
    # (model/test_noise.py has the single one).
    ensemble = (
        "runs = jm.ensemble(task, jax.random.key(0), seeds=16)",
        "estimate = runs.mean_spectrum()",
    )
    few = {
        "\n".join(ensemble): "\n    ".join(("with jax.enable_x64(True):", *ensemble)),
        "rungs=0, starts=8": "rungs=0, starts=8, seeds=0, check_seeds=0",
    }
    names = pages.run("docs/how-to/own-noise.md", {}, few)
    assert names["result"].success and 0.05 < names["result"].task["noise_corner"] < 20
    assert (
        np.max(np.abs(names["estimate"].nonlinearity)) < 0.05 and np.isfinite(names["slope"]).all()
    )


@pytest.mark.slow
def test_figures_in_given_axes():
    figure = pages.run("docs/reference/figures.md")["figure"]
    assert len(figure.axes) == 5 and len(figure.subfigs) == 1


@pytest.mark.slow
def test_scaling():
    names = pages.run("docs/scaling.md", {"jm": jm, "task": jm.Isometric()})
    assert names["weak"]["P_w"] < names["strong"]["P_w"]


@pytest.mark.slow
@pytest.mark.parametrize("path", pages.NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_run(path, once):
    """Their cells one after another, here: what they have in common with the pages is not compiled
    and fitted again."""
    try:
        with plt.rc_context():
            pages.run_cells(path, IN_NOTEBOOKS.get(path.stem))
            assert len(plt.get_fignums()) >= 2
    finally:
        jax.config.update("jax_enable_x64", False)


OPTIONS = {
    name: {option for parameter in command.params for option in parameter.opts}
    for name, command in typer.main.get_group(app).commands.items()
}


@pytest.mark.parametrize("page", pages.PAGES, ids=pages.name_of)
def test_commands_in_pages_exist_with_their_options(page):
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"(?:^ +|`)jaxmuscle (?!COMMAND)([a-z][^`\n]*)", text, re.MULTILINE):
        command, _, rest = line.partition("  #")[0].partition(" ")
        unknown = (
            set(re.findall(r"(?<!\S)\[?(--[a-z][\w-]*)", rest)) - OPTIONS[command] - {"--help"}
        )
        assert not unknown, line


# --- the gallery

GALLERY = pages.module(pages.ROOT / "docs" / "gallery.py")
FIGURES = [figure for section in GALLERY.SECTIONS for figure in section.figures]


def test_the_gallery_shows_every_figure():
    assert GALLERY.PAGE.read_text(encoding="utf-8") == GALLERY.page(), (
        "run `python docs/gallery.py`"
    )
    public = {name for name in jm.plot.__all__ if callable(getattr(jm.plot, name))}
    public -= {"styled", "schematic"}  # docs/model.md shows the schematic
    shown = {Path(figure.file).stem for figure in FIGURES}
    assert public <= shown
    sizes = [(GALLERY.HERE / figure.file).stat().st_size for figure in FIGURES]
    assert max(sizes) < 200_000 and sum(sizes) < 2_000_000


def unlabelled(figure):
    """Axes with numbers but no words at them. (Where they stand is no matter here:
    plot/test_plot.py has the layout.)"""
    figure.set_layout_engine("none")
    figure.draw_without_rendering()
    for ax in figure.get_axes():
        for axis in (ax.xaxis, ax.yaxis) if ax.axison else ():
            texts = [
                tick.label1.get_text()
                for tick in axis.get_major_ticks()
                if tick.label1.get_visible()
            ]
            numbers = [
                text
                for text in texts
                if any(c.isdigit() for c in text) and not any(c.isalpha() for c in text)
            ]
            if numbers and not axis.get_label().get_text():
                yield ax.get_title("left") or ax.get_title(), axis.axis_name, numbers


@pytest.mark.slow
def test_the_gallery_is_drawn_by_its_code_with_units_and_in_given_axes(in_python, monkeypatch):
    """The statements of the README's results are those of the gallery: what takes minutes is not
    done twice."""
    for called in CALLED_OFTEN:
        wing, _, name = called.rpartition(".")
        if name in ("fit", "fit_cohort", "ensemble", "profile"):
            continue
        home = getattr(jm, wing) if wing else jm
        monkeypatch.setattr(home, name, lambda *_, found=in_python["returned"][name], **__: found)
    smaller = {
        "seeds=200)": "seeds=100)",
        "seeds=2000": "seeds=100",
        "seeds=100), strict": "seeds=16), strict",
        # Recordings as long as others here.
        "jm.ensemble(result.task.settled(), key, seeds=5, duration=20.0)": "runs",
        "enumerate(np.asarray(seeds.output))": "enumerate(np.asarray(seeds.output)[:5])",
        "key, duration=60.0, rate=1000.0": "key, duration=40.0, rate=1000.0",
        "window=(2.0, 60.0)": "window=(2.0, 40.0)",
    }
    for old in smaller:
        assert any(old in section.setup for section in GALLERY.SECTIONS), (
            f"the gallery says no longer {old}"
        )
    names, few = dict(in_python), FEW.replace("starts=16", "starts=4")
    # the paper's figures and a study, which fits/test_study.py does
    for section in GALLERY.SECTIONS[:-2]:
        exec(
            functools.reduce(
                lambda setup, old: setup.replace(old, smaller[old]), smaller, section.setup
            ),
            names,
        )
        for figure in section.figures:
            code = figure.code.replace(", minute)", f", minute, {few})").replace(
                "in pair})", f"in pair}}, {few})"
            )
            # this profile is there
            made = eval(code.replace("band_8_12", "corner_frequency"), names)
            whole = getattr(made[0] if isinstance(made, tuple) else made, "figure", made)
            assert not list(unlabelled(whole)), figure.file
            plt.close("all")
    for draw, result in (
        ("fit", names["result"]),
        ("simulation", names["runs"]),
        ("posterior", names["found"]),
        ("chains", names["found"]),
        ("comparison", jm.comparison.compare_noise()),
        ("identifiability", jm.identifiability()),
        ("goodness", jm.checks.goodness()),
        ("bootstrap", jm.checks.bootstrap()),
        ("cohort", names["cohort"]),
        ("recording", names["recording"]),
        ("trials", jm.data.Trials(names["trials"])),
    ):
        figure, (mine, place) = plt.subplots(1, 2, figsize=(20.0, 12.0), layout="constrained")
        part = getattr(jm.plot, draw)(result, ax=place)
        figure.draw_without_rendering()
        assert (
            part.figure is figure
            and mine in figure.axes
            and place not in figure.axes
            and len(figure.axes) > 1
        ), draw
        plt.close(figure)
