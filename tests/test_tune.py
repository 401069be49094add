"""Gains are found for a stated goal, alike whoever does the work."""

import functools
import json
import math

import numpy as np
import pytest
import yaml

from pea_cli.cli import main
from pea_core import config
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab import proposal, tune, tune_results
from pea_lab.guard import margins
from pea_report import overview

PLANTS = {"as given": (), "K +10 %": ("plant.K=0.156",)}
RANGES = {"controller.P": (2e-4, 8e-3), "controller.m": (2000.0, 20000.0)}


@pytest.fixture(scope="module")
def experiment():
    others = {"controller": "recommended", "observer": "extended_state"}
    sets = ["plant.delay_samples=1", "plant.sensor.noise_nm=0.7"]
    return experiments.load("fig10_sine_150hz", sets, 0.03, None, others)


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """Few and short runs: compiling takes longer."""
    monkeypatch.setenv("PEA_COMPILE", "0")


def at_once(tasks):
    return [tune.evaluate(task) for task in tasks]


def found(experiment, workers, seed=1, trials=12, least=1.3):
    goal = tune.Goal(least, PLANTS, RANGES)
    return tune.tune(experiment, goal, trials, seed, workers, lambda done, best: None)


@pytest.fixture(scope="module")
def alone(experiment):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PEA_COMPILE", "0")
        return found(experiment, at_once)


def test_the_best_keeps_the_margin_on_every_plant_and_is_no_worse_than_before(experiment, alone):
    best = tune.best(alone)
    assert best.error_nm <= alone[0].error_nm
    for sets in PLANTS.values():
        there = experiments.load("fig10_sine_150hz", sets, 0.03)
        nodes = {n: experiment.nodes[n] for n in ("observer", "controller")}
        there = type(there)(there.name, there.about, {**experiment.nodes, **nodes})
        assert margins(tune.varied(there, best.values), 4.0).gain >= 1.3


def test_the_first_candidate_is_what_the_experiment_has(alone):
    assert alone[0].values == {"controller.P": 0.0012, "controller.m": 5000.0}


def test_another_seed_looks_elsewhere(experiment, alone):
    other = found(experiment, at_once, seed=2, trials=4)
    assert [trial.values for trial in other[1:]] != [trial.values for trial in alone[1:4]]


def test_two_processes_find_the_same(experiment, alone):
    with tune.Processes(2) as workers:
        assert found(experiment, workers) == alone


def test_a_dask_cluster_of_two_workers_finds_the_same(experiment, alone):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
        tune.Cluster(cluster.scheduler_address) as workers,
    ):
        assert found(experiment, workers) == alone


def test_where_nothing_keeps_the_margin_the_largest_is_told(experiment):
    goal = tune.Goal(3.9, PLANTS, {"controller.P": (5e-3, 8e-3)})
    trials = tune.tune(experiment, goal, 3, 1, at_once, lambda done, best: None)
    best = tune.best(trials)
    assert not best.good
    assert best.margin == max(trial.margin for trial in trials)


@pytest.mark.parametrize("error", [[math.inf], [math.inf, math.inf], [math.nan, 0.0], [0.0]])
def test_candidates_without_an_error_are_drawn(experiment, error, tmp_path):
    trials = [
        tune.Trial({"controller.P": 0.1 + k}, e, e, e, 1.0, 1.0, math.nan, False)
        for k, e in enumerate(error)
    ]
    goal = tune.Goal(1.3, PLANTS, {"controller.P": (0.1, 2.0)})
    tune_results.write(tmp_path, experiment, goal, trials, 1)
    overview.tuned(tmp_path / "tune.html", "name", goal, trials)
    assert not (tmp_path / "controller.yaml").exists()
    assert {"tune.png", "tune.html"} <= {path.name for path in tmp_path.iterdir()}


def test_an_unstable_candidate_is_not_run(experiment):
    text = config.dump(experiment.sections())
    (score,) = tune.evaluate(tune.Task(text, (), ("controller.P",), ((0.05,),)))
    assert math.isinf(score.error_nm)
    assert score.margin < 1.0


