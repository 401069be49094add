import dataclasses

import numpy as np
import pytest

from pea_controller.model import pidsmc, state_feedback
from pea_core.modal import ModalModel, varied
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab.proposal import NoProposal, Problem, ProposalGoal, propose

T_S = 50e-6
MODEL = ModalModel((6000.0,), (0.02,), (0.1,))
PARAMS = state_feedback.Params(model=MODEL, delay_samples=2, sensor_delay_samples=1)
VALUES = {"estimator.eps_rate_walk": 1000.0, "estimator.input_noise": 0.05, "effort": 300.0}


def test_gains_keep_the_goal_on_the_whole_set():
    found = propose(PARAMS, ProposalGoal(modulus=0.6), T_S, tries=60)
    assert found.figures.modulus >= 0.6 * 0.998
    assert found.figures.modulus_set >= 0.27 * 0.998
    assert found.figures.largest < 1.0
    assert found.figures.resonance < 0.75 / (2.0 * MODEL.zeta[0])  # damped on the whole set
    assert found.limit


def test_a_goal_that_nothing_keeps_is_told():
    with pytest.raises(NoProposal, match="modulus margin of the model"):
        propose(PARAMS, ProposalGoal(modulus=0.97), T_S, tries=20)


def test_a_law_without_a_model_of_modes_is_refused():
    with pytest.raises(ParameterError, match="state_feedback and pidsmc_modal"):
        propose(pidsmc.Params(), ProposalGoal(), T_S)


def test_frequency_response_and_poles_are_of_one_loop():
    problem = Problem(PARAMS, ProposalGoal(), T_S)
    L, row = problem.law(VALUES)
    A = problem.closed(problem.set[0], L, row)
    # det(z - A) over that of its open parts is 1 / S, whatever the states
    opened = problem.controller(L, row) * problem.P[0]
    F = problem.estimator(L)[0]
    n, m = len(problem.set[0].of.F), len(F)
    rest = np.zeros_like(A)
    rest[:n, :n] = A[:n, :n]
    rest[n:, n:] = A[n:, n:]
    for i in (10, 80, 150):
        z = problem.z[i]
        ratio = np.linalg.det(z * np.eye(len(A)) - A) / np.linalg.det(z * np.eye(len(A)) - rest)
        assert ratio == pytest.approx(1.0 - opened[i], rel=1e-6)
    assert m == n + 2


def test_the_fast_preset_goes_beyond_the_first_resonance():
    given = experiments.load("resonant", ["controller.preset=resonant_fast"])
    params = given.nodes["controller"].params
    values = {
        "estimator.eps_rate_walk": params.estimator.eps_rate_walk,
        "estimator.input_noise": params.estimator.input_noise,
        "effort": params.effort,
    }
    # as it is, and at the local slope of the hysteresis; half a per cent off: stable
    for slope in (1.0, 0.51):
        problem = Problem(
            dataclasses.replace(params, model=varied(params.model, (1.0, 1.0), slope)),
            ProposalGoal(frequency=0.005, gain=0.05),
            given.T_s,
        )
        L, row = Problem(params, ProposalGoal(), given.T_s).law(values)
        S = 1.0 / (1.0 - problem.controller(L, row) * problem.P[0])
        assert 1.0 / np.abs(S).max() >= 0.5
        first = problem.f[np.abs(1.0 - S) < np.sqrt(0.5)][0]
        assert first >= 739.0
    assert (
        Problem(params, ProposalGoal(frequency=0.005, gain=0.05), given.T_s).figures(values).largest
        < 1
    )
