from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, ss2tf

from pea_core.nominal import NominalModel
from pea_observer.matching import Matching, matching

T_S = 50e-6


def test_displacement_feedback_misses_the_condition():
    found = matching(NominalModel(), T_S)
    assert (found.rank_CB, found.rank_B) == (0, 1)
    assert not found.holds


def test_the_sampled_plant_meets_it_with_4_54e_3_um_per_volt():
    assert matching(NominalModel(), T_S).CB_d * 1e6 == pytest.approx(4.540e-3, abs=5e-7)


def test_CB_d_is_the_step_response_after_one_sample():
    zeta, omega_n, K = 0.3, 2000.0, 0.5
    omega_d = omega_n * np.sqrt(1 - zeta**2)
    t = 1e-4
    decay = np.exp(-zeta * omega_n * t)
    step = K * (1 - decay * (np.cos(omega_d * t) + zeta * omega_n / omega_d * np.sin(omega_d * t)))
    found = matching(NominalModel(zeta, omega_n, K), t)
    assert found.CB_d * 1e6 == pytest.approx(step, rel=1e-9)


def test_the_sampling_zero_is_at_minus_0_8615(bench):
    F, G = bench.sampled()
    numerator, _ = ss2tf(F, G[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    zero = -numerator[0, 2] / numerator[0, 1]
    assert zero == pytest.approx(-0.8615, abs=5e-5)


def test_rank_of_the_sampled_product_is_that_of_the_input():
    A = np.array([[0.0, 1.0], [-(5450.0**2), -2 * 0.82 * 5450.0]])
    B = np.array([[0.0], [0.142 * 5450.0**2]])
    _, B_d, C, *_ = cont2discrete((A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1))), T_S)
    assert np.linalg.matrix_rank(C @ B_d) == np.linalg.matrix_rank(B_d) == 1


def test_the_text_says_that_no_classical_observer_exists():
    text = str(matching(NominalModel(), T_S))
    assert "rank(CB) = 0, rank(B) = 1" in text
    assert "not met" in text
    assert "4.540e-03 um/V" in text


def test_the_text_says_when_the_condition_is_met():
    assert "not met" not in str(Matching(1, 1, 1.0))