def test_the_preset_that_is_written_has_the_gains_and_only_them(experiment, alone, tmp_path):
    goal = tune.Goal(1.3, PLANTS, RANGES)
    tune_results.write(tmp_path, experiment, goal, alone, 1)
    values = config.read(tmp_path / "controller.yaml", config.NODES)["controller"]
    best = tune.best(alone)
    assert (values["P"], values["m"]) == tuple(best.values.values())
    assert not {"K", "omega_n", "voltage_max", "delay_samples", "T_s", "tuning.guard"} & set(values)
    again = experiments.load(
        "fig9_hysteresis_10hz", (), None, None, {"controller": str(tmp_path / "controller.yaml")}
    )
    assert best.values["controller.P"] == again.nodes["controller"].params.P
    assert len((tmp_path / "trials.csv").read_text().splitlines()) == len(alone) + 1
    assert (tmp_path / "tune.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("controller.P", "write NODE.NAME=LOW:HIGH"),
        ("plant.K=1:2", "unknown node"),
        ("controller.p=1:2", "did you mean"),
        ("controller.P=2:1", "must be below"),
        ("controller.P=0:100", "0 to 10"),
        ("controller.feedforward=0:1", "is no real number"),
    ],
)
def test_a_range_that_cannot_be_is_refused(experiment, text, said):
    with pytest.raises(ParameterError, match=said):
        tune.range_of(experiment, text)


def test_gains_from_a_model_that_keep_no_margin_write_nothing(tmp_path, capsys, monkeypatch):
    from pea_cli.cli import main
    from pea_lab import proposal

    tried = {"estimator.eps_rate_walk": 3e2, "estimator.input_noise": 0.2, "effort": 500.0}
    few = {name: (lambda model, value=value: (value,)) for name, value in tried.items()}
    monkeypatch.setitem(proposal.STARTS, type(law()), few)
    propose = proposal.propose
    monkeypatch.setattr(proposal, "propose", lambda *given: propose(*given, tries=3))
    there = tmp_path / "out"
    asked = ("tune", "resonant", "--from-model", "--modulus", "0.98", "--out", str(there))
    assert main([*asked]) == 3
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "no candidate keeps the modulus margin of the model" in told.err
    assert not there.exists()


def law():
    return experiments.load("resonant", []).nodes["controller"].params


@pytest.fixture
def measured(tmp_path):
    """A frequency response of two modes, one command and 1.4 samples of V late, as a file."""
    from pea_controller.model.modal import response
    from pea_core.modal import ModalModel

    V = ModalModel((4000.0, 11000.0), (0.012, 0.02), (0.1, 0.01), delay=70e-6)
    f = np.geomspace(20.0, 8000.0, 300)
    G = response(V, 1, np.exp(2j * np.pi * f * 50e-6), 50e-6)
    path = tmp_path / "response.csv"
    head = "f [Hz],real [m/V],imag [m/V]"
    np.savetxt(path, np.column_stack([f, G.real, G.imag]), delimiter=",", header=head, comments="")
    return path


def test_gains_from_a_frequency_response_alone(measured, tmp_path, monkeypatch):
    from pea_cli.cli import main
    from pea_lab import proposal

    tried = {"estimator.eps_rate_walk": 3e2, "estimator.input_noise": 0.2, "effort": 500.0}
    few = {name: (lambda model, value=value: (value,)) for name, value in tried.items()}
    monkeypatch.setitem(proposal.STARTS, type(law()), few)
    propose = proposal.propose
    monkeypatch.setattr(proposal, "propose", lambda *given: propose(*given, tries=60))
    there = tmp_path / "out"
    asked = ["tune", "resonant", "--from-response", str(measured), "--out", str(there)]
    assert main(asked) == 0
    text = (there / "controller.yaml").read_text()
    ((_, written),) = yaml.safe_load(text).items()
    model = written["ros__parameters"]["model"]
    assert model["omega_n"] == pytest.approx([4000.0, 11000.0], rel=1e-3)
    assert model["K"] == pytest.approx([0.1, 0.01], rel=0.01)
    assert model["delay"] == pytest.approx(70e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("f,re,im\n1,2\n", "holds no frequency response"),
        ("f,re,im\n" + "".join(f"{k},1e-7,0\n" for k in range(1, 5)), "4 frequencies"),
        ("f,re,im\n" + "".join(f"{k},nan,0\n" for k in range(1, 50)), "not finite"),
        ("f,re,im\n" + "".join(f"{1000 * k},1e-7,0\n" for k in range(1, 50)), "half the sample"),
    ],
)
def test_a_response_that_is_none_is_refused_in_one_line(text, told, tmp_path, capsys):
    from pea_cli.cli import main

    path = tmp_path / "r.csv"
    path.write_text(text)
    assert main(["tune", "resonant", "--from-response", str(path)]) == 2
    line = capsys.readouterr().err.strip()
    assert told in line
    assert "\n" not in line


proposed = functools.cache(proposal.propose)


@pytest.fixture
def once(monkeypatch):
    """Axes that are alike are given their gains once: it takes seconds."""
    monkeypatch.setattr(proposal, "propose", proposed)


TWO = ("tune", "resonant", "--set", "axes=[x, y]", "--from-model")


def test_each_axis_is_tuned_and_the_coupled_loop_is_checked(once, tmp_path, capsys):
    there = tmp_path / "found"
    said = ["--set", "plant.stage.cross_talk=[0, 0.02, 0.02, 0]", "--set", "plant.y.K=0.12"]
    assert main([*TWO, *said, "--out", str(there), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["coupled"]["stable"]
    sets = ["axes=[x, y]", f"controller.preset={there / 'controller.yaml'}"]
    whole = experiments.load_axes("resonant", sets).each
    for one in whole:
        own = [f"controller.preset={there / one.axis / 'controller.yaml'}"]
        alone = experiments.load("resonant", own).nodes["controller"].params
        values = told["axes"][one.axis]["values"]
        for found in (alone, one.nodes["controller"].params):
            assert found.effort == values["effort"]
            assert found.estimator.input_noise == values["estimator.input_noise"]


def test_a_coupled_loop_that_is_unstable_gets_no_preset(once, tmp_path, capsys):
    there = tmp_path / "found"
    said = ["--set", "plant.stage.cross_talk=[0, 1.2, 1.2, 0]", "--out", str(there)]
    assert main([*TWO, *said]) == 3
    assert "the coupled loop is unstable" in capsys.readouterr().err
    assert not (there / "controller.yaml").exists()
    assert (there / "y" / "controller.yaml").exists()


def test_ranges_of_all_axes_and_of_one():
    texts = [
        "controller.P=1:2",
        "controller.y.m=3:4",
        "observer.x.K=0:1",
        "controller.estimator.a=1:2",
    ]
    x = ["controller.P=1:2", "observer.K=0:1", "controller.estimator.a=1:2"]
    assert tune.of_axis(("x", "y"), "x", texts) == x
    assert tune.of_axis(("x", "y"), "y", texts) == [
        "controller.P=1:2",
        "controller.m=3:4",
        "controller.estimator.a=1:2",
    ]


@pytest.mark.parametrize(
    ("margin", "least", "said"),
    [(1.2, 1.3, "gain margin of 1.2 < 1.3 on y"), (1.2, None, ""), (2, 1.3, "")],
)
def test_the_margin_is_asked_of_the_coupled_loop(margin, least, said):
    own = {"x": {"gain_margin": None}, "y": {"gain_margin": margin}}
    figures = {"linear": True, "stable": True, "axes": own}
    assert tune.too_close(figures, least).endswith(said)


def test_ranges_of_one_axis_leave_the_other_as_it_is(tmp_path, capsys):
    there = tmp_path / "found"
    said = ["tune", "fig9_hysteresis_10hz", "--set", "axes=[x, y]", "--controller", "recommended"]
    said += ["--observer", "extended_state", "--plants", "", "--trials", "1", "--duration", "0.02"]
    said += [
        "--workers",
        "1",
        "--vary",
        "controller.y.P=0.001:0.002",
        "--out",
        str(there),
        "--json",
    ]
    assert main(said) == 0
    assert set(json.loads(capsys.readouterr().out)["axes"]) == {"y"}
    values = config.read(there / "controller.yaml", ("controller",))["controller"]
    assert {name.partition(".")[0] for name in values} == {"y"}
